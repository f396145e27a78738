"""The PyTorch backend against a dense reference, bit by bit against itself, and without making the host wait."""

from __future__ import annotations

import dataclasses
from functools import partial

import pytest
import torch
from backends import BackendSuite, HostMustNotWait
from games import ALL, BOUNDS, leaves_of, pad, random_game, random_scene, widen
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.forecast import Status
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES, Source, own_feature, pair_feature
from epo_lightning.scene import ACCELERATION, SPEED, TURN_RATE
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.gauss_newton.backends import pytorch
from epo_lightning.solvers.gauss_newton.expansion import expand
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

CURVED = {
    "bent speed": (Source.SPEED, ACCELERATION),
    "bent acceleration": (Source.CONTROL, ACCELERATION),
    "bent rate": (Source.RATE, TURN_RATE),
}


def solve(energy, scene, parameters, steps=2, damping=10.0, **options):
    damping = parameters.initial_controls.new_full(parameters.initial_controls.shape[:2], damping)
    return pytorch.solve(energy, scene, parameters, steps, 0.3, damping, **options)


class TestStructured(BackendSuite):
    solve = staticmethod(pytorch.solve)


def dense(energy, scene, parameters, steps=2, damping=10.0):
    """Reference steps with a dense Jacobian and a differentiable general linear solver."""
    controls = torch.where(scene.agent_mask[:, None, :, None, None], parameters.initial_controls, 0.0)
    unit = torch.eye(controls[0, 0].numel(), dtype=controls.dtype)
    directions = unit.view(-1, 1, 1, *controls.shape[2:]).expand(-1, *controls.shape)
    for _ in range(steps):
        residuals, changes = energy.linearisation(scene, parameters, controls, directions)
        jacobian = changes.permute(1, 2, 0, 3)
        matrix = jacobian @ jacobian.mT + damping * unit
        controls = controls - 0.3 * torch.linalg.solve(matrix, jacobian @ residuals[..., None]).view_as(controls)
    return controls


def with_gradients(solver, parameters):
    """Controls, and the gradients of a fixed random functional of them by everything that is differentiated."""
    leaves = leaves_of(parameters)
    controls = solver(leaves)
    cotangent = torch.randn(controls.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (controls * cotangent.to(controls.dtype)).sum().backward()
    by = [leaves.initial_controls, leaves.goals, *leaves.own_weights.values(), *leaves.pair_weights.values()]
    return controls.detach(), [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in by]


def assert_same(one, other, tolerance):
    torch.testing.assert_close(one[0], other[0], rtol=0, atol=tolerance)
    for analytic, expected in zip(one[1], other[1], strict=True):
        scale = max(1.0, expected.abs().max().item()) if expected.numel() else 1.0
        torch.testing.assert_close(analytic, expected, rtol=0, atol=tolerance * scale)


@st.composite
def sizes(draw):
    """Agents and horizons whose dense reference is not too large."""
    agents = draw(st.integers(1, 8))
    return agents, draw(st.integers(3, max(3, min(40, 72 // agents))))


@settings(max_examples=25)
@given(
    size=sizes(),
    absent=st.integers(0, 2),
    own=st.sets(st.sampled_from(ALL), min_size=1),
    pair=st.sampled_from([(), ("proximity",), ("proximity",), ("circles",)]),
    length=st.sampled_from([0.3, 2.0]),
    integrator=st.sampled_from(["euler", "euler", "heun", "semi_implicit"]),
    stride=st.sampled_from([1, 1, 3]),
    split=st.booleans(),
    slides=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_steps_and_gradients_equal_a_dense_reference(
    size, absent, own, pair, length, integrator, stride, split, slides, seed
):
    torch.manual_seed(seed)
    agents, horizon = size
    scene = random_scene(2, agents, history=2, size=length, dtype=torch.float64)
    scene.size[..., 1] *= 0.4
    parameters = random_game(scene, 2, horizon)
    if pair:
        weights = dict.fromkeys(pair, parameters.pair_weights["proximity"])
        parameters = dataclasses.replace(parameters, pair_weights=weights)
    energy = FeatureEnergy(sorted(own), pair, BOUNDS, Unicycle(integrator), stride, lane_slides=slides)
    expected = with_gradients(lambda leaves: dense(energy, scene, leaves), parameters)
    if absent == 0:
        assert_same(
            with_gradients(lambda leaves: solve(energy, scene, leaves, split=split).controls, parameters),
            expected,
            1e-9,
        )
        return
    wide, padded = widen(parameters, absent), pad(scene, absent)
    controls, gradients = with_gradients(
        lambda leaves: solve(energy, padded, leaves, split=split).controls[:, :, :agents], wide
    )
    _, second = torch.triu_indices(agents + absent, agents + absent, 1)
    real = [gradient[:, :, :agents] for gradient in gradients[:-1]] + [gradients[-1][:, :, second < agents]]
    assert_same((controls, real), expected, 1e-9)
    assert all(gradient.isfinite().all() for gradient in gradients)


def scattered(scenes, agents, dtype=torch.float32):
    """Scenes in which some agents are close to each other, and others alone."""
    scene = random_scene(scenes, agents, history=2, size=1.0, dtype=dtype)
    scene.history[..., 0] += 2.0 * torch.arange(agents)[:, None]
    return scene


@pytest.mark.parametrize("agents", [2, 3, 5])
@pytest.mark.parametrize("horizon", [7, 20])
@pytest.mark.parametrize("make", [scattered, random_scene], ids=["scattered", "together"])
def test_samples_depend_on_neither_batch_nor_padding_to_the_last_bit(agents, horizon, make):
    scene = make(5, agents)
    parameters = random_game(scene, 2, horizon, spread=0.2)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)

    def result(scene, parameters, chosen=slice(None)):
        leaves = leaves_of(parameters)
        solution = solve(energy, scene, leaves)
        solution.states[:, :, :agents].square().sum().backward()
        by = [leaves.initial_controls.grad, leaves.goals.grad, *(weight.grad for weight in leaves.own_weights.values())]
        outcome = [solution.controls, solution.states, *by]
        whole = [solution.energy, solution.gradient_norm, solution.initial_energy]
        return [part.detach()[chosen, :, :agents] for part in outcome] + [part[chosen] for part in whole]

    together = result(scene, parameters)
    for index in range(5):
        alone = result(scene[index], parameters[index])
        assert all(torch.equal(a[0], t[index]) for a, t in zip(alone, together, strict=True))
    padded = result(pad(scene, 3), widen(parameters, 3))
    assert all(torch.equal(p, t) for p, t in zip(padded, together, strict=True))


def test_components_are_those_of_the_active_pairs():
    scene = scattered(20, 6, torch.float64)
    scene.agent_mask[0, 2:] = False
    parameters = random_game(scene, 2, 5)
    parameters.pair_weights["proximity"][:, 1] = 0.0  # no weight, no edge
    energy = FeatureEnergy(["goal"], ["proximity"])
    model = expand(energy, scene, parameters, parameters.initial_controls, every_pair=False)
    groups = pytorch._components(model)
    residuals = energy.residuals(scene, parameters, parameters.initial_controls)["proximity"].flatten(0, 1)
    pairs = torch.triu_indices(6, 6, 1).T.tolist()
    expected = set()
    for sample, active in enumerate((residuals != 0).any(-1).tolist()):
        sets = [{agent} for agent in range(6) if scene.agent_mask[sample // 2, agent]]
        for (i, j), touching in zip(pairs, active, strict=True):
            if touching:
                joined = [s for s in sets if i in s or j in s]
                sets = [s for s in sets if s not in joined] + [set().union(*joined)]
        expected |= {tuple(sorted(sample * 6 + agent for agent in members)) for members in sets}
    found = [tuple(members) for group in groups for members in group.agents.tolist()]
    assert set(found) == expected
    assert len(found) == len(expected)
    assert {group.size for group in groups} >= {1, 2}


@pytest.mark.parametrize(("integrator", "pair"), [("euler", "proximity"), ("heun", "proximity"), ("euler", "circles")])
def test_the_unsplit_path_needs_no_synchronisation_with_the_device(integrator, pair):
    scene = random_scene(3, 3, history=2, size=2.0)
    parameters = random_game(scene)
    weights = {pair: parameters.pair_weights["proximity"]}
    parameters = leaves_of(dataclasses.replace(parameters, pair_weights=weights))
    energy = FeatureEnergy(ALL, [pair], BOUNDS, Unicycle(integrator))
    with HostMustNotWait():
        solve(energy, scene, parameters, split=False).states.sum().backward()
    assert parameters.initial_controls.grad.isfinite().all()
    with pytest.raises(AssertionError, match="makes the host wait"), HostMustNotWait():
        solve(energy, scene, parameters, split=True)


def test_a_sample_without_a_factorisation_stops_alone():
    scene = random_scene(3, 2, history=2)
    parameters = random_game(scene)
    energy = FeatureEnergy(["goal", "acc", "turnr"])
    sound = solve(energy, scene, parameters, damping=0.0, split=False)
    for weight in parameters.own_weights.values():
        weight[1] = 0.0
    leaves = leaves_of(parameters)
    solution = solve(energy, scene, leaves, damping=0.0, split=False)
    assert solution.status[:, 0].tolist() == [Status.COMPLETED, Status.STOPPED, Status.COMPLETED]
    torch.testing.assert_close(solution.controls[[0, 2]], sound.controls[[0, 2]], rtol=0, atol=1e-5)
    assert torch.equal(solution.controls[1], parameters.initial_controls[1])
    solution.controls.sum().backward()
    assert all(weight.grad.isfinite().all() for weight in leaves.own_weights.values() if weight.grad is not None)
    assert (leaves.initial_controls.grad[1] == 1).all()


@pytest.fixture
def twins():
    """A feature of two signals and a pair's, and the same in features that are declared."""
    before = dict(OWN_FEATURES), dict(PAIR_FEATURES)

    @own_feature("both")
    def both(states, controls):
        return torch.cat((states[..., SPEED], controls[..., TURN_RATE], states[..., -1, :2]), -1)

    own_feature("speed", Source.SPEED)(lambda z: z)
    own_feature("turn", Source.CONTROL, TURN_RATE)(lambda z: z)
    for name, (source, channel) in CURVED.items():
        own_feature(name, source, channel)(lambda z: torch.exp(0.3 * z))
    pair_feature("soft", Source.DISTANCE)(lambda distance, reach: torch.exp(reach - distance))

    @pair_feature("soft_undeclared")
    def soft(first, second):
        return torch.exp(1.0 - (first[..., :2] - second[..., :2]).norm(dim=-1))

    yield
    for known, old in zip((OWN_FEATURES, PAIR_FEATURES), before, strict=True):
        for name in set(known) - set(old):
            del known[name]


@pytest.mark.parametrize("split", [True, False])
@pytest.mark.parametrize("stride", [1, 3])
def test_undeclared_features_have_the_solutions_of_declared_ones(twins, split, stride):
    scene = random_scene(2, 3, history=2, size=1.0, dtype=torch.float64)
    parameters = random_game(scene, 2, 6)
    parameters = dataclasses.replace(parameters, goals=torch.zeros_like(parameters.goals))
    weight, pair = parameters.own_weights["acc"], parameters.pair_weights["proximity"]

    def run(own, name):
        game = dataclasses.replace(parameters, own_weights=dict.fromkeys(own, weight), pair_weights={name: pair})
        energy = FeatureEnergy(own, [name], pair_stride=stride)
        controls, by = with_gradients(lambda leaves: solve(energy, scene, leaves, split=split).controls, game)
        return controls, [by[0], sum(by[2:-1]), by[-1]]

    assert_same(run(["both"], "soft_undeclared"), run(["speed", "turn", "goal"], "soft"), 1e-10)


@pytest.mark.parametrize("ends", [None, (3, 5)])
def test_functions_of_signals_have_the_gradients_of_a_dense_reference(twins, ends):
    """Curved functions of speeds, controls and their rates; those of the package are straight on both sides of a bound."""
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    scene = dataclasses.replace(scene, game_steps=None if ends is None else torch.tensor(ends))
    parameters = random_game(scene, 2, 6, own=("acc", *CURVED))
    energy = FeatureEnergy(["acc", *CURVED])
    found = with_gradients(lambda leaves: solve(energy, scene, leaves).controls, parameters)
    assert_same(found, with_gradients(lambda leaves: dense(energy, scene, leaves), parameters), 1e-9)


def test_undeclared_features_have_the_implicit_gradients_of_declared_ones(twins):
    """The exact Hessian: closed forms and second derivatives of declared features against automatic differentiation."""
    scene = random_scene(2, 3, history=2, size=1.0, dtype=torch.float64)
    parameters = random_game(scene, 1, 5, spread=0.1)
    parameters = dataclasses.replace(parameters, goals=torch.zeros_like(parameters.goals))
    weight, pair = parameters.own_weights["acc"], parameters.pair_weights["proximity"]
    minimise = partial(Implicit(), LevenbergMarquardt(60, 1.0, 1e-1, backend="pytorch"))

    def run(own, name):
        own = [*own, "acc"]  # or accelerations would have no minimum
        game = dataclasses.replace(parameters, own_weights=dict.fromkeys(own, weight), pair_weights={name: pair})
        leaves = leaves_of(game)
        solution = minimise(FeatureEnergy(own, [name]), scene, leaves)
        assert solution.gradient_norm.max() < 1e-8
        assert (solution.status == Status.COMPLETED).all()
        solution.states.sum().backward()
        by_own = [leaves.own_weights[one].grad for one in own]
        return solution.controls.detach(), [sum(by_own[:-1]), by_own[-1], leaves.pair_weights[name].grad]

    assert_same(run(["both"], "soft_undeclared"), run(["speed", "turn", "goal"], "soft"), 1e-7)
