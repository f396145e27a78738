"""`refine()`: agents give way, nothing else changes, and gradients are those of finite differences."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from crossing_cars import DT, K, crossing
from games import highway_scene, pad, reordered
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from epo_lightning import FeatureEnergy, LevenbergMarquardt, Scene, Unicycle, refine
from epo_lightning.experiment.config.compose import compose
from epo_lightning.metrics.functional import overlap_rate
from epo_lightning.refinement import SOLVER, WEIGHTS
from epo_lightning.refinement.game import swerve
from epo_lightning.registry import build
from epo_lightning.solvers.backward import Implicit, Unrolled
from epo_lightning.solvers.gauss_newton.augmented_lagrangian import AugmentedLagrangian

APART = {**WEIGHTS, "circles": 0.0}
"""Weights without interaction."""


def traffic(scenes: int = 3, modes: int = 3, horizon: int = 8) -> tuple[Scene, torch.Tensor, torch.Tensor]:
    """Vehicles on a motorway, futures that disagree with each other, and probabilities."""
    scene = highway_scene(scenes, horizon=horizon)
    time = torch.linspace(0.0, 1.0, horizon)[:, None]
    states = scene.future[:, None] + 5.0 * torch.randn(scenes, modes, 4, 1, 4) * time.square() * torch.tensor(
        [1, 0.5, 0, 0]
    )
    return scene, states, torch.rand(scenes, modes).softmax(1)


def overlaps(states: torch.Tensor, scene: Scene) -> torch.Tensor:
    """Whether boxes overlap in each mode, [B, M]."""
    of_modes = [
        overlap_rate(states[:, [m]], states.new_ones(len(states), 1), scene.size, scene.agent_mask, shape="box")
        for m in range(states.shape[1])
    ]
    return torch.stack(of_modes, 1) > 0


def test_crossing_trajectories_that_overlap_stop_overlapping():
    scene, states = crossing()
    refined = refine(states, torch.ones(1, 1), scene)
    assert overlaps(states, scene).all()
    assert not overlaps(refined.states, scene).any()
    moved = (refined.states - states)[..., :2].norm(dim=-1)
    assert 0.2 < moved.max() < 6.0, "they give way by about a car's length"


def test_games_of_dense_scenes_are_solved():
    """Energies and probabilities are those of ten times as many steps in double precision."""
    towards_centre = torch.randn(60, 4, 4) * torch.tensor([20.0, 20.0, 0.3, 1.0])
    towards_centre[..., 2] += torch.atan2(-towards_centre[..., 1], -towards_centre[..., 0])
    towards_centre[..., 3] += 8.0
    scene = Scene(towards_centre[:, :, None], dt=DT, size=torch.tensor([4.5, 1.9]).expand(60, 4, 2))
    controls = torch.randn(60, 5, 4, 1, 2) * torch.tensor([1.0, 0.1])
    states = Unicycle().rollout(scene.current[:, None], controls.expand(-1, -1, -1, K, -1), DT)
    even = torch.full((60, 5), 0.2)
    ours = refine(states, even, scene)
    solver = dataclasses.replace(SOLVER, steps=10 * SOLVER.steps)
    solved = refine(states.double(), even.double(), scene.to(torch.float64), solver=solver)
    assert (solved.solution.energy > 1.0).double().mean() > 0.3, "agents interact in many modes"
    assert (ours.solution.energy <= solved.solution.energy + 0.01).double().mean() > 0.95
    assert ((ours.probabilities - solved.probabilities).abs().amax(1) < 0.01).double().mean() > 0.95
    few = refine(states, even, scene, solver=dataclasses.replace(SOLVER, steps=10))
    assert (few.solution.energy <= solved.solution.energy + 0.01).double().mean() < 0.9, "ten steps are too few"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("distance", "speed", "heading", "apart"),
    [(12.0, 5.0, 0.0, 4.5), (20.0, 0.0, 0.0, 2.5), (40.0, 10.0, math.pi, 2.5)],
    ids=["behind a slower car", "before a parked car", "towards each other"],
)
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_cars_on_exactly_one_line_avoid_each_other(dtype, distance, speed, heading, apart, order):
    """There no energy has a derivative to the side; a car that stays on the line could only drive through the other one."""
    start = torch.tensor([[0.0, 3.5, 0.0, 10.0], [distance, 3.5, heading, speed]], dtype=dtype)
    scene = Scene(start[None, order, None], dt=DT, size=torch.tensor([[[4.5, 1.9], [4.5, 1.9]]], dtype=dtype))
    along = start[:, 3:] * start[:, 2:3].cos() * DT * torch.arange(1.0, K + 1, dtype=dtype)
    states = torch.stack((start[:, :1] + along, torch.full_like(along, 3.5)), -1)[None, None, order]
    assert (states[0, 0, 0] - states[0, 0, 1]).norm(dim=-1).amin() < 2.0, "the given futures overlap"
    refined = refine(states, torch.ones(1, 1, dtype=dtype), scene)
    assert (refined.states[0, 0, 0] - refined.states[0, 0, 1])[:, :2].norm(dim=-1).amin() > apart
    assert not overlaps(refined.states, scene).any()


def test_a_distant_car_on_the_line_does_not_change_who_avoids_whom():
    """A car 130 m ahead drives away from two that approach each other."""
    rows = torch.tensor([[0.0, 0.0, 0.0, 12.0], [30.0, 0.0, math.pi, 1.0], [131.0, 0.0, 0.0, 15.0]]).double()
    time = DT * torch.arange(1.0, K + 1).double()
    states = torch.stack((rows[:, :1] + rows[:, 3:] * rows[:, 2:3].cos() * time, torch.zeros(3, K).double()), -1)
    size = torch.tensor([4.5, 1.9]).double().expand(1, 3, 2)
    two, three = (
        refine(states[None, None, :n], torch.ones(1, 1).double(), Scene(rows[None, :n, None], dt=DT, size=size[:, :n]))
        for n in (2, 3)
    )
    assert_close(three.solution.energy, two.solution.energy, rtol=0.05, atol=0)
    assert (three.states[0, 0, 0] - three.states[0, 0, 1])[:, :2].norm(dim=-1).amin() > 2.5
    turns, of_two = (swerve(Scene(rows[None, :n, None], dt=DT))[0, :2, 1] for n in (3, 2))
    assert (of_two < 0).all(), "both turn to their right"
    assert_close(turns, of_two, rtol=0.02, atol=0)


def test_absent_agents_on_the_line_are_not_avoided():
    """Padding may hold any numbers, such as zeros on the line of an agent that drives along the x axis."""
    rows = torch.tensor([[-9.0, 0.0, 0.0, 8.0], [0.0, 0.0, 0.0, 0.0], [30.0, 0.0, math.pi, 8.0]]).double()
    for there, turned in (([1, 0, 0], 0), ([1, 1, 0], 2), ([1, 0, 1], 2)):
        mask = torch.tensor([there], dtype=torch.bool)
        found = swerve(Scene(rows[None, :, None], dt=DT, agent_mask=mask))[0, :, 1]
        assert int((found != 0).sum()) == turned
        assert (found[~mask[0]] == 0).all()
    alone = swerve(Scene(rows[None, ::2, None], dt=DT))[0]
    assert_close(found[::2], alone[:, 1], rtol=0, atol=0)


@pytest.mark.parametrize("angle", [0.8, -0.8, 2.5, -2.5])
def test_cars_that_cross_the_line_of_another_one_do_not_swerve(angle):
    """Their energies have derivatives to the side."""
    rows = torch.tensor([[0.0, 0.0, 0.0, 8.0], [20.0, 0.0, angle, 8.0]]).double()
    assert not swerve(Scene(rows[None, :, None], dt=DT)).any()


def test_the_row_that_trains_weights_has_the_solver_of_refine():
    row = compose("train", ["experiment=highway/v_lstm_refined", "forecaster.frozen=rpi/v_lstm_epo"])
    assert build("solver", row["solver"]) == SOLVER


def test_futures_that_do_not_interact_stay_as_they_were_tracked():
    scene, states = crossing()
    later = dataclasses.replace(
        scene, history=scene.history + torch.tensor([[[[0.0] * 4]], [[[0.0, 80.0, 0.0, 0.0]]]])[:, 0]
    )
    states = states + later.current[:, None, :, None] - scene.current[:, None, :, None]
    assert_close(refine(states, torch.ones(1, 1), later).states, states, rtol=0, atol=1e-3)


@given(st.integers(0, 10_000))
@settings(max_examples=10, deadline=None)
def test_without_pair_weight_the_tracked_input_comes_back(seed: int):
    torch.manual_seed(seed)
    scene = highway_scene(2, horizon=K)
    driven = Unicycle().rollout(
        scene.current[:, None], 0.1 * torch.randn(2, 3, 4, K, 2) * torch.tensor([10.0, 0.5]), DT
    )
    probabilities = torch.rand(2, 3).softmax(1)
    refined = refine(driven, probabilities, scene, weights=APART, inverse_temperature=1.0)
    assert_close(refined.states[..., :2], driven[..., :2], rtol=0, atol=1e-2)
    assert_close(refined.states, refined.initial_states, rtol=0, atol=1e-3)
    assert_close(refined.probabilities, probabilities)


def test_positions_are_enough_and_their_jitter_is_removed():
    scene, states = crossing()
    jittered = states[..., :2] + 0.1 * torch.randn(1, 1, 2, K, 2)
    tracked = refine(jittered, torch.ones(1, 1), scene, weights=APART).states[..., :2]
    assert (tracked - states[..., :2]).norm(dim=-1).mean() < 0.7 * (jittered - states[..., :2]).norm(dim=-1).mean()
    exact = refine(jittered, torch.ones(1, 1), scene, weights=APART, noise=0.0).states[..., :2]
    assert_close(exact[..., 1:, :], jittered[..., 1:, :], rtol=0, atol=1e-3)


def test_energies_reweight_probabilities_as_written():
    scene, states, probabilities = traffic()
    plain = refine(states, probabilities, scene, inverse_temperature=0.0)
    refined = refine(states, probabilities, scene, inverse_temperature=0.3)
    assert_close(plain.probabilities, probabilities)
    energy = refined.solution.energy
    expected = probabilities * (-0.3 * (energy - energy.amin(1, keepdim=True))).exp()
    assert_close(refined.probabilities, expected / expected.sum(1, keepdim=True))
    assert (energy.amax(1) > energy.amin(1)).all()
    usual = refine(states, probabilities, scene).probabilities
    stated = refine(states, probabilities, scene, inverse_temperature=0.03).probabilities
    assert torch.equal(usual, stated)
    assert not torch.equal(usual, plain.probabilities)


def test_a_mode_without_probability_keeps_none():
    scene, states, _ = traffic(modes=2)
    refined = refine(states, torch.tensor([[1.0, 0.0]] * 3), scene, inverse_temperature=1.0)
    assert (refined.probabilities == torch.tensor([1.0, 0.0])).all()


def test_the_order_of_agents_does_not_matter():
    scene, states, probabilities = traffic()
    order = [2, 0, 3, 1]
    one, other = (
        refine(*what)
        for what in ((states, probabilities, scene), (states[:, :, order], probabilities, reordered(scene, order)))
    )
    assert_close(other.states, one.states[:, :, order], rtol=0, atol=1e-2)
    assert_close(other.probabilities, one.probabilities, rtol=0, atol=1e-4)


@pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
def test_padding_does_not_matter(filling: float):
    scene, states, probabilities = traffic()
    wide = torch.cat((states, torch.full_like(states[:, :, :2], filling)), 2)
    alone = refine(states, probabilities, scene, inverse_temperature=0.1)
    padded = refine(wide, probabilities, pad(scene, agents=2, filling=filling), inverse_temperature=0.1)
    assert_close(padded.states[:, :, :4], alone.states, rtol=0, atol=1e-3)
    assert_close(padded.probabilities, alone.probabilities, rtol=0, atol=1e-5)


def test_scenes_of_a_batch_do_not_change_each_other():
    scene, states, probabilities = traffic()
    together = refine(states, probabilities, scene)
    for index in range(3):
        alone = refine(states[[index]], probabilities[[index]], scene[index])
        assert_close(alone.states[0], together.states[index], rtol=0, atol=1e-3)


def test_gradients_by_weights_margins_and_temperature_are_those_of_finite_differences():
    scene, states = crossing(torch.float64)
    other = states.clone()
    other[..., 1, :, 1] -= 1.0  # a second mode, in which the second car is later
    given, probabilities = torch.cat((states, other), 1), torch.tensor([[0.6, 0.4]], dtype=torch.float64)
    energy = FeatureEnergy(own=("accref", "turnrref"), pair=("clearance",))
    solver = LevenbergMarquardt(steps=20, step_size=1.0, damping=1.0, adaptive=True, newton_steps=30)
    probe = torch.randn(1, 2, 2, K, 2, dtype=torch.float64)

    def value(accref, turnrref, clearance, margin, beta):
        weights = {"accref": accref, "turnrref": turnrref, "clearance": clearance}
        found = refine(
            given,
            probabilities,
            scene,
            energy,
            weights,
            margins={"clearance": margin},
            inverse_temperature=beta,
            solver=solver,
        )
        return (found.states[..., :2] * probe).sum() + found.probabilities[0, 0]

    numbers = [torch.tensor(number, dtype=torch.float64, requires_grad=True) for number in (1.0, 20.0, 3.0, 0.4, 0.05)]
    slopes = torch.autograd.grad(value(*numbers), numbers)
    for index, slope in enumerate(slopes):
        ends = []
        for step in (1e-3, -1e-3):
            moved = [number.detach() + (step if at == index else 0.0) for at, number in enumerate(numbers)]
            ends.append(value(*moved))
        assert_close(slope, (ends[0] - ends[1]) / 2e-3, rtol=1e-3, atol=1e-5)
        assert slope.abs() > 1e-6


@pytest.mark.parametrize(
    ("solver", "backward"),
    [
        (LevenbergMarquardt(steps=2), Unrolled()),
        (LevenbergMarquardt(steps=20, step_size=1.0, damping=1.0, adaptive=True, newton_steps=30), Implicit()),
        (AugmentedLagrangian(), Implicit()),
    ],
    ids=["two unrolled steps", "a minimum", "hard constraints"],
)
def test_gradients_of_probabilities_are_those_of_finite_differences_also_far_from_a_minimum(solver, backward):
    """Two steps do not reach a minimum, and a minimum under constraints is none of the energy: its slope by the strategies
    is not zero, so strategies that move with a weight or with a margin change it."""
    scene, states = crossing(torch.float64)
    other = states.clone()
    other[..., 1, :, 1] -= 1.0
    given, probabilities = torch.cat((states, other), 1), torch.tensor([[0.6, 0.4]], dtype=torch.float64)
    energy = FeatureEnergy(own=("accref", "turnrref"), pair=("clearance",))

    def value(accref, turnrref, clearance, margin):
        weights = {"accref": accref, "turnrref": turnrref, "clearance": clearance}
        options = {"inverse_temperature": 0.05, "solver": solver, "backward": backward}
        margins = {"clearance": margin}
        return refine(given, probabilities, scene, energy, weights, margins=margins, **options).probabilities[0, 0]

    numbers = [torch.tensor(number, dtype=torch.float64, requires_grad=True) for number in (1.0, 20.0, 3.0, 0.4)]
    slopes = torch.autograd.grad(value(*numbers), numbers)
    for index, slope in enumerate(slopes):
        ends = []
        for step in (1e-3, -1e-3):
            moved = [number.detach() + (step if at == index else 0.0) for at, number in enumerate(numbers)]
            ends.append(value(*moved))
        assert_close(slope, (ends[0] - ends[1]) / 2e-3, rtol=1e-3, atol=1e-7)
    assert all(slopes[index].abs() > 1e-4 for index in (0, 3))


def test_no_graph_is_recorded_where_nothing_is_learned():
    scene, states = crossing()
    assert not refine(states, torch.ones(1, 1), scene).states.requires_grad
