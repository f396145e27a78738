"""`refine()`: agents give way, nothing else changes, and everything that cannot be refined is refused by name."""

from __future__ import annotations

import dataclasses
import math
import warnings

import pytest
import torch
from games import highway_scene, pad, reordered
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from epo_lightning import FeatureEnergy, LevenbergMarquardt, Scene, Unicycle, refine
from epo_lightning.experiment.config.compose import compose
from epo_lightning.metrics.functional import overlap_rate
from epo_lightning.refinement import ENERGY, SOLVER, WEIGHTS
from epo_lightning.refinement.game import swerve
from epo_lightning.registry import ConfigError, build
from epo_lightning.solvers.backward import Implicit, Unrolled
from epo_lightning.solvers.gauss_newton.augmented_lagrangian import AugmentedLagrangian

DT, K = 0.2, 20
APART = {**WEIGHTS, "circles": 0.0}
"""Weights without interaction."""


def crossing(dtype: torch.dtype = torch.float32) -> tuple[Scene, torch.Tensor]:
    """Two cars at 10 m/s whose straight paths cross; one is there 0.2 s before the other."""
    start = torch.tensor([[[-20.0, 0.0, 0.0, 10.0]], [[0.0, -18.0, math.pi / 2, 10.0]]], dtype=dtype)
    scene = Scene(start[None], dt=DT, size=torch.tensor([[[4.5, 1.9], [4.5, 1.9]]], dtype=dtype))
    states = Unicycle().rollout(scene.current[:, None], torch.zeros(1, 1, 2, K, 2, dtype=dtype), DT)
    return scene, states


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
    assert (swerve(Scene(rows[None, :2, None], dt=DT))[..., 1] < 0).all(), "both turn to their right"


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


def refused(error: type[Exception], message: str, **changes) -> None:
    scene, states = crossing()
    arguments = {"states": states, "probabilities": torch.ones(1, 1), "scene": scene, **changes}
    with pytest.raises(error, match=message):
        refine(**arguments)


GOALS = FeatureEnergy(own=("accref", "turnrref", "goal"), pair=())
FORGETS = FeatureEnergy(own=("acc", "turnr"), pair=("circles",))
MARGIN = FeatureEnergy(own=("accref",), pair=("lateral",))
HEUN = dataclasses.replace(ENERGY, dynamics=Unicycle("heun"))
BROKEN = torch.zeros(1, 1, 2, K, 4)
BROKEN[0, 0, 1, 3, 0] = math.nan


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"states": [1.0]}, TypeError, "states is a list"),
        ({"states": torch.zeros(1, 1, 2, K, 4, dtype=torch.long)}, TypeError, r"states is of type torch\.int64"),
        ({"states": torch.zeros(1, 2, K, 4)}, ValueError, r"\[1, 2, 20, 4\]; this scene takes \[1, M, 2, K, 2 or 4\]"),
        ({"states": torch.zeros(1, 1, 3, K, 4)}, ValueError, r"\[1, 1, 3, 20, 4\]"),
        ({"states": torch.zeros(1, 1, 2, K, 3)}, ValueError, "2 or 4"),
        ({"states": torch.zeros(1, 1, 2, 1, 4)}, ValueError, r"K = 1 step\(s\)"),
        ({"states": torch.zeros(1, 0, 2, K, 4), "probabilities": torch.ones(1, 0)}, ValueError, r"M = 0 mode"),
        ({"states": BROKEN}, ValueError, r"states\[0, 0, 1, 3\] is \[nan"),
        (
            {"probabilities": torch.ones(1, 2)},
            ValueError,
            r"probabilities has shape \[1, 2\]; these states take \[1, 1\]",
        ),
        ({"probabilities": torch.full((1, 1), 0.7)}, ValueError, r"probabilities\[0\] is \[0\.6.*sum to 1"),
        ({"probabilities": torch.full((1, 1), math.nan)}, ValueError, r"probabilities\[0\] is \[nan\]"),
        (
            {"energy": dataclasses.replace(ENERGY), "weights": {"accref": 1.0}},
            ValueError,
            "lacks the feature 'turnrref'",
        ),
        (
            {"energy": dataclasses.replace(ENERGY)},
            ValueError,
            "needs weights=, a number for each of accref, turnrref, circ",
        ),
        ({"weights": {**WEIGHTS, "circle": 1.0}}, ValueError, r"unknown feature weights\['circle'\].*'circles'"),
        ({"weights": {**WEIGHTS, "circles": math.inf}}, ValueError, r"weights\['circles'\] must be a finite number"),
        ({"weights": {**WEIGHTS, "circles": torch.ones(3)}}, ValueError, r"shape \[3\].*\[1, 1, 1\]"),
        ({"energy": GOALS, "weights": {}}, ConfigError, "knows no goals"),
        ({"energy": FORGETS, "weights": {}}, ConfigError, "add accref and turnrref"),
        (
            {"energy": MARGIN, "weights": {"accref": 1.0, "lateral": 1.0}},
            ValueError,
            "margins lacks the feature 'lateral'",
        ),
        ({"margins": {"circles": 0.1}}, ValueError, r"unknown feature margins\['circles'\]"),
        ({"inverse_temperature": -1.0}, ConfigError, "inverse_temperature must be a number, 0 or more"),
        ({"inverse_temperature": 1e39}, ValueError, "inverse_temperature must be at most"),
        ({"weights": {**WEIGHTS, "accref": 1e20}}, ValueError, r"weights\['accref'\] must be at most"),
        ({"weights": {**WEIGHTS, "accref": torch.tensor(-1e20)}}, ValueError, r"weights\['accref'\] must be at most"),
        ({"weights": [1, 2, 3]}, TypeError, "weights is a list"),
        ({"scene": None}, TypeError, "scene is a NoneType"),
        ({"states": torch.zeros(1, 1, 2, K, 4, dtype=torch.half)}, TypeError, r"states is of type torch\.float16"),
        ({"inverse_temperature": math.inf}, ConfigError, "inverse_temperature must be a number, 0 or more, and finite"),
        ({"inverse_temperature": torch.tensor([1.0])}, ValueError, "inverse_temperature must be one finite number"),
        ({"weights": {"accref": torch.tensor(math.nan), "turnrref": 1.0, "circles": 1.0}}, ValueError, "not finite"),
        ({"inverse_temperature": torch.tensor(True)}, ValueError, "inverse_temperature must be one finite number"),
        ({"inverse_temperature": torch.tensor(1j)}, ValueError, "inverse_temperature must be one finite number"),
        ({"inverse_temperature": 10**400}, ValueError, "inverse_temperature must be at most"),
        ({"weights": {**WEIGHTS, "accref": 10**400}}, ValueError, r"weights\['accref'\] must be at most"),
        (
            {"weights": {**WEIGHTS, "accref": torch.tensor(1j)}},
            ValueError,
            r"weights\['accref'\] is of type .*complex64",
        ),
        ({"energy": None}, TypeError, "energy is a NoneType; it takes an instance of epo_lightning.game.energy.Energy"),
        ({"solver": None}, TypeError, "solver is a NoneType"),
        ({"backward": "implicit"}, TypeError, "backward is a str"),
        ({"noise": -0.1}, ValueError, "noise must be a number, 0 or more"),
        ({"energy": HEUN, "weights": WEIGHTS}, ConfigError, "integrator=euler"),
    ],
)
def test_what_cannot_be_refined_is_refused_by_name(changes, error, message):
    refused(error, message, **changes)


def test_sizes_are_needed_where_bodies_interact():
    scene, states = crossing()
    refused(ValueError, "size", scene=dataclasses.replace(scene, size=None), states=states)


def alone(scene: Scene, absent: int = 0, sized: bool = False) -> Scene:
    """The first agent of a scene, with absent ones, and without sizes."""
    agents = 1 + absent
    return Scene(
        scene.history[:, :agents],
        dt=scene.dt,
        agent_mask=torch.arange(agents)[None] < 1,
        size=scene.size[:, :agents] if sized else None,
    )


@pytest.mark.parametrize("absent", [0, 1])
def test_agents_without_others_need_no_sizes(absent: int):
    scene, states = crossing()
    given = states[:, :, : 1 + absent]
    refined = refine(given, torch.ones(1, 1), alone(scene, absent))
    assert_close(refined.states[:, :, 0], states[:, :, 0], rtol=0, atol=1e-3)
    assert (refined.states == refine(given, torch.ones(1, 1), alone(scene, absent, sized=True)).states).all()


def test_agents_without_others_need_sizes_where_their_own_features_do():
    scene, states = crossing()
    steers = FeatureEnergy(own=("accref", "turnrref", "steer"), pair=("circles",))
    refused(
        ValueError,
        r"scene\.size.*None",
        states=states[:, :, :1],
        scene=alone(scene),
        energy=steers,
        weights={**WEIGHTS, "steer": 1.0},
    )


def test_futures_in_other_coordinates_lead_to_a_warning():
    scene, states = crossing()
    with pytest.warns(UserWarning, match=r"states\[0, 0, 0\] begins 14\d\.\d m from .* in the same coordinates"):
        refine(states[..., :2] + 100.0, torch.ones(1, 1), scene)


def test_one_weight_of_the_default_energy_can_be_changed():
    scene, states = crossing()
    whole = refine(states, torch.ones(1, 1), scene, weights={**WEIGHTS, "circles": 20.0})
    torch.testing.assert_close(
        refine(states, torch.ones(1, 1), scene, weights={"circles": 20.0}).states, whole.states, rtol=0, atol=0
    )
    assert not torch.equal(whole.states, refine(states, torch.ones(1, 1), scene).states)


def crossing_at(offset: float = 0.0, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, Scene]:
    """Positions of the futures of two cars whose paths cross, and their scene; far from the origin by an offset."""
    scene, states = crossing(dtype)
    history = scene.history.clone()
    history[..., :2] += offset
    return states[..., :2] + offset, dataclasses.replace(scene, history=history)


def test_scenes_in_coordinates_of_a_map_are_refined_as_near_the_origin() -> None:
    near, far = (
        refine(given, torch.ones(1, 1).double(), scene)
        for given, scene in (crossing_at(dtype=torch.double), crossing_at(5.4e6, torch.double))
    )
    torch.testing.assert_close(far.states[..., :2] - 5.4e6, near.states[..., :2], rtol=0, atol=1e-6)
    torch.testing.assert_close(far.initial_states[..., :2] - 5.4e6, near.initial_states[..., :2], rtol=0, atol=1e-6)
    states, scene = crossing_at(5.4e6)
    with pytest.warns(
        UserWarning, match=r"up to 5400000 m from the origin, where single precision has a resolution of 0\.6"
    ):
        refine(states, torch.ones(1, 1), scene)


@pytest.mark.parametrize(("entry", "factor"), [(2, 0.0), (2, 2.0), (3, 3.6), (3, 0.0)])
def test_futures_that_contradict_the_present_states_are_warned_of(entry: int, factor: float) -> None:
    states, scene = crossing_at()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refine(states, torch.ones(1, 1), scene)
    history = scene.history.clone()
    history[..., entry] *= factor
    with pytest.warns(UserWarning, match=r"of the given futures of agents do not continue .* states\[0, 0, [01]\]"):
        refine(states, torch.ones(1, 1), dataclasses.replace(scene, history=history))


def test_absent_agents_may_have_any_numbers() -> None:
    states, scene = crossing_at()
    for value in (math.nan, math.inf):
        history, padded = scene.history.clone(), states.clone()
        history[:, 1], padded[:, :, 1] = value, value
        alone = dataclasses.replace(scene, history=history, agent_mask=torch.tensor([[True, False]]))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert refine(padded, torch.ones(1, 1), alone).states[:, :, 0].isfinite().all()


def test_negative_weights_and_names_of_derivatives_are_refused() -> None:
    states, scene = crossing_at()
    with pytest.raises(ValueError, match=r"weights\['circles'\] must be 0 or more, not -20"):
        refine(states, torch.ones(1, 1), scene, weights={"circles": -20.0})
    with pytest.raises(TypeError, match=r"backward is a str; it takes an instance of .*Implicit\(\), Unrolled\(\)"):
        refine(states, torch.ones(1, 1), scene, backward="unrolled")
