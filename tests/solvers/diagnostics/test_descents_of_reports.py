"""The parts of a report of equilibria: choices among candidates, held agents, and descents of many functions at once."""

from __future__ import annotations

import dataclasses
import importlib
from itertools import product

import numpy as np
import pytest
import torch
from backends import stacked
from games import ALL, BOUNDS, leaves_of, nearest_points_held, pad, random_game, random_scene, widen
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reported_games import OWN, STEPS, Opaque, Valued, forecast_of, report, value

from epo_lightning.forecast import Status, Tables
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.metrics.forecast import equilibrium_values
from epo_lightning.solvers.diagnostics import quasi_newton
from epo_lightning.solvers.diagnostics.equilibrium import Descent, equilibrium
from epo_lightning.solvers.gauss_newton.backends import compiled, pytorch
from epo_lightning.solvers.gauss_newton.kernel import interface

SLOW = settings(max_examples=12, suppress_health_check=[HealthCheck.differing_executors])


# Finite games, against loops.


def finite_game(scenes, agents, candidates, modes, seed=0):
    torch.manual_seed(seed)
    scene = random_scene(scenes, agents, history=2, dtype=torch.float64)
    mask = torch.rand(scenes, agents) < 0.8
    mask[0] = True
    scene = dataclasses.replace(scene, agent_mask=mask)
    first, second = pairs(agents)
    unary = torch.randn(scenes, agents, candidates, dtype=torch.float64).masked_fill(~mask[..., None], torch.nan)
    pair = torch.randn(scenes, len(first), candidates, candidates, dtype=torch.float64)
    pair[~(mask[:, first] & mask[:, second])] = torch.nan
    assignment = torch.randint(candidates, (scenes, modes, agents))
    states = torch.zeros(scenes, candidates, agents, 4, 4, dtype=torch.float64)
    tables = Tables(states, unary, pair, torch.zeros_like(unary), torch.zeros(scenes, dtype=torch.float64))
    return scene, tables, assignment


@SLOW
@given(agents=st.integers(1, 4), candidates=st.integers(1, 4), modes=st.integers(1, 3), seed=st.integers(0, 999))
def test_finite_games_are_reported_exactly(agents, candidates, modes, seed):
    scene, tables, assignment = finite_game(4, agents, candidates, modes, seed)
    mask = scene.agent_mask
    assignment = torch.where(mask[:, None], assignment, -99)
    probabilities = torch.rand(4, modes, dtype=torch.float64)
    controls = torch.zeros(4, modes, agents, 4, 2, dtype=torch.float64)
    energy = FeatureEnergy(OWN)
    parameters = random_game(scene, 1, 4, own=OWN)
    forecast = forecast_of(energy, scene, parameters, controls, probabilities, tables=tables, assignment=assignment)
    found = equilibrium(Valued(energy), scene, forecast)
    assert found.gradient_norm.isnan().all()
    for b in range(4):
        choice = assignment[b, probabilities[b].argmax()].tolist()
        assert found.energy[b].item() == pytest.approx(value(tables, mask, b, choice))
        for i in range(agents):
            if not mask[b, i]:
                assert found.nash_gap[b, i] == found.objective[b, i] == 0
                continue
            others = [[*choice[:i], k, *choice[i + 1 :]] for k in range(candidates)]
            stays = value(tables, mask, b, choice, without=i)
            best = min(value(tables, mask, b, other, without=i) for other in others)
            assert found.objective[b, i].item() == pytest.approx(stays)
            assert found.nash_gap[b, i].item() == pytest.approx(stays - best, abs=1e-12)
        lowest = min(value(tables, mask, b, joint) for joint in product(range(candidates), repeat=agents))
        seen = min(value(tables, mask, b, mode) for mode in assignment[b].tolist())
        assert lowest - 1e-9 <= found.optimum[b].item() <= min(seen, found.energy[b].item()) + 1e-9
        if agents == 1:
            assert found.optimum[b].item() == pytest.approx(lowest)


def test_at_the_lowest_joint_choice_there_is_no_gap_and_other_modes_lead_there():
    scene, tables, _ = finite_game(1, 3, 4, 1)
    joint = list(product(range(4), repeat=3))
    values = [value(tables, scene.agent_mask, 0, choice) for choice in joint]
    order = np.argsort(values)
    assignment = torch.tensor([[joint[order[-1]], joint[order[0]]]])
    energy, parameters = FeatureEnergy(OWN), random_game(scene, 1, 4, own=OWN)
    controls = torch.zeros(1, 2, 3, 4, 2, dtype=torch.float64)
    for likely in range(2):
        probabilities = torch.nn.functional.one_hot(torch.tensor([likely]), 2).double()
        forecast = forecast_of(energy, scene, parameters, controls, probabilities, tables=tables, assignment=assignment)
        found = equilibrium(energy, scene, forecast)
        assert found.optimum.item() == pytest.approx(values[order[0]]), "the lowest is one of the modes"
        assert (found.nash_gap.max() > 0) == (likely == 0)


def test_infinitely_expensive_choices_have_infinite_gaps():
    scene, tables, assignment = finite_game(1, 2, 3, 1)
    assignment = torch.zeros_like(assignment)
    energy, parameters = FeatureEnergy(OWN), random_game(scene, 1, 4, own=OWN)
    controls = torch.zeros(1, 1, 2, 4, 2, dtype=torch.float64)
    unary = tables.unary.clone()
    unary[0, 0] = torch.inf  # whatever the first one does
    unary[0, 1, 0] = torch.inf
    forecast = forecast_of(
        energy, scene, parameters, controls, tables=dataclasses.replace(tables, unary=unary), assignment=assignment
    )
    found = equilibrium(energy, scene, forecast)
    assert found.nash_gap.tolist() == [[0.0, torch.inf]]


# Holding agents.

SOLVERS = [compiled.solve] if not isinstance(interface.find(), str) else []


SOLVERS += [pytorch.solve, lambda *a, **o: pytorch.solve(*a, split=False, **o)]


def reduced(energy, scene, parameters, steps, step_size, damping, held):
    """Damped Gauss-Newton steps of the agents that are not held, by a dense matrix of their controls, game by game."""
    controls = parameters.initial_controls
    free = ~held[..., None, None].expand(controls.shape)
    for _ in range(steps):
        with nearest_points_held():
            jacobian = torch.func.jacfwd(lambda u: stacked(energy, scene, parameters, u).sum((0, 1)))(controls)
        jacobian = jacobian.permute(1, 2, 0, 3, 4, 5).flatten(3)
        residual = stacked(energy, scene, parameters, controls)
        each = damping[..., None, None].expand(controls.shape)
        moved = torch.zeros_like(controls)
        for b, m in product(*map(range, controls.shape[:2])):
            some = free[b, m].flatten()
            slopes = jacobian[b, m][:, some]
            matrix = slopes.mT @ slopes + torch.diag(each[b, m].flatten()[some])
            step = torch.zeros(len(some), dtype=controls.dtype)
            step = step.masked_scatter(some, -torch.linalg.solve(matrix, slopes.mT @ residual[b, m]))
            moved[b, m] = step.view(controls.shape[2:])
        controls = controls + step_size * moved
    return controls


@pytest.mark.parametrize("solve", SOLVERS, ids=["compiled", "pytorch", "whole"][-len(SOLVERS) :])
@pytest.mark.parametrize(("agents", "size"), [(1, 1.0), (2, 2.0), (4, 1.5), (5, 3.0)])
def test_held_agents_keep_their_controls_while_the_others_are_solved(solve, agents, size):
    scene = random_scene(3, agents, history=2, size=size, dtype=torch.float64)
    parameters = random_game(scene, 2, 6)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    damping = 1.0 + torch.rand(3, 2, agents, dtype=torch.float64)
    held = torch.rand(3, 2, agents) < 0.5
    held[0, 0], held[0, 1] = False, True
    damping = damping.masked_fill(held, torch.inf)
    ours, theirs = leaves_of(parameters), leaves_of(parameters)
    solution = solve(energy, scene, ours, 2, 0.5, damping)
    expected = reduced(energy, scene, theirs, 2, 0.5, damping, held)
    assert (solution.status == Status.COMPLETED).all()
    assert torch.equal(solution.controls[held], parameters.initial_controls[held]), "not by a single bit"
    torch.testing.assert_close(solution.controls, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(solution.energy, energy(scene, parameters, expected.detach()))
    weigh = torch.randn_like(expected)
    for controls in (solution.controls, expected):
        (weigh * controls).sum().backward()
    torch.testing.assert_close(ours.initial_controls.grad, theirs.initial_controls.grad, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(ours.goals.grad, theirs.goals.grad, rtol=1e-8, atol=1e-8)
    for name in energy.own:
        mine, other = ours.own_weights[name].grad, theirs.own_weights[name].grad
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-8, msg=name)


@pytest.mark.parametrize("solve", SOLVERS, ids=["compiled", "pytorch", "whole"][-len(SOLVERS) :])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_dampings_of_all_agents_equal_one_damping_bit_for_bit(solve, dtype):
    scene = random_scene(5, 3, history=2, size=1.5, dtype=dtype)
    parameters = random_game(scene, 2, 7)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    damping = 1.0 + torch.rand(5, 2, dtype=dtype)
    one = solve(energy, scene, parameters, 2, 0.3, damping)
    other = solve(energy, scene, parameters, 2, 0.3, damping[..., None].expand(-1, -1, 3))
    assert torch.equal(one.controls, other.controls)
    assert torch.equal(one.energy, other.energy)


# Many functions at once.


def test_rosenbrock_functions_are_minimised():
    starts = torch.tensor([[-1.2, 1.0, -1.0], [2.0, -3.0, 0.5], [1.0, 1.0, 1.0], [torch.nan, 0.0, 0.0]]).double()
    height = torch.tensor([100.0, 10.0, 100.0, 1.0]).double()

    def evaluate(index, point):
        with torch.enable_grad():
            x = point.clone().requires_grad_()
            first, second = x[:, :-1], x[:, 1:]
            value = (height[index, None] * (second - first**2) ** 2 + (1 - first) ** 2).sum(1)
            (slope,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), slope

    found = quasi_newton.minimise(evaluate, starts)
    torch.testing.assert_close(found.point[:3], torch.ones(3, 3).double(), rtol=0, atol=1e-5)
    assert found.after[:3].max() < 1e-9
    assert torch.equal(found.point[2], starts[2]), "there already"
    assert found.after[3].isnan()
    first, _ = evaluate(torch.arange(4), starts)
    assert torch.equal(found.before[:3], first[:3])
    assert quasi_newton.minimise(evaluate, starts[:0]).after.shape == (0,)


def test_unbounded_descent_is_given_up_and_slow_convergence_is_not():
    # Down a slope for ever, towards a bound that is never reached, along a parabola, and a quartic with a flat ground.
    def evaluate(index, point):
        with torch.enable_grad():
            x = point.clone().requires_grad_()
            every = torch.stack(
                (-torch.nn.functional.softplus(x).sum(1), torch.exp(-x).sum(1), x.square().sum(1), (x**4).sum(1))
            )
            value = every[index, torch.arange(len(index))]
            (slope,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), slope

    found = quasi_newton.minimise(evaluate, torch.full((4, 3), 2.0).double())
    assert found.found.tolist() == [False, True, True, True]
    assert found.after[0] < -100.0
    assert found.after[1:].max() < 1e-6
    alone = quasi_newton.minimise(lambda index, point: evaluate(index * 0, point), torch.full((1, 3), 2.0).double())
    assert not alone.found.item()


class Downhill(Opaque):
    """An energy that is unbounded from below in the accelerations of agents that start to the right of the origin."""

    def own_terms(self, scene, parameters, states, controls):
        terms = self.features.own_terms(scene, parameters, states, controls)
        right = self.current_states(scene)[..., 0] > 0
        return {**terms, "acc": torch.where(right, -controls[..., 0].sum(-1), terms["acc"])}


def test_energies_without_a_minimum_have_no_optimum_and_no_gap(monkeypatch):
    monkeypatch.setattr(quasi_newton, "_EVALUATIONS", 80)  # so that it does not take long
    scene = random_scene(3, 2, history=2, size=1.5, dtype=torch.float64)
    history = scene.history.clone()
    history[..., 0] = -history[..., 0].abs() - 1.0
    history[1, 1, :, 0] = 3.0
    scene = pad(dataclasses.replace(scene, history=history))
    parameters = widen(random_game(random_scene(3, 2, history=2, dtype=torch.float64), 1, STEPS, own=("acc", "turnr")))
    features = FeatureEnergy(("acc", "turnr"), ["proximity"])
    energy = Downhill(features)
    forecast = forecast_of(energy, scene, parameters, parameters.initial_controls)
    found = equilibrium(energy, scene, forecast)
    assert found.optimum.isnan().tolist() == [False, True, False]
    assert found.nash_gap.isnan()[:, :2].all(1).tolist() == [False, True, False]
    assert not found.nash_gap[[0, 2]].isnan().any()
    assert (found.nash_gap[:, 2:] == 0).all()
    assert found.energy.isfinite().all()
    assert found.gradient_norm.isfinite().all()
    metrics = equilibrium_values(dataclasses.replace(forecast, equilibrium=found))
    names = [name for name, value in metrics.items() if value[1].isnan()]
    assert names == ["energy_optimum", "nash_gap", "nash_gap_relative"]


def test_a_best_response_is_the_better_of_two_minima_and_unknown_without_an_optimum(monkeypatch):
    """With given minima instead of a minimiser: three scenes of two agents, in the second one no optimum is found."""
    scene = random_scene(3, 2, dtype=torch.float64)
    energy, parameters = FeatureEnergy(OWN, ["proximity"]), random_game(scene, 1, STEPS, own=OWN)
    best = torch.randn_like(parameters.initial_controls)
    starts = []

    def values(*numbers):
        return torch.tensor(numbers, dtype=torch.float64)

    def descend(energy, scene, game, agent):
        starts.append((game.initial_controls, agent))
        if agent is None:
            optimum, found = values(1.0, 1.5, 2.0), torch.tensor([True, False, True])
            return Descent(values(9.0, 9.0, 9.0), optimum, best, values(0.0, 0.0, 0.0), found)
        before = values(5.0, 6.0, 5.0, 5.0, 7.0, 5.0)
        from_own, from_optimum = values(3.0, 1.0, 2.0, 2.0, 7.5, 4.0), values(2.0, 4.0, 2.0, 2.0, 7.2, torch.nan)
        after = from_own if len(starts) == 2 else from_optimum
        return Descent(before, after, game.initial_controls, before, torch.ones(6, dtype=torch.bool))

    monkeypatch.setattr(importlib.import_module(equilibrium.__module__), "descend_features", descend)
    found = report(energy, scene, parameters, parameters.initial_controls)
    expected = values(5.0 - 2.0, 6.0 - 1.0, torch.nan, torch.nan, 0.0, 1.0).view(3, 2)
    torch.testing.assert_close(found.nash_gap, expected, equal_nan=True)
    torch.testing.assert_close(found.optimum, values(1.0, torch.nan, 2.0), equal_nan=True)
    # The second minimisation starts at the agent's own strategy in the optimum; the other agent keeps its strategy.
    (_, none), (first, agents), (second, _) = starts
    assert none is None
    assert agents.tolist() == [0, 1] * 3
    solved = parameters.initial_controls
    for world in range(6):
        origin, mine = divmod(world, 2)
        assert torch.equal(first[world], solved[origin])
        assert torch.equal(second[world, 0, mine], best[origin, 0, mine])
        assert torch.equal(second[world, 0, 1 - mine], solved[origin, 0, 1 - mine])
