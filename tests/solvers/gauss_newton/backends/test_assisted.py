"""Tests of the compiled backend with features of the user: the suite of all backends, and features that couple more."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping

import pytest
import torch
from backends import BackendSuite, gradients, reference
from games import BOUNDS, leaves_of, random_game, random_scene
from hypothesis import example, given, settings
from hypothesis import strategies as st

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import ACCELERATION, HEADING, SPEED, TURN_RATE, Scene, X, Y
from epo_lightning.solvers.gauss_newton import implicit
from epo_lightning.solvers.gauss_newton.backends import assisted, choice, compiled, pytorch
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general import dense
from epo_lightning.solvers.general.dense import hessian

if isinstance(interface.find(), str) and shutil.which("c++") is None:
    pytest.skip("there is no C++ compiler on this machine, so the kernel was not built", allow_module_level=True)

TWINS = {"acc": "my acc", "vel": "my vel", "turnr": "my turnr"}
"""Built-in own features, and the same as functions of the user."""
PAIR_TWINS = {name: f"my {name}" for name in ("proximity", "clearance", "circles", "headway")}
"""The same for pairs."""
COUPLED = ("drift", "hurry", "detour")
COUPLED_PAIRS = ("soft", "drawn apart", "room")


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

    pair_feature("my proximity", Source.DISTANCE)(PAIR_FEATURES["proximity"].function)
    pair_feature("my clearance", Source.DISTANCE, margin=True)(PAIR_FEATURES["clearance"].function)
    pair_feature("my circles", Source.STEP, needs="size")(PAIR_FEATURES["circles"].function)
    pair_feature("my headway", Source.STEP, needs="size", margin=True)(PAIR_FEATURES["headway"].function)
    pair_feature("soft", Source.DISTANCE)(lambda distance, reach: (reach - distance).exp())
    pair_feature("aligned", Source.STEP)(lambda one, other: 2.0 + (one[..., HEADING] - other[..., HEADING]).cos())

    @pair_feature("drawn apart", Source.STEP)
    def drawn_apart(one, other):
        """Of any range, and of the other sign if the agents are swapped."""
        ahead = one[..., SPEED] * one[..., HEADING].cos() - other[..., SPEED] * other[..., HEADING].cos()
        return 0.2 * ahead + 0.1 * (one[..., X] - other[..., X]) * (one[..., Y] + other[..., Y])

    @pair_feature("room", Source.STEP, needs="size", margin=True)
    def room(one, other, size, other_size, margin):
        """Of a short range."""
        away = (one[..., :2] - other[..., :2]).square().sum(-1)
        return ((size + other_size).sum(-1) + margin - away).relu() * (1.0 + one[..., SPEED] + other[..., SPEED])

    own_feature("whole")(lambda states, controls: states[..., SPEED].diff(dim=-1))
    pair_feature("whole pair")(lambda one, other: one[..., SPEED].diff(dim=-1) - other[..., SPEED].diff(dim=-1))
    yield
    for name in (*TWINS.values(), *COUPLED, "whole"):
        del OWN_FEATURES[name]
    for name in (*PAIR_TWINS.values(), *COUPLED_PAIRS, "aligned", "whole pair"):
        del PAIR_FEATURES[name]


def exchanged(named: Mapping[str, torch.Tensor], twins: Mapping[str, str]) -> dict[str, torch.Tensor]:
    return {twins.get(name, name): tensor for name, tensor in named.items()}


def with_twins(energy, scene, parameters, *given, **options):
    """The solution of a game whose features were exchanged for their twins."""
    own, pair = [TWINS.get(name, name) for name in energy.own], [PAIR_TWINS.get(name, name) for name in energy.pair]
    energy = dataclasses.replace(energy, own=own, pair=pair, margins=exchanged(energy.margins, PAIR_TWINS))
    parameters = dataclasses.replace(
        parameters,
        own_weights=exchanged(parameters.own_weights, TWINS),
        pair_weights=exchanged(parameters.pair_weights, PAIR_TWINS),
        margins=exchanged(parameters.margins, PAIR_TWINS),
    )
    helped = assisted.obstacle(energy, scene, parameters) is None
    return (assisted if helped else pytorch).solve(energy, scene, parameters, *given, **options)


class TestAssisted(BackendSuite):
    solve = staticmethod(with_twins)


def small_scene(agents: int, ends: tuple[int, int] | None) -> Scene:
    """Two scenes; in the second one, the second agent is absent."""
    scene = random_scene(2, agents, history=2, size=1.0, dtype=torch.float64)
    scene.agent_mask[1, 1:2] = False
    return scene if ends is None else dataclasses.replace(scene, game_steps=torch.tensor(ends))


def coupled(
    scene: Scene,
    horizon: int,
    own: tuple[str, ...] = ("acc", "goal", *COUPLED),
    pair: tuple[str, ...] = (),
    **settings: object,
) -> tuple[FeatureEnergy, GameParameters]:
    game = random_game(scene, 2, horizon, pair=pair)
    weights = game.own_weights | {name: 0.2 + torch.rand_like(game.own_weights["acc"]) for name in COUPLED}
    return FeatureEnergy(own, pair, BOUNDS, **settings), dataclasses.replace(game, own_weights=weights)


@settings(max_examples=40)
@given(
    agents=st.integers(1, 4),
    horizon=st.integers(2, 12),
    own=st.sampled_from([("acc",), ("goal", "steer", "jerk", "lane"), ("turnacc", "velb", "heading")]),
    pair=st.sampled_from([(), COUPLED_PAIRS, ("proximity", "drawn apart"), ("room",), ("soft", "longitudinal")]),
    both=st.booleans(),
    fixed=st.booleans(),
    stride=st.sampled_from([1, 2]),
    ends=st.none() | st.tuples(st.integers(1, 12), st.integers(1, 12)),
    steps=st.integers(1, 3),
    seed=st.integers(0, 10_000),
)
def test_features_that_couple_states_and_controls_equal_the_reference(
    agents, horizon, own, pair, both, fixed, stride, ends, steps, seed
):
    torch.manual_seed(seed)
    scene = small_scene(agents, None if ends is None else (min(ends[0], horizon), min(ends[1], horizon)))
    margins = {"room": 0.7} if fixed and "room" in pair else {}
    own = (*own, *COUPLED) if both or not pair else own
    energy, parameters = coupled(scene, horizon, own, pair, pair_stride=stride, margins=margins)
    damping = torch.full((2, 2), 3.0, dtype=torch.float64)
    ours, theirs = leaves_of(parameters), leaves_of(parameters)
    solution = assisted.solve(energy, scene, ours, steps, 0.5, damping, keep_iterates=True)
    present = scene.agent_mask[:, None, :, None, None]
    expected = [torch.where(present, u, 0.0) for u in reference(energy, scene, theirs, steps, 0.5, damping)]
    assert (solution.status == Status.COMPLETED).all()
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


def newton_step(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, damping: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The controls after a step of the length 0.7 with a dense Hessian, and whether the damped matrix is definite."""
    start = parameters.initial_controls
    matrix = hessian(energy, scene, parameters, start) + damping * torch.eye(start[0, 0].numel(), dtype=torch.float64)
    definite = torch.linalg.eigvalsh(matrix).amin(-1) > 0
    leaf = start.clone().requires_grad_()
    (slope,) = torch.autograd.grad(energy(scene, parameters, leaf).sum(), leaf)
    step = torch.linalg.solve(matrix, slope.flatten(2)[..., None]).view_as(start)
    return torch.where(scene.agent_mask[:, None, :, None, None], start - 0.7 * step, 0.0), definite


@settings(max_examples=25)
@given(
    agents=st.integers(1, 3),
    pair=st.sampled_from([(), COUPLED_PAIRS, ("proximity", "drawn apart")]),
    own=st.sampled_from([COUPLED, ("hurry",), ()]),
    stride=st.sampled_from([1, 2]),
    ends=st.none() | st.tuples(st.integers(2, 6), st.integers(2, 6)),
    seed=st.integers(0, 10_000),
)
@example(agents=3, pair=COUPLED_PAIRS, own=COUPLED, stride=1, ends=None, seed=322)  # one game needs more damping
def test_newton_steps_equal_those_of_a_dense_hessian(agents, pair, own, stride, ends, seed):
    torch.manual_seed(seed)
    scene = small_scene(agents, ends)
    energy, parameters = coupled(
        scene, 6, ("acc", "goal", *(own if own or pair else COUPLED)), pair, pair_stride=stride
    )
    damping = torch.full((2, 2), 300.0, dtype=torch.float64)
    found = assisted.solve(energy, scene, parameters, 1, 0.7, damping, exact=True)
    expected, definite = newton_step(energy, scene, parameters, 300.0)
    assert torch.equal(found.status, torch.where(definite, Status.COMPLETED, Status.DAMPED))
    again, enough = newton_step(energy, scene, parameters, 300.0 + 10 * 300.0)  # the second attempt
    assert enough.all()
    expected = torch.where(definite[..., None, None, None], expected, again)
    torch.testing.assert_close(found.controls, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", [assisted, pytorch])
def test_newton_steps_couple_agents_by_second_derivatives_alone(backend):
    scene = small_scene(2, None)
    scene.history[..., HEADING] = 0.5
    energy, parameters = coupled(scene, 6, pair=("aligned",))
    parameters.initial_controls[..., TURN_RATE] = 0.0
    damping = torch.full((2, 2), 300.0, dtype=torch.float64)
    found = backend.solve(energy, scene, parameters, 1, 0.7, damping, exact=True)
    expected, _ = newton_step(energy, scene, parameters, 300.0)
    torch.testing.assert_close(found.controls, expected, rtol=0, atol=1e-9)


@settings(max_examples=15)
@given(
    agents=st.integers(1, 3),
    pair=st.sampled_from([(), COUPLED_PAIRS, ("proximity", "drawn apart")]),
    exact=st.booleans(),
    ends=st.none() | st.tuples(st.integers(2, 6), st.integers(2, 6)),
    seed=st.integers(0, 10_000),
)
@example(agents=3, pair=(), exact=False, ends=(5, 5), seed=8363)  # a game that needs more than 30 Newton steps
def test_derivatives_of_minima_equal_those_of_dense_matrices(agents, pair, exact, ends, seed):
    torch.manual_seed(seed)
    scene = small_scene(agents, ends)
    energy, parameters = coupled(scene, 6, ("acc", "turnr", "goal", *COUPLED), pair)
    solver = LevenbergMarquardt(steps=10, newton_steps=300, step_size=1.0, damping=1.0, adaptive=True)
    with torch.no_grad():
        minimum = solver(energy, scene, parameters)
    assert minimum.gradient_norm.max() < 1e-5
    weigh = torch.randn_like(minimum.controls)
    found = []
    for attach in (implicit.attach, dense.attach):
        leaves = leaves_of(parameters)
        # The descent may have begun from the same controls in all modes.
        begun = dataclasses.replace(leaves, initial_controls=leaves.initial_controls[:, :1])
        controls, status = attach(energy, scene, begun, minimum.controls, exact)
        assert torch.equal(controls.detach(), minimum.controls)
        (controls * weigh).sum().backward()
        found.append((status, gradients(leaves)))
    assert torch.equal(found[0][0], found[1][0])
    for name, gradient in found[0][1].items():
        torch.testing.assert_close(gradient, found[1][1][name], rtol=1e-6, atol=1e-8, msg=name)


def test_the_solver_takes_it_for_functions_of_single_steps():
    scene = random_scene(3, 2, history=2)
    energy, parameters = coupled(scene, 8)
    assert choice.choose("auto", energy, scene, parameters, fixed=True) is assisted
    assert choice.choose("compiled", energy, scene, parameters) is assisted
    assert choice.choose("pytorch", energy, scene, parameters) is pytorch
    assert choice.choose("auto", FeatureEnergy(["acc"]), scene, parameters) is compiled
    found, plain = (LevenbergMarquardt(backend=name)(energy, scene, parameters) for name in ("auto", "pytorch"))
    assert found.controls.dtype == torch.float32
    torch.testing.assert_close(found.controls, plain.controls, rtol=0, atol=5e-5)


@pytest.mark.parametrize(
    ("own", "pair", "reason"),
    [
        (["my acc"], [], "needs a built-in feature beside those of the user"),
        (["acc", "whole"], [], r"does not know the feature 'whole'; it takes functions of single steps .*Source\.STEP"),
        (["acc", "my acc"], ["soft", "whole pair"], "does not know the feature 'whole pair'"),
    ],
)
def test_games_that_it_cannot_solve_have_a_reason(own, pair, reason):
    scene = random_scene(2, 2, history=2)
    energy, game = FeatureEnergy(own, pair), random_game(scene)
    with pytest.raises(ValueError, match=rf"solver\.backend is 'compiled', but .*{reason}"):
        choice.choose("compiled", energy, scene, game)


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


@pytest.mark.parametrize(("steps", "exact"), [(0, False), (2, False), (1, True)])
def test_an_input_that_the_function_hides_stops_its_game(steps, exact):
    scene = random_scene(3, 3, history=2, size=1.0)
    energy, parameters = coupled(scene, 6, pair=("room",))
    parameters = parameters.map(torch.clone)
    parameters.margins["room"][1, 0] = -torch.inf  # no residual is left
    leaves = leaves_of(parameters)
    found = assisted.solve(energy, scene, leaves, steps, 0.3, torch.full((3, 2), 100.0), exact=exact)
    assert found.status.tolist() == [[Status.COMPLETED] * 2, [Status.STOPPED, Status.COMPLETED], [Status.COMPLETED] * 2]
    assert torch.equal(found.controls[1, 0], parameters.initial_controls[1, 0])
    if steps and not exact:
        found.controls.sum().backward()
        assert not any(weight.grad[1, 0].any() for weight in leaves.own_weights.values() if weight.grad is not None)
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
