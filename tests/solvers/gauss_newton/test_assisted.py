"""Tests of the compiled backend with features of the user: the suite of all backends, and features that couple more."""

from __future__ import annotations

import dataclasses
import shutil

import pytest
import torch
from backends import BackendSuite, gradients, reference
from games import BOUNDS, leaves_of, random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import ACCELERATION, HEADING, SPEED, TURN_RATE, Scene, X, Y
from epo_lightning.solvers.gauss_newton import assisted, backends, compiled, structured
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

if isinstance(interface.find(), str) and shutil.which("c++") is None:
    pytest.skip("there is no C++ compiler on this machine, so the kernel was not built", allow_module_level=True)

TWINS = {"acc": "my acc", "vel": "my vel", "turnr": "my turnr"}
"""Built-in features, and the same as functions of the user."""
COUPLED = ("drift", "hurry", "detour")


@pytest.fixture(autouse=True, scope="module")
def features():
    own_feature("my acc", Source.STEP)(lambda states, controls: controls[..., ACCELERATION])
    own_feature("my vel", Source.SPEED)(lambda speed: speed)
    own_feature("my turnr", Source.STEP)(lambda states, controls: controls[..., TURN_RATE])

    @own_feature("drift", Source.STEP)
    def drift(states, controls):
        return states[..., SPEED] * controls[..., TURN_RATE] + 0.3 * states[..., HEADING].sin() * states[..., X]

    @own_feature("hurry", Source.SPEED)
    def hurry(speed):
        return (speed - 0.3).relu().square()

    @own_feature("detour", Source.STEP)
    def detour(states, controls):
        return 0.2 * states[..., X] * states[..., Y] + controls[..., TURN_RATE] * controls[..., ACCELERATION]

    own_feature("whole")(lambda states, controls: states[..., SPEED].diff(dim=-1))
    pair_feature("soft", Source.DISTANCE)(lambda distance, reach: (reach - distance).exp())
    yield
    for name in (*TWINS.values(), *COUPLED, "whole"):
        del OWN_FEATURES[name]
    del PAIR_FEATURES["soft"]


def with_twins(energy, scene, parameters, *given, **options):
    """The solution of a game whose features were exchanged for their twins."""
    own = [TWINS.get(name, name) for name in energy.own]
    renamed = {TWINS.get(name, name): weight for name, weight in parameters.own_weights.items()}
    energy, parameters = dataclasses.replace(energy, own=own), dataclasses.replace(parameters, own_weights=renamed)
    helped = assisted.obstacle(energy, scene, parameters) is None
    return (assisted if helped else structured).solve(energy, scene, parameters, *given, **options)


class TestAssisted(BackendSuite):
    solve = staticmethod(with_twins)


def coupled(
    scene: Scene, horizon: int, own: tuple[str, ...] = ("acc", "goal"), **settings: object
) -> tuple[FeatureEnergy, GameParameters]:
    game = random_game(scene, 2, horizon)
    weights = game.own_weights | {name: 0.2 + torch.rand_like(game.own_weights["acc"]) for name in COUPLED}
    return FeatureEnergy([*own, *COUPLED], bounds=BOUNDS, **settings), dataclasses.replace(game, own_weights=weights)


@settings(max_examples=25)
@given(
    agents=st.integers(1, 4),
    horizon=st.integers(2, 12),
    own=st.sampled_from([("acc",), ("goal", "steer", "jerk", "lane"), ("turnacc", "velb", "heading")]),
    stride=st.sampled_from([1, 2]),
    ends=st.none() | st.tuples(st.integers(1, 12), st.integers(1, 12)),
    steps=st.integers(1, 3),
    seed=st.integers(0, 10_000),
)
def test_features_that_couple_states_and_controls_equal_the_reference(agents, horizon, own, stride, ends, steps, seed):
    torch.manual_seed(seed)
    scene = random_scene(2, agents, history=2, size=1.0, dtype=torch.float64)
    scene.agent_mask[1, 1:2] = False
    if ends is not None:
        scene = dataclasses.replace(scene, game_steps=torch.tensor(ends).clamp_max(horizon))
    energy, parameters = coupled(scene, horizon, own, pair_stride=stride)
    damping = torch.full((2, 2), 3.0, dtype=torch.float64)
    ours, theirs = leaves_of(parameters), leaves_of(parameters)
    solution = assisted.solve(energy, scene, ours, steps, 0.5, damping, keep_iterates=True)
    present = scene.agent_mask[:, None, :, None, None]
    expected = [torch.where(present, u, 0.0) for u in reference(energy, scene, theirs, steps, 0.5, damping)]
    assert (solution.status == Status.SOLVED).all()
    for mine, iterate in zip(solution.iterates, expected, strict=True):
        torch.testing.assert_close(mine, iterate, rtol=0, atol=1e-9)
    torch.testing.assert_close(solution.initial_energy, energy(scene, parameters, expected[0]))
    torch.testing.assert_close(solution.energy, energy(scene, parameters, expected[-1]))
    end = expected[-1].detach().requires_grad_()
    (slope,) = torch.autograd.grad(energy(scene, parameters, end).sum(), end)
    torch.testing.assert_close(solution.gradient_norm, slope.flatten(2).norm(dim=-1), rtol=1e-8, atol=1e-8)
    weigh = torch.randn_like(solution.states), torch.randn_like(expected[0]), torch.randn_like(expected[0])
    states = energy.dynamics.rollout(energy.current_states(scene), expected[-1], scene.dt)
    torch.testing.assert_close(torch.where(present, solution.states - states, 0.0), torch.zeros_like(states))
    for last, x, middle in (
        (solution.controls, solution.states, solution.iterates[1]),
        (expected[-1], states, expected[1]),
    ):
        (present * (x * weigh[0]).sum(-1, keepdim=True)).sum().backward(retain_graph=True)
        ((last * weigh[1]).sum() + (middle * weigh[2]).sum()).backward()
    exact = gradients(theirs)
    for name, gradient in gradients(ours).items():
        scale = exact[name].abs().max().clamp_min(1.0) if exact[name].numel() else 1.0
        torch.testing.assert_close(gradient / scale, exact[name] / scale, rtol=0, atol=1e-9, msg=name)


def test_the_solver_takes_it_for_functions_of_single_steps():
    scene = random_scene(3, 2, history=2)
    energy, parameters = coupled(scene, 8)
    assert backends.choose("auto", energy, scene, parameters, fixed=True) is assisted
    assert backends.choose("compiled", energy, scene, parameters) is assisted
    assert backends.choose("pytorch", energy, scene, parameters) is structured
    assert backends.choose("auto", FeatureEnergy(["acc"]), scene, parameters) is compiled
    with pytest.warns(UserWarning, match="Plain PyTorch does the same"):
        assert backends.choose("auto", energy, scene, parameters, exact=True) is structured
    found, plain = (LevenbergMarquardt(backend=name)(energy, scene, parameters) for name in ("auto", "pytorch"))
    assert found.controls.dtype == torch.float32
    torch.testing.assert_close(found.controls, plain.controls, rtol=0, atol=5e-5)


@pytest.mark.parametrize(
    ("own", "pair", "reason"),
    [
        (["my acc"], [], "needs a built-in feature beside those of the user"),
        (["acc", "whole"], [], r"does not know the feature 'whole'; it takes functions of single steps .*Source\.STEP"),
        (["acc", "my acc"], ["soft"], "does not know the pair feature 'soft'"),
    ],
)
def test_games_that_it_cannot_solve_have_a_reason(own, pair, reason):
    scene = random_scene(2, 2, history=2)
    energy, game = FeatureEnergy(own, pair), random_game(scene)
    with pytest.raises(ValueError, match=rf"solver\.backend is 'compiled', but .*{reason}"):
        backends.choose("compiled", energy, scene, game)


@pytest.mark.parametrize("held", [False, True])
def test_adaptive_steps_equal_those_of_pytorch(held):
    scene = random_scene(3, 3, history=2, size=1.0, dtype=torch.float64)
    energy, parameters = coupled(scene, 8)
    damping = torch.full((3, 2, 3), 5.0, dtype=torch.float64)
    damping[:, :, 1] = torch.inf if held else 5.0
    found, plain = (
        LevenbergMarquardt(adaptive=True, step_size=1.0, backend=name).run(energy, scene, parameters, 6, damping)
        for name in ("auto", "pytorch")
    )
    torch.testing.assert_close(found[0].controls, plain[0].controls, rtol=0, atol=1e-8)
    torch.testing.assert_close(found[0].energy, plain[0].energy)
    assert torch.equal(found[1], plain[1]), "the damping that the steps end with"
    if held:
        assert torch.equal(found[0].controls[:, :, 1], parameters.initial_controls[:, :, 1])


def test_a_weight_that_alone_has_a_gradient():
    scene = random_scene(2, 1, history=2, dtype=torch.float64)
    energy, parameters = coupled(scene, 6)

    def end(weight: torch.Tensor) -> torch.Tensor:
        weights = parameters.own_weights | {"drift": weight}
        return LevenbergMarquardt(damping=1.0)(
            energy, scene, dataclasses.replace(parameters, own_weights=weights)
        ).states

    assert torch.autograd.gradcheck(end, parameters.own_weights["drift"].clone().requires_grad_())


def test_a_weight_of_all_modes_together_is_refused():
    scene = random_scene(2, 1, history=2)
    energy, parameters = coupled(scene, 6)
    weights = parameters.own_weights | {"drift": parameters.own_weights["drift"][:, :1]}
    game = dataclasses.replace(parameters, own_weights=weights)
    with pytest.raises(ValueError, match=r"weights of the shape \[2, 1, 1\] for controls of \[2, 2, 1, 6, 2\]"):
        assisted.solve(energy, scene, game, 1, 0.3, torch.ones(2, 2))


def test_a_bad_weight_stops_its_own_game():
    scene = random_scene(4, 2, history=2)
    energy, parameters = coupled(scene, 8)
    sound = LevenbergMarquardt()(energy, scene, parameters)
    parameters = parameters.map(torch.clone)
    parameters.own_weights["drift"][2] = torch.nan
    leaves = leaves_of(parameters)
    solution = LevenbergMarquardt()(energy, scene, leaves)
    assert solution.status.tolist() == [[0, 0], [0, 0], [2, 2], [0, 0]]
    assert torch.equal(solution.controls[[0, 1, 3]], sound.controls[[0, 1, 3]])
    assert torch.equal(solution.controls[2], parameters.initial_controls[2])
    solution.controls.sum().backward()
    assert all(gradient.isfinite().all() for gradient in gradients(leaves).values())


def test_a_tensor_that_is_changed_before_the_backward_pass_is_an_error():
    scene = random_scene(2, 2, history=2)
    energy, parameters = coupled(scene, 6)
    leaves = leaves_of(parameters)
    solution = LevenbergMarquardt()(energy, scene, leaves)
    with torch.no_grad():
        leaves.own_weights["hurry"].add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        solution.controls.sum().backward()
