"""The neural energy against plain arithmetic and finite differences, and for agents that coincide."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.networks import encounter
from epo_lightning.game.neural_energy import NeuralEnergy
from epo_lightning.registry import ConfigError

WIDTH, HORIZON, SCALE = 3, 4, 2.0


def drawn(agents=3, scenes=1, modes=2):
    """An energy in double precision, a scene and a game, with half a second between steps."""
    scene = dataclasses.replace(random_scene(scenes, agents, history=2, dtype=torch.float64), dt=0.5)
    game = random_game(scene, modes, HORIZON, own=())
    context = torch.randn(scenes, agents, WIDTH, dtype=torch.float64)
    energy = NeuralEnergy(Unicycle(), WIDTH, HORIZON, SCALE, hidden=5).double()
    return energy, scene, dataclasses.replace(game, context=context, pair_weights={})


def silu(values):
    return [value / (1.0 + math.exp(-value)) for value in values]


def linear(values, weight, bias=None):
    added = [0.0] * len(weight) if bias is None else bias
    return [sum(w * v for w, v in zip(row, values, strict=True)) + b for row, b in zip(weight, added, strict=True)]


def layers(weights, name, *inputs):
    """The first linear layer of all inputs in one row, and the second."""
    rows = zip(*(weights[f"{name}.first.{number}.weight"] for number in range(len(inputs))), strict=True)
    joined = [[w for part in row for w in part] for row in rows]
    hidden = silu(linear([v for values in inputs for v in values], joined, weights[f"{name}.first.0.bias"]))
    return silu(linear(hidden, weights[f"{name}.second.weight"], weights[f"{name}.second.bias"]))


def seen(point, pose):
    x, y, heading = point[0] - pose[0], point[1] - pose[1], pose[2]
    ahead, left = (math.cos(heading), math.sin(heading)), (-math.sin(heading), math.cos(heading))
    return [(x * axis[0] + y * axis[1]) / SCALE for axis in (ahead, left)]


def slow_energy(energy, scene, game, b, m):
    """The energy of one scene and mode in plain arithmetic."""
    weights = {name: value.tolist() for name, value in energy.state_dict().items()}
    paths, features, total = [], [], 0.0
    for i in range(scene.history.shape[1]):
        x, y, theta, v = start = scene.current[b, i].tolist()
        path, motion = [], []
        for a, w in game.initial_controls[b, m, i].tolist():
            x, y = x + v * math.cos(theta) * scene.dt, y + v * math.sin(theta) * scene.dt
            theta, v = theta + w * scene.dt, v + a * scene.dt
            path.append((x, y, theta))
            turned = theta - start[2]
            motion += [*seen((x, y), start), math.cos(turned), math.sin(turned), v / SCALE]
        paths.append(path)
        features.append(layers(weights, "embedding", game.context[b, i].tolist(), motion))
        total += linear(features[i], weights["own_value.weight"])[0]

    def one_way(i, j):
        distances = [math.dist(p[:2], q[:2]) for p, q in zip(paths[i], paths[j], strict=True)]
        step = min(range(HORIZON), key=distances.__getitem__)
        turned = paths[j][-1][2] - paths[i][-1][2]
        meeting = [distances[step] / SCALE, (step + 1) / HORIZON, math.cos(turned), math.sin(turned)]
        meeting = [*seen(paths[j][-1], paths[i][-1]), *meeting]
        hidden = layers(weights, "interaction", features[i], features[j], meeting)
        return linear(hidden, weights["pair_value.weight"])[0]

    for i in range(len(paths)):
        for j in range(i):
            total += 0.5 * (one_way(i, j) + one_way(j, i))
    return total


@settings(max_examples=15)
@given(agents=st.integers(1, 4), seed=st.integers(0, 1000))
def test_the_energy_equals_plain_arithmetic(agents, seed):
    torch.manual_seed(seed)
    energy, scene, game = drawn(agents, scenes=2)
    value = energy(scene, game, game.initial_controls)
    for b in range(2):
        for m in range(2):
            assert value[b, m].item() == pytest.approx(slow_energy(energy, scene, game, b, m), rel=1e-9, abs=1e-12)


def test_gradients_and_hessians_equal_finite_differences():
    energy, scene, game = drawn(agents=2, modes=1)

    def value(controls, context):
        return energy(scene, dataclasses.replace(game, context=context), controls).sum()

    inputs = [tensor.clone().requires_grad_() for tensor in (game.initial_controls, game.context)]
    assert torch.autograd.gradcheck(value, inputs)
    assert torch.autograd.gradgradcheck(value, inputs)


def test_the_energy_depends_on_every_control():
    """The last position does not depend on the last controls (explicit Euler), but heading and speed do."""
    energy, scene, game = drawn()
    controls = game.initial_controls.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(scene, game, controls).sum(), controls)
    assert (gradient != 0).all()


def test_all_parameters_have_gradients():
    energy, scene, game = drawn()
    energy(scene, game, game.initial_controls).sum().backward()
    for name, parameter in energy.named_parameters():
        assert parameter.grad.abs().max() > 0, name


def test_pair_terms_are_symmetric():
    energy, scene, game = drawn(agents=2)
    states = energy.dynamics.rollout(energy.current_states(scene), game.initial_controls, scene.dt)
    first, second = states[:, :, :1], states[:, :, 1:]
    swapped = dataclasses.replace(scene, history=scene.history.flip(1))
    other = dataclasses.replace(game, context=game.context.flip(1))
    here = energy.pair_terms(scene, game, first, second)["neural_pair"]
    there = energy.pair_terms(swapped, other, second, first)["neural_pair"]
    torch.testing.assert_close(there, here, rtol=0, atol=1e-14)
    embedded = energy.embed(energy.context(scene, game), states, energy.current_states(scene))
    ours, theirs = embedded[:, :, :1], embedded[:, :, 1:]
    from_one = energy.interaction(ours, theirs, states.new_zeros(1, 2, 1, 6))
    from_other = energy.interaction(theirs, ours, states.new_zeros(1, 2, 1, 6))
    assert (from_one - from_other).abs().max() > 1e-3, "the network alone must not be symmetric, or this shows nothing"


def test_functional_transforms_agree():
    """Solvers differentiate many directions at once, by vmap."""
    energy, scene, game = drawn(agents=2, modes=1)

    def value(controls):
        return energy(scene, game, controls).sum()

    expected = torch.autograd.functional.hessian(value, game.initial_controls)
    torch.testing.assert_close(torch.func.hessian(value)(game.initial_controls), expected, rtol=0, atol=1e-12)
    twice = torch.func.jacrev(torch.func.grad(value))(game.initial_controls)
    torch.testing.assert_close(twice, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("still", [False, True])
def test_where_agents_coincide_gradients_and_hessians_are_finite(still):
    energy, scene, game = drawn(agents=2, modes=1)
    history = scene.history[:, :1].expand(-1, 2, -1, -1).clone()
    controls = game.initial_controls[:, :, :1].expand(-1, -1, 2, -1, -1).clone()
    if still:
        history[..., 3], controls[:] = 0.0, 0.0
    together = dataclasses.replace(scene, history=history)
    function = lambda u: energy(together, game, u).sum()  # noqa: E731
    gradient = torch.autograd.functional.jacobian(function, controls)
    hessian = torch.autograd.functional.hessian(function, controls)
    assert gradient.isfinite().all()
    assert hessian.isfinite().all()
    assert hessian.abs().max() > 0


def test_the_first_of_equally_near_steps_counts():
    """Agents side by side at one speed are equally near all the time."""
    states = torch.zeros(2, HORIZON, 4, dtype=torch.float64)
    states[..., 0] = torch.arange(HORIZON)
    states[1, :, 1] = 3.0
    met = encounter(states[0], states[1], SCALE)
    expected = torch.tensor([0.0, 3.0 / SCALE, 3.0 / SCALE, 1 / HORIZON, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(met, expected, rtol=0, atol=0)


@pytest.mark.parametrize("hidden", [0, -3])
def test_networks_without_hidden_features_are_refused(hidden):
    with pytest.raises(ConfigError, match=f"energy.hidden must be a whole number, 1 or more, not {hidden}"):
        NeuralEnergy(Unicycle(), WIDTH, HORIZON, SCALE, hidden=hidden)
