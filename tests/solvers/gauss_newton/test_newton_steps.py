"""Adaptive steps inside of the compiled layer, and Newton steps with the Hessian, in both backends."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from backends import STATE_PAIRS, gradients
from games import ALL, BOUNDS, leaves_of, random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Implicit, Unrolled
from epo_lightning.solvers.gauss_newton import adaptive
from epo_lightning.solvers.gauss_newton.backends import compiled, pytorch
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

PAIR = ("proximity", "clearance")
ADAPTIVE = {"step_size": 1.0, "damping": 1.0, "adaptive": True}


def make(
    seed: int,
    dtype: torch.dtype = torch.float64,
    agents: int = 3,
    own: tuple[str, ...] = ALL,
    pair: tuple[str, ...] = PAIR,
    ends: tuple[int, int, int] | None = None,
) -> tuple[FeatureEnergy, Scene, GameParameters]:
    """Three random scenes with two modes and seven steps, in which agents overlap and bounds are violated."""
    torch.manual_seed(seed)
    scene = random_scene(3, agents, history=2, size=1.5, dtype=dtype)
    scene.size[..., 1] *= 0.6
    if ends is not None:
        scene = dataclasses.replace(scene, game_steps=torch.tensor(ends))
    return FeatureEnergy(own, pair, BOUNDS), scene, random_game(scene, 2, 7, own, 0.5, pair)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    agents=st.integers(1, 4),
    own=st.sets(st.sampled_from(ALL), min_size=1).map(lambda names: tuple(sorted(names))),
    pair=st.sampled_from([(), ("proximity",), PAIR, *STATE_PAIRS]),
    ends=st.none() | st.tuples(*[st.integers(2, 7)] * 3),
    damping=st.sampled_from([1e-2, 1.0, 50.0]),
)
def test_a_newton_step_is_the_same_in_both_backends(seed, agents, own, pair, ends, damping) -> None:
    energy, scene, game = make(seed, agents=agents, own=own, pair=pair, ends=ends)
    lambda_ = torch.full((3, 2), damping, dtype=torch.float64)
    found = [
        solve(energy, scene, game, 1, 0.7, lambda_, exact=True, **more)
        for solve, more in ((pytorch.solve, {"split": True}), (compiled.solve, {}))
    ]
    # A matrix that is not positive definite is damped more, for all agents that are factorised together. For pair features
    # of states, the two backends find other sets of these agents.
    solved = [one.status == Status.COMPLETED for one in found]
    same = solved[0] & solved[1] if set(pair) - set(PAIR) else torch.ones(3, 2, dtype=torch.bool)
    torch.testing.assert_close(found[1].controls[same], found[0].controls[same], rtol=1e-6, atol=1e-8)
    assert torch.equal(found[1].status[same], found[0].status[same])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("steps", [0, 1, 12])
@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("damping", [1.0, 1e5])
@pytest.mark.parametrize("held", [False, True])
def test_steps_inside_of_the_compiled_layer_equal_single_calls(dtype, steps, exact, damping, held) -> None:
    """With a gradient enabled, Python decides on every step; without, the compiled layer does.

    They agree to the last bit until the compiled layer stops at a minimum; further steps change rounding errors only. Agents
    with infinite damping are held. Python compares energies of all agents and the compiled layer those of the agents that
    move, so near a minimum their decisions differ by the rounding of an energy: by about its square root in the states.
    """
    energy, scene, game = make(0, dtype, ends=(7, 4, 2))
    scene.history[1, 0, -1, 0] = torch.nan
    game.initial_controls[2] *= 50.0  # steps that are rejected
    solver = LevenbergMarquardt(backend="compiled", **{**ADAPTIVE, "damping": damping})
    memory = None
    if held:
        memory = torch.full((3, 2, 3), damping, dtype=dtype)
        memory[0, :, 1] = memory[2, 0, 0] = torch.inf
    with torch.enable_grad():
        one, damping_one = solver.run(energy, scene, game, steps, memory, exact=exact)
    with torch.no_grad():
        other, damping_other = solver.run(energy, scene, game, steps, memory, exact=exact)
    if memory is not None:
        still = memory.isinf()
        assert torch.equal(damping_other.isinf(), still)
        assert torch.equal(other.controls[still], game.initial_controls[still])
    if steps <= 1:
        for name in ("controls", "states", "initial_energy", "energy", "gradient_norm", "status"):
            assert torch.equal(getattr(one, name).nan_to_num(7.0), getattr(other, name).nan_to_num(7.0)), name
        assert torch.equal(damping_one, damping_other)
    else:
        close, rounding = (1e-3, 1e-6) if dtype == torch.float32 else (1e-6, 1e-14)
        torch.testing.assert_close(one.states, other.states, equal_nan=True, rtol=close, atol=close)
        torch.testing.assert_close(one.energy, other.energy, equal_nan=True, rtol=rounding, atol=0)
        assert torch.equal(one.status, other.status)
    assert (other.status[1] == Status.STOPPED).all()
    assert (other.status[[0, 2]] != Status.STOPPED).all()


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    agents=st.integers(2, 6),
    pair=st.sampled_from([("proximity",), PAIR, *STATE_PAIRS]),
    ends=st.none() | st.tuples(*[st.integers(2, 7)] * 3),
    exact=st.booleans(),
)
def test_steps_without_held_agents_in_the_factorisation_equal_those_with_infinite_damping(
    seed, agents, pair, ends, exact
) -> None:
    """With a gradient enabled, held agents are in the matrices, with infinite damping; without, only their pairs count."""
    energy, scene, game = make(seed, agents=agents, pair=pair, ends=ends)
    held = torch.rand(3, 2, agents) < 0.5
    memory = torch.full((3, 2, agents), 10.0, dtype=torch.float64).masked_fill(held, torch.inf)
    solver = LevenbergMarquardt(backend="compiled", **ADAPTIVE)
    with torch.enable_grad():
        one, damping_one = solver.run(energy, scene, game, 1, memory, exact=exact)
    with torch.no_grad():
        other, damping_other = solver.run(energy, scene, game, 1, memory, exact=exact)
    # A matrix that is not positive definite is damped more, for all agents that are factorised together. Without the held
    # agents, these are fewer.
    same = (one.status == Status.COMPLETED) & (other.status == Status.COMPLETED)
    assert same.any() or exact
    assert torch.equal(other.controls[held], game.initial_controls[held])
    torch.testing.assert_close(other.controls[same], one.controls[same], rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(other.energy[same], one.energy[same], rtol=1e-10, atol=0)
    assert torch.equal(damping_one[same], damping_other[same])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_energy_of_held_agents_does_not_hide_the_progress_of_the_others(dtype) -> None:
    """The held agent's energy is so large that its rounding is larger than every decrease that the other agent can reach."""
    energy, scene, game = make(1, dtype, own=("goal", "acc", "turnr"), agents=2, pair=())
    far = dataclasses.replace(game, own_weights={**game.own_weights, "goal": game.own_weights["goal"].clone()})
    far.own_weights["goal"][..., 1] *= 1e6 if dtype == torch.float32 else 1e10
    memory = torch.tensor([1.0, torch.inf], dtype=dtype).expand(3, 2, 2)
    solver = LevenbergMarquardt(backend="compiled", **ADAPTIVE)
    with torch.no_grad():
        near, _ = solver.run(energy, scene, game, 20, memory.clone())
        found, _ = solver.run(energy, scene, far, 20, memory.clone())
    assert not torch.equal(near.controls[..., 0, :, :], game.initial_controls[..., 0, :, :])
    assert torch.equal(found.controls, near.controls)


@pytest.mark.parametrize("exact", [False, True])
def test_without_a_gradient_scenes_at_a_minimum_take_no_further_steps(exact) -> None:
    energy, scene, game = make(2, own=("goal", "acc", "turnr"), pair=())
    with torch.no_grad():
        most, _ = LevenbergMarquardt(backend="compiled", **ADAPTIVE).run(energy, scene, game, 200, exact=exact)
    game.initial_controls[1] = most.controls[1]
    solver = LevenbergMarquardt(backend="pytorch", **ADAPTIVE)
    sizes: list[int] = []

    def step(rows: torch.Tensor | slice, controls: torch.Tensor, damping: torch.Tensor):
        sizes.append(len(damping))
        some = dataclasses.replace(game[rows], initial_controls=controls)
        return pytorch.solve(energy, scene[rows], some, 1, 1.0, damping, exact=exact)

    with torch.no_grad():
        start, damping = solver.run(energy, scene, game, 0)
        found, _ = adaptive.descend(step, start, 200, damping, keep_iterates=True)
    assert sizes[0] == 3
    assert sizes[-1] < 3, "the scene that starts at its minimum is left out first"
    assert len(sizes) < 200
    assert len(found.iterates) == 201
    assert torch.equal(found.iterates[-1], found.controls)
    torch.testing.assert_close(found.energy, most.energy, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.controls, most.controls, rtol=0, atol=1e-5)


def test_a_step_that_changes_nothing_shows_a_minimum_only_with_little_damping() -> None:
    energy, scene, game = make(2, torch.float32, own=("goal", "acc", "turnr"), pair=())
    solver = LevenbergMarquardt(backend="pytorch", **ADAPTIVE)
    taken = 0

    def step(rows: torch.Tensor | slice, controls: torch.Tensor, damping: torch.Tensor):
        nonlocal taken
        taken += 1
        some = dataclasses.replace(game[rows], initial_controls=controls)
        return pytorch.solve(energy, scene[rows], some, 1, 1.0, damping)

    with torch.no_grad():
        start, _ = solver.run(energy, scene, game, 0)
        much = start.gradient_norm.square() / (1e-5 * start.energy)  # a step lowers the energy by about 1e-5 of it
        assert (much > 1.0).all()
        _, once = adaptive.descend(step, start, 1, much)
        assert (once < much).any(), "some step is accepted"
        found, _ = adaptive.descend(step, start, 200, much)
        best, _ = solver.run(energy, scene, game, 200)
        torch.testing.assert_close(found.energy, best.energy, rtol=1e-3, atol=0)
        taken = 0
        adaptive.descend(step, best, 200, torch.full_like(much, 1e-6))
    assert taken < 4, "at a minimum, with little damping"


def test_modes_and_agents_go_on_while_others_are_at_their_minimum_or_held() -> None:
    """The first mode begins at its minimum, and the last agent is held; first steps of the second mode are rejected."""
    energy, scene, game = make(2, own=("goal", "acc", "turnr"), pair=())
    game.initial_controls.mul_(3.0)
    scene = dataclasses.replace(scene, dt=1.0)  # long ways, on which a linearised heading is far from the truth
    damping = torch.full((3, 2, 3), 1e-5, dtype=torch.float64)
    damping[..., 2] = torch.inf
    pytorch, both = (LevenbergMarquardt(backend=backend, **ADAPTIVE) for backend in ("pytorch", "compiled"))
    with torch.no_grad():
        best, _ = both.run(energy, scene, game, 300, damping.clone())
        game.initial_controls[:, 0] = best.controls[:, 0]
        first, _ = pytorch.run(energy, scene, game, 1, damping.clone())
        rejected = (first.controls[:, 1] == game.initial_controls[:, 1]).flatten(1).all(1)
        assert rejected.any()
        assert (best.energy < 0.9 * first.initial_energy)[:, 1].all()
        found, _ = pytorch.run(energy, scene, game, 300, damping.clone())
    torch.testing.assert_close(found.energy, best.energy, rtol=1e-6, atol=0)


@pytest.mark.parametrize("backend", ["pytorch", "compiled"])
def test_games_whose_energy_is_infinite_are_stopped(backend) -> None:
    energy, scene, game = make(2, own=("goal", "acc", "turnr"), pair=())
    game.goals[1, 0, 2] = 1e200
    with torch.no_grad():
        found = LevenbergMarquardt(4, backend=backend, **ADAPTIVE)(energy, scene, game)
    assert found.status.tolist() == [[Status.COMPLETED] * 2, [Status.STOPPED, Status.COMPLETED], [Status.COMPLETED] * 2]
    assert torch.equal(found.controls[1, 0], game.initial_controls[1, 0])


def test_a_given_damping_is_not_overwritten() -> None:
    energy, scene, game = make(1)
    given_damping = torch.ones(3, 2, dtype=torch.float64)
    with torch.no_grad():
        _, after = LevenbergMarquardt(**ADAPTIVE).run(energy, scene, game, 4, given_damping)
    assert (given_damping == 1.0).all()
    assert (after != 1.0).any()


@pytest.mark.parametrize("backend", ["pytorch", "compiled"])
def test_newton_steps_converge_where_gauss_newton_steps_do_not(backend) -> None:
    """Goals out of reach leave large residuals, whose second derivatives Gauss-Newton steps lack."""
    energy, scene, game = make(2, own=("goal", "acc", "turnr"), pair=())
    game.goals.mul_(5.0)
    norms = {}
    for steps, newton in ((10, 0), (6, 4)):
        solver = LevenbergMarquardt(steps=steps, newton_steps=newton, backend=backend, **ADAPTIVE)
        with torch.no_grad():
            norms[newton] = solver(energy, scene, game).gradient_norm
    assert norms[4].max() < 1e-8
    assert norms[0].max() > 1e-6


def test_descents_end_with_newton_steps_where_the_solver_can_take_them() -> None:
    solver = LevenbergMarquardt(steps=8, **ADAPTIVE)
    energy, scene, game = make(2, own=("goal", "acc", "turnr"), pair=())
    game.goals.mul_(5.0)
    with torch.no_grad():
        short, found = (descend(energy, scene, game) for descend in (solver, solver.descent()))
        nearby = dataclasses.replace(game, initial_controls=found.controls + 1e-3)
        again = dataclasses.replace(solver.descent().near_minimum(), newton_steps=3)(energy, scene, nearby)
    assert short.gradient_norm.max() > 1e-6
    assert found.gradient_norm.max() < 1e-7
    torch.testing.assert_close(again.controls, found.controls, rtol=0, atol=1e-6)
    for fixed in (LevenbergMarquardt(), LevenbergMarquardt(backend="warp", adaptive=True)):
        assert fixed.descent() is fixed
        assert fixed.near_minimum() is fixed


def test_newton_steps_never_raise_the_energy_and_keep_the_energy_of_the_start() -> None:
    energy, scene, game = make(3)
    with torch.no_grad():
        first = LevenbergMarquardt(steps=3, **ADAPTIVE)(energy, scene, game)
        both = LevenbergMarquardt(steps=3, newton_steps=4, keep_iterates=True, **ADAPTIVE)(energy, scene, game)
    assert (both.energy <= first.energy).all()
    assert torch.equal(both.initial_energy, first.initial_energy)
    assert both.iterates is not None
    assert len(both.iterates) == 1 + 3 + 4
    assert torch.equal(both.iterates[-1], both.controls)


def test_newton_steps_have_an_implicit_derivative_and_no_unrolled_one() -> None:
    energy, scene, game = make(4, own=("goal", "vel", "acc", "turnr"), pair=())
    solver = LevenbergMarquardt(steps=10, newton_steps=10, **ADAPTIVE)
    leaves = leaves_of(game)
    Implicit()(solver, energy, scene, leaves).states.square().sum().backward()
    assert leaves.own_weights["goal"].grad.abs().sum() > 0
    with pytest.raises(ValueError, match="newton_steps have no derivative: use backward=implicit"):
        Unrolled()(solver, energy, scene, leaves_of(game))
    with pytest.raises(ConfigError, match=r"solver\.newton_steps needs solver\.adaptive=true"):
        LevenbergMarquardt(newton_steps=2)
    with pytest.raises(ConfigError, match=r"solver\.newton_steps"):
        LevenbergMarquardt(newton_steps=-1, adaptive=True)


@settings(max_examples=10)
@given(
    seed=st.integers(0, 10_000),
    agents=st.integers(1, 3),
    own=st.sets(st.sampled_from(ALL), min_size=1).map(lambda names: tuple(sorted({"acc", "turnr", *names}))),
    pair=st.sampled_from([(), ("proximity",), PAIR]),
    ends=st.none() | st.tuples(*[st.integers(2, 7)] * 3),
    hessian=st.sampled_from(["exact", "gauss_newton"]),
)
def test_implicit_derivatives_are_the_same_in_both_backends(seed, agents, own, pair, ends, hessian) -> None:
    energy, scene, game = make(seed, agents=agents, own=own, pair=pair, ends=ends)
    found = []
    for backend in ("pytorch", "compiled"):
        leaves = leaves_of(game)
        solver = LevenbergMarquardt(steps=15, newton_steps=5, backend=backend, **ADAPTIVE)
        solution = Implicit(hessian)(solver, energy, scene, leaves)
        weigh = torch.linspace(-1.0, 1.0, solution.states.numel(), dtype=torch.float64).view_as(solution.states)
        within = (
            torch.ones_like(weigh)
            if ends is None
            else torch.arange(7).view(-1, 1) < torch.tensor(ends).view(-1, 1, 1, 1, 1)
        )
        (solution.states * weigh * within).sum().backward()
        found.append((solution, gradients(leaves)))
    (one, by_one), (other, by_other) = found
    same = (one.controls - other.controls).flatten(2).abs().amax(-1) < 1e-6  # descents may end in different minima
    assert torch.equal(one.status[same], other.status[same])
    for name, gradient in by_one.items():
        torch.testing.assert_close(
            by_other[name][same], gradient[same], rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}"
        )
