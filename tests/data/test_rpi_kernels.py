"""The compiled game equals the same game written in torch: costs, gradients, Hessians, Newton steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from epo_lightning.data.rpi import kernels
from epo_lightning.data.rpi.game import GameConstants, main_game
from epo_lightning.data.rpi.lq import lq_minimum
from epo_lightning.data.rpi.solve import follow

from . import dense

CONSTANTS = GameConstants()
C = CONSTANTS.array()
GOALS = np.array([[3.0, 0.0, 0.0], [-1.0, 2.0, 0.5]])


def situation(random, steps=15, wild=1.0):
    """Agents within reach of each other that also break their bounds."""
    start = np.array([-0.4, 0.0, 0.1, 0.5, 0.4, 0.2, 2.5, 0.6]) + 0.1 * random.normal(size=8)
    return start, wild * random.normal(size=(steps, 4))


def potential(start, u, weight):
    costs = dense.torch_costs(torch.from_numpy(start), u, CONSTANTS, torch.from_numpy(GOALS), weight)
    pair = dense.torch_costs(torch.from_numpy(start), u, CONSTANTS, torch.from_numpy(GOALS), 0.0)
    return costs.sum() - (costs - pair).sum() / 2  # both pay the shared cost; the potential holds it once


@pytest.mark.parametrize("seed", range(5))
def test_costs_and_gradient_equal_autograd(seed):
    start, u = situation(np.random.default_rng(seed))
    x = kernels.rollout(start, u, CONSTANTS.dt)
    *own, pair = kernels.costs(x, u, C, GOALS, 30.0)
    expected = dense.torch_costs(torch.from_numpy(start), torch.from_numpy(u), CONSTANTS, torch.from_numpy(GOALS), 30.0)
    assert pair > 0
    np.testing.assert_allclose([own[0] + pair, own[1] + pair], expected, rtol=1e-12)
    leaf = torch.from_numpy(u).requires_grad_()
    (gradient,) = torch.autograd.grad(potential(start, leaf, 30.0), leaf)
    np.testing.assert_allclose(kernels.potential_gradient(x, u, C, GOALS, 30.0), gradient, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("agent", [0, 1])
def test_an_agents_column_of_the_gradient_is_its_unilateral_gradient(agent):
    start, u = situation(np.random.default_rng(agent))
    value = dense.alone(start, u, CONSTANTS, GOALS, 30.0, agent)
    cost, gradient = value(u.reshape(-1, 2, 2)[:, agent].ravel())
    x = kernels.rollout(start, u, CONSTANTS.dt)
    *own, pair = kernels.costs(x, u, C, GOALS, 30.0)
    assert cost == pytest.approx(own[agent] + pair, rel=1e-12)
    mine = kernels.potential_gradient(x, u, C, GOALS, 30.0)[:, 2 * agent : 2 * agent + 2]
    np.testing.assert_allclose(gradient.reshape(-1, 2), mine, rtol=1e-10, atol=1e-10)


def expansion(start, u, weight, exact):
    steps = len(u)
    x = kernels.rollout(start, u, CONSTANTS.dt)
    A, B = np.empty((steps, 8, 8)), np.empty((steps, 8, 4))
    Q, q, R, r = np.zeros((steps + 1, 8, 8)), np.zeros((steps + 1, 8)), np.zeros((steps, 4, 4)), np.zeros((steps, 4))
    kernels.linearise(x, C, np.ones(2), A, B)
    for i in range(2):
        kernels.add_own(i, x, u, C, GOALS, Q, q, R, r)
    kernels.add_pair(x, C, weight, exact, Q, q)
    if exact:
        kernels.add_curvature(x, C, kernels.adjoint(A, B, q, r)[1], Q)
    return x, A, B, Q, q, R, r


def test_the_linearisation_equals_differences():
    start, u = situation(np.random.default_rng(1), steps=3)
    x, A, B, *_ = expansion(start, u, 1.0, False)
    out, h = np.empty((2, 8)), 1e-6
    for j in range(8):
        bump = h * np.eye(8)[j]
        kernels.step(x[1] + bump, u[1], CONSTANTS.dt, out[0])
        kernels.step(x[1] - bump, u[1], CONSTANTS.dt, out[1])
        np.testing.assert_allclose((out[0] - out[1]) / (2 * h), A[1, :, j], atol=1e-9)
    for j in range(4):
        bump = h * np.eye(4)[j]
        kernels.step(x[1], u[1] + bump, CONSTANTS.dt, out[0])
        kernels.step(x[1], u[1] - bump, CONSTANTS.dt, out[1])
        np.testing.assert_allclose((out[0] - out[1]) / (2 * h), B[1, :, j], atol=1e-9)


def test_the_exact_step_is_newtons():
    """The policy's rollout changes the controls by -H^-1 g to first order in the offsets, with H from autograd."""
    start, u = situation(np.random.default_rng(3), wild=0.05)
    x, A, B, Q, q, R, r = expansion(start, u, 0.5, True)
    convex, gains, offsets, promised = lq_minimum(A, B, Q, q, R, r, 0.0)
    assert convex
    flat = torch.from_numpy(u).flatten()
    hessian = torch.autograd.functional.hessian(lambda v: potential(start, v.view(-1, 4), 0.5), flat)
    gradient = torch.from_numpy(kernels.potential_gradient(x, u, C, GOALS, 0.5)).flatten()
    newton = -torch.linalg.solve(hessian, gradient)
    scale = 1e-6
    _, moved = follow(x, u, gains, offsets, scale, CONSTANTS.dt)
    np.testing.assert_allclose(((moved - u) / scale).ravel(), newton, rtol=1e-4, atol=1e-4)
    assert promised == pytest.approx(float(-(gradient @ newton)), rel=1e-8)


def test_second_derivatives_of_own_costs_equal_differences_of_the_first_ones_beyond_the_bounds():
    start, u = situation(np.random.default_rng(2), steps=6)
    u *= np.array([9.0, 0.2, 9.0, 0.2])
    x = kernels.rollout(start, u, CONSTANTS.dt)
    for value, limit in ((u[:, 0::2], CONSTANTS.acceleration_limit), (u[:, 1::2], CONSTANTS.turn_limit)):
        assert 0 < (np.abs(value) > limit).sum() < value.size
    assert (x[1:, 3::4] < CONSTANTS.speed_min).any()

    def own(x, u):
        Q, q, R, r = np.zeros((7, 8, 8)), np.zeros((7, 8)), np.zeros((6, 4, 4)), np.zeros((6, 4))
        for i in range(2):
            kernels.add_own(i, x, u, C, GOALS, Q, q, R, r)
        return Q, q, R, r

    Q, _, R, _ = own(x, u)
    for j, bump in enumerate(1e-6 * np.eye(8)):
        np.testing.assert_allclose((own(x + bump, u)[1] - own(x - bump, u)[1]) / 2e-6, Q[:, j], atol=1e-5)
    for j, bump in enumerate(1e-6 * np.eye(4)):
        np.testing.assert_allclose((own(x, u + bump)[3] - own(x, u - bump)[3]) / 2e-6, R[:, j], atol=1e-5)


def test_the_proximity_cost_is_harmless_where_agents_coincide():
    start = np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.5])
    u = np.zeros((4, 4))
    x = kernels.rollout(start, u, CONSTANTS.dt)
    assert np.isfinite(kernels.potential_gradient(x, u, C, GOALS, 30.0)).all()


def test_passage_measures_side_and_distance():
    u = np.zeros((20, 4))
    for lateral, side in ((0.3, 1), (-0.3, -1)):
        x = kernels.rollout(np.array([-1.0, 0.0, 0.0, 1.0, 1.0, lateral, np.pi, 1.0]), u, CONSTANTS.dt)
        distance, when, rotation, slowest = kernels.passage(x)
        assert (distance, when) == (pytest.approx(0.3), 10)
        assert np.sign(rotation) == side
        assert slowest == 1.0


@pytest.mark.parametrize("agent", [0, 1])
def test_the_smallest_speed_is_that_of_either_agent(agent):
    start = np.array([-1.0, 0.0, 0.0, 1.0, 1.0, 0.3, np.pi, 1.0])
    u = np.zeros((5, 4))
    u[2, 2 * agent], u[3, 2 * agent] = -8.0, 5.0
    assert kernels.passage(kernels.rollout(start, u, CONSTANTS.dt))[3] == pytest.approx(1.0 - 8.0 * CONSTANTS.dt)


def test_main_games_place_the_agents_as_documented():
    for placement in range(5):
        game = main_game(0, 3, placement, 5, CONSTANTS)
        start = game.start.reshape(2, 4)
        np.testing.assert_allclose(start[0], [-3, 0, 0, 0])
        np.testing.assert_allclose(game.goals[:, :2], -start[:, :2], atol=1e-12)
        np.testing.assert_allclose(start[1, 2], np.arctan2(*(game.goals[1, :2] - start[1, :2])[::-1]), atol=1e-12)
        assert np.radians(30) <= abs(game.phi) <= np.pi
        assert 10 <= game.weight <= 100
        assert game.weight == main_game(0, 3, 0, 38, CONSTANTS).weight


@pytest.mark.parametrize("placement", [0, 1, 4])
def test_the_angle_says_nothing_about_the_weight(placement):
    games = [main_game(0, number, placement, 5, CONSTANTS) for number in range(400)]
    weights, angles = ([getattr(game, name) for game in games] for name in ("weight", "phi"))
    assert abs(np.corrcoef(weights, angles)[0, 1]) < 4 / math.sqrt(len(games))
    # Angles are uniform within the arc, and those of the first recipe differ in the first placement alone.
    assert np.ptp(angles) == pytest.approx(np.radians(60), rel=0.02)
    first = [main_game(0, number, placement, 5, CONSTANTS, recipe=1) for number in range(400)]
    assert [game.weight for game in first] == weights
    if placement:
        assert [game.phi for game in first] == angles
    else:
        assert np.corrcoef(weights, [game.phi for game in first])[0, 1] == pytest.approx(1)
