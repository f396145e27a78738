"""The LQ cores and the iterative solvers equal dense references on random linear-quadratic games."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from epo_lightning.data.rpi import lq
from epo_lightning.data.rpi.game import GameConstants
from epo_lightning.data.rpi.kernels import rollout
from epo_lightning.data.rpi.solve import FeedbackSettings, PotentialSettings, solve_feedback, solve_potential

from . import dense


def play(A, B, gains, offsets, start):
    x, controls = start, []
    for k in range(len(A)):
        controls.append(gains[k] @ x + offsets[k])
        x = A[k] @ x + B[k] @ controls[-1]
    return np.stack(controls)


@pytest.mark.parametrize("steps", [1, 6, 20])
def test_lq_minimum_equals_the_dense_system(steps):
    random = np.random.default_rng(steps)
    problem = dense.random_lq(random, steps, lq.STATES, lq.CONTROLS)
    start = random.normal(size=lq.STATES)
    convex, gains, offsets, promised = lq.lq_minimum(*problem, 0.0)
    assert convex
    assert promised > 0
    np.testing.assert_allclose(
        play(*problem[:2], gains, offsets, start), dense.open_loop(*problem, start), atol=1e-8, rtol=1e-8
    )


def test_lq_minimum_reports_a_problem_without_minimum():
    A, B, Q, q, R, r = dense.random_lq(np.random.default_rng(0), 6, lq.STATES, lq.CONTROLS)
    assert not lq.lq_minimum(A, B, Q, q, -50 * R, r, 0.0)[0]


@pytest.mark.parametrize("owner", [[0, 0, 1, 1], [0, 1, 2, 1], [0, 0, 0, 0]])
def test_lq_games_equal_coupled_riccati_equations_and_are_equilibria(owner):
    owner = np.array(owner)
    players = owner.max() + 1
    problem = dense.random_lq(np.random.default_rng(players), players=players)
    unique, gains, offsets = lq.lq_game(*problem, owner)
    assert unique
    expected_gains, expected_offsets = dense.coupled_riccati(*problem, owner)
    np.testing.assert_allclose(gains, expected_gains, atol=1e-8)
    np.testing.assert_allclose(offsets, expected_offsets, atol=1e-8)
    A, B, *costs = problem
    for player in range(players):
        mine = owner == player
        best = dense.best_response_policy(A, B, *(cost[player] for cost in costs), gains, offsets, mine)
        np.testing.assert_allclose(gains[:, mine], best[0], atol=1e-8)
        np.testing.assert_allclose(offsets[:, mine], best[1], atol=1e-8)


def test_one_player_feedback_game_is_the_minimum():
    A, B, *costs = dense.random_lq(np.random.default_rng(5), 6, lq.STATES, lq.CONTROLS)
    _, gains, offsets = lq.lq_game(A, B, *(cost[None] for cost in costs), np.zeros(4, dtype=np.int64))
    _, same_gains, same_offsets, _ = lq.lq_minimum(A, B, *costs, 0.0)
    np.testing.assert_allclose(gains, same_gains, atol=1e-8)
    np.testing.assert_allclose(offsets, same_offsets, atol=1e-8)


# Two agents that face each other on a line, with a proximity cost that acts at any distance and no active bounds: along
# the line dynamics are linear and costs quadratic, and by symmetry no agent turns. State (x1, v1, x2, v2).
LINE = dataclasses.replace(GameConstants(), radius=50.0, bound=0.0)
STEPS, WEIGHT = 30, 2.0
START = np.array([-3.0, 0.0, 0.0, 0.3, 3.0, 0.0, 0.0, -0.2])
GOALS = np.array([[-1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])


def line_game():
    """Dynamics and the costs of both players along the line, as x' Q x / 2 + q' x."""
    dt = LINE.dt
    A = np.tile(np.kron(np.eye(2), np.array([[1.0, dt], [0.0, 1.0]])), (STEPS, 1, 1))
    B = np.tile(np.kron(np.eye(2), np.array([[0.0], [dt]])), (STEPS, 1, 1))
    own_Q, own_q = np.zeros((2, STEPS + 1, 4, 4)), np.zeros((2, STEPS + 1, 4))
    R, r = np.zeros((2, STEPS, 2, 2)), np.zeros((2, STEPS, 2))
    apart = np.array([-1.0, 0.0, 1.0, 0.0])
    pair_Q, pair_q = np.zeros((STEPS + 1, 4, 4)), np.zeros((STEPS + 1, 4))
    pair_Q[1:], pair_q[1:] = 2 * WEIGHT * np.outer(apart, apart), -2 * WEIGHT * LINE.radius * apart
    for i in range(2):
        own_Q[i, 1:, 2 * i + 1, 2 * i + 1] = LINE.slowness
        own_Q[i, -1, 2 * i, 2 * i] = LINE.terminal
        own_q[i, -1, 2 * i] = -LINE.terminal * GOALS[i, 0]
        R[i, :, i, i] = LINE.effort
    return A, B, own_Q, own_q, R, r, pair_Q, pair_q


def test_the_potential_solver_solves_an_lq_game_in_one_step():
    A, B, own_Q, own_q, R, r, pair_Q, pair_q = line_game()
    exact = dense.open_loop(A, B, own_Q.sum(0) + pair_Q, own_q.sum(0) + pair_q, R.sum(0), r.sum(0), START[[0, 3, 4, 7]])
    settings = PotentialSettings(exact_below=0.0)  # sideways the exact Hessian is not convex
    x, u, converged, iterations = solve_potential(
        START, np.zeros((STEPS, 4)), LINE.array(), GOALS, WEIGHT, np.ones(2), settings
    )
    assert converged
    assert iterations == 1
    np.testing.assert_allclose(u[:, [0, 2]], exact, atol=1e-8)
    assert np.abs(x[:, [1, 2, 5, 6]]).max() == 0.0


def test_the_feedback_solver_solves_an_lq_game_in_one_step():
    A, B, own_Q, own_q, R, r, pair_Q, pair_q = line_game()
    gains, offsets = dense.coupled_riccati(A, B, own_Q + pair_Q, own_q + pair_q, R, r, np.array([0, 1]))
    exact = play(A, B, gains, offsets, START[[0, 3, 4, 7]])
    settings = FeedbackSettings(step=1.0, regularisation=0.0, largest_move=1e3)
    for iterations in (1, 2):  # the second step changes nothing
        limited = settings._replace(iterations=iterations)
        x, u, converged, _ = solve_feedback(START, np.zeros((STEPS, 4)), LINE.array(), GOALS, WEIGHT, limited)
        np.testing.assert_allclose(u[:, [0, 2]], exact, atol=1e-8)
        assert converged == (iterations == 2)
        assert np.abs(x[:, [1, 2, 5, 6]]).max() == 0.0
    open_loop = dense.open_loop(
        A, B, own_Q.sum(0) + pair_Q, own_q.sum(0) + pair_q, R.sum(0), r.sum(0), START[[0, 3, 4, 7]]
    )
    assert np.abs(open_loop - exact).max() > 1e-4  # the two concepts do differ
    np.testing.assert_allclose(rollout(START, u, LINE.dt), x, atol=1e-12)
