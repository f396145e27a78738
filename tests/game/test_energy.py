"""The energy against plain arithmetic, its Gauss-Newton model against automatic differentiation."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import pytest
import torch
from games import ALL, BOUNDS, pad, random_game, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import Energy
from epo_lightning.game.features import proximity
from epo_lightning.game.normal_equations import normal_equations
from epo_lightning.registry import ConfigError
from epo_lightning.scene import GameParameters, Scene


def stacked(energy, scene, parameters, controls):
    return torch.cat([r.flatten(2) for r in energy.residuals(scene, parameters, controls).values()], -1)


def dense_jacobian(energy, scene, parameters, controls):
    """[B, M, R, n] by forward-mode automatic differentiation; samples are independent, so one sum serves all."""
    jacobian = torch.func.jacfwd(lambda u: stacked(energy, scene, parameters, u).sum((0, 1)))(controls)
    return jacobian.permute(1, 2, 0, 3, 4, 5).flatten(3)


def slow_energy(scene, parameters, controls, b, m):
    """Eqs. 10 and 11 for one scene and mode with every feature, written out."""
    own, dt, total = parameters.own_weights, scene.dt, 0.0
    paths = []
    for i in range(scene.history.shape[1]):
        x, y, theta, v = scene.current[b, i].tolist()
        u = controls[b, m, i].tolist()
        path, signals = [], {"acc": [c[0] for c in u], "turnr": [c[1] for c in u], "vel": []}
        for a, w in u:
            x, y, theta, v = x + v * math.cos(theta) * dt, y + v * math.sin(theta) * dt, theta + w * dt, v + a * dt
            path.append((x, y))
            signals["vel"].append(v)
        signals["jerk"] = [(b[0] - a[0]) / dt for a, b in pairwise(u)]
        signals["turnacc"] = [(b[1] - a[1]) / dt for a, b in pairwise(u)]
        for name, values in signals.items():
            low, high = BOUNDS[name]
            total += 0.5 * sum((own[name][b, m, i].item() * z) ** 2 for z in values)
            total += 0.5 * sum((own[name + "b"][b, m, i].item() * max(0, z - high, low - z)) ** 2 for z in values)
        goal = parameters.goals[b, m, i].tolist()
        total += 0.5 * own["goal"][b, m, i].item() ** 2 * ((x - goal[0]) ** 2 + (y - goal[1]) ** 2)
        paths.append(path)
    pair = 0
    for i in range(len(paths)):
        for j in range(i + 1, len(paths)):
            reach = (scene.size[b, i, 0] + scene.size[b, j, 0]).item() / 2
            w = parameters.pair_weights["proximity"][b, m, pair].item()
            total += 0.5 * sum(
                (w * max(0.0, reach - math.dist(p, q))) ** 2 for p, q in zip(paths[i], paths[j], strict=True)
            )
            pair += 1
    return total


def test_energy_equals_plain_arithmetic():
    scene = random_scene(2, 3, size=2.0, dtype=torch.float64)
    parameters = random_game(scene)
    energy = Energy(ALL, bounds=BOUNDS)
    value = energy(scene, parameters, parameters.initial_controls)
    for b in range(2):
        for m in range(2):
            expected = slow_energy(scene, parameters, parameters.initial_controls, b, m)
            assert value[b, m].item() == pytest.approx(expected, rel=1e-12)
    residuals = energy.residuals(scene, parameters, parameters.initial_controls)
    assert all((residuals[name] != 0).any() for name in (*ALL, "proximity")), "every hinge should be active somewhere"


@settings(max_examples=30, deadline=None)
@given(
    agents=st.integers(1, 4),
    modes=st.integers(1, 3),
    horizon=st.integers(2, 8),
    own=st.sets(st.sampled_from(ALL), min_size=1),
    size=st.sampled_from([0.01, 2.0]),
    integrator=st.sampled_from(["euler", "semi_implicit", "heun"]),
    seed=st.integers(0, 1000),
)
def test_normal_equations_equal_automatic_differentiation(agents, modes, horizon, own, size, integrator, seed):
    torch.manual_seed(seed)
    scene = random_scene(2, agents, history=2, size=size, dtype=torch.float64)
    parameters = random_game(scene, modes, horizon)
    energy = Energy(sorted(own), bounds=BOUNDS, dynamics=Unicycle(integrator))
    controls = parameters.initial_controls
    jacobian = dense_jacobian(energy, scene, parameters, controls)
    residual = stacked(energy, scene, parameters, controls)[..., None]
    gradient, matrix = normal_equations(energy, scene, parameters, controls)
    scale = matrix.abs().max().clamp_min(1.0).item()
    torch.testing.assert_close(matrix, jacobian.mT @ jacobian, rtol=0, atol=1e-11 * scale)
    torch.testing.assert_close(gradient.flatten(2), (jacobian.mT @ residual)[..., 0], rtol=0, atol=1e-11 * scale)

    directions = torch.randn(2, *controls.shape, dtype=torch.float64)
    residuals, changes = energy.linearisation(scene, parameters, controls, directions)
    torch.testing.assert_close(residuals, residual[..., 0], rtol=0, atol=0)
    expected = (jacobian @ directions.flatten(3)[..., None])[..., 0]
    torch.testing.assert_close(changes, expected, rtol=0, atol=1e-11 * scale)


def test_absent_agents_change_nothing_whatever_they_hold():
    scene = random_scene(2, 2, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, own=ALL)
    energy = Energy(ALL, bounds=BOUNDS)
    padded = pad(scene, agents=2)
    nan = torch.full((2, 2, 2), torch.nan, dtype=torch.float64)
    pair = torch.full((2, 2, 6), torch.nan, dtype=torch.float64)
    pair[..., 0] = parameters.pair_weights["proximity"][..., 0]  # the pair (0, 1) comes first
    wide = GameParameters(
        own_weights={name: torch.cat((w, nan), -1) for name, w in parameters.own_weights.items()},
        pair_weights={"proximity": pair},
        initial_controls=torch.cat((parameters.initial_controls, nan[..., None, None].expand(2, 2, 2, 7, 2)), 2),
        goals=torch.cat((parameters.goals, nan[..., None].expand(2, 2, 2, 2)), 2),
    )
    alone = energy(scene, parameters, parameters.initial_controls)
    together = energy(padded, wide, wide.initial_controls)
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-12)


def test_coincident_agents_have_a_finite_energy_and_a_gradient_of_zero():
    point = torch.zeros(1, 3, 2, dtype=torch.float64, requires_grad=True)
    depth, normal, active = proximity(point, point.detach(), torch.tensor([[0.5]], dtype=torch.float64))
    assert (depth == 0.5).all()
    assert (normal == 0).all()
    assert active.all()
    depth.sum().backward()
    assert (point.grad == 0).all()


def test_touching_is_not_active():
    apart = torch.tensor([[[0.5, 0.0]]])
    depth, _, active = proximity(apart, torch.zeros(1, 1, 2), torch.tensor([[0.5]]))
    assert depth.item() == 0
    assert not active.any()


def test_the_potential_is_each_agents_own_cost_up_to_what_the_agent_cannot_change():
    """The defining property of a potential game: dE/du_i is the gradient of agent i's own terms and its pairs."""
    scene = random_scene(1, 3, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene)
    energy = Energy(ALL, bounds=BOUNDS)
    controls = parameters.initial_controls.clone().requires_grad_()
    (of_potential,) = torch.autograd.grad(energy(scene, parameters, controls).sum(), controls)
    terms = energy.terms(scene, parameters, controls)
    members = [(0, 1), (0, 2), (1, 2)]
    for agent in range(3):
        cost = sum(terms[name][..., agent].sum() for name in ALL)
        cost = cost + sum(terms["proximity"][..., p].sum() for p, both in enumerate(members) if agent in both)
        (of_agent,) = torch.autograd.grad(cost, controls, retain_graph=True)
        torch.testing.assert_close(of_agent[:, :, agent], of_potential[:, :, agent], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"own": ["gaol"]}, "did you mean 'goal'"),
        ({"own": ["goal"], "pair": ["proximty"]}, "did you mean 'proximity'"),
        ({"own": "goal"}, "takes a list"),
        ({"own": ["goal", "goal"]}, "twice"),
        ({"own": [], "pair": []}, "at least one feature"),
        ({"own": ["velb"]}, "needs energy.bounds.vel"),
        ({"own": ["vel"], "bounds": {"velocity": (0.0, 1.0)}}, "unknown signal energy.bounds.velocity"),
        ({"own": ["velb"], "bounds": {"vel": (1.0, 0.0)}}, r"must be \[lowest, highest\]"),
    ],
)
def test_bad_energies_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        Energy(**arguments)


def replaced(parameters, **changes):
    return dataclasses.replace(parameters, **changes)


def test_shapes_that_do_not_fit_are_refused_by_name():
    scene = random_scene(2, 2)
    parameters = random_game(scene)
    energy = Energy(ALL, bounds=BOUNDS)
    controls = parameters.initial_controls
    with pytest.raises(ValueError, match="controls have shape"):
        energy.validate(scene, parameters, controls[:1])
    with pytest.raises(ValueError, match="at least 2"):
        energy.validate(scene, parameters, controls[..., :1, :])
    with pytest.raises(ValueError, match="own_weights lacks the feature 'jerk'"):
        fewer = {name: w for name, w in parameters.own_weights.items() if name != "jerk"}
        energy.validate(scene, replaced(parameters, own_weights=fewer), controls)
    with pytest.raises(ValueError, match=r"own_weights\['vel'\] has shape \[2, 1, 2\]"):
        weights = {**parameters.own_weights, "vel": parameters.own_weights["vel"][:, :1]}
        energy.validate(scene, replaced(parameters, own_weights=weights), controls)
    with pytest.raises(ValueError, match=r"parameters\.goals is None"):
        energy.validate(scene, replaced(parameters, goals=None), controls)
    with pytest.raises(ValueError, match=r"scene\.size"):
        energy.validate(Scene(scene.history, scene.dt), parameters, controls)
