"""The energy against plain arithmetic, its Gauss-Newton model against automatic differentiation."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import jaxtyping
import pytest
import torch
from energy_cases import replaced, stacked
from games import ALL, BOUNDS, leaves_of, nearest_points_held, normal_equations, pad, random_game, random_scene, widen
from hypothesis import given, settings
from hypothesis import strategies as st

import epo_lightning
from epo_lightning.game.circles import overlap, separation
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_derivatives import nearest_point, pair_derivatives
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import (
    PAIR_FEATURES,
    Source,
    pair_feature,
)
from epo_lightning.registry import ConfigError, build
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt


class HalfSpeed(Unicycle):
    """Dynamics of the user, derived from those of the features, whose methods the kernels do not call."""


class Unnamed(Energy):
    """An energy of the user that returns a term which it does not name."""

    own, pair, dynamics = ("goal",), (), Unicycle()

    def own_terms(self, scene, parameters, states, controls):
        away = states[..., -1, :2] - parameters.goals
        return {"goal": away.square().sum(-1), "acc": controls[..., 0].square().sum(-1)}

    def pair_terms(self, scene, parameters, first, second):
        return {}


def dense_jacobian(energy, scene, parameters, controls):
    """[B, M, R, n] by forward-mode automatic differentiation; samples are independent, so one sum serves all."""
    with nearest_points_held():
        jacobian = torch.func.jacfwd(lambda u: stacked(energy, scene, parameters, u).sum((0, 1)))(controls)
    return jacobian.permute(1, 2, 0, 3, 4, 5).flatten(3)


def distance_to_segment(point, start, end):
    along = [e - s for s, e in zip(start, end, strict=True)]
    length = sum(c * c for c in along)
    way = sum((p - s) * c for p, s, c in zip(point, start, along, strict=True))
    share = min(1.0, max(0.0, way / length)) if length else 0.0
    return math.dist(point, [s + share * c for s, c in zip(start, along, strict=True)])


def slow_energy(scene, parameters, controls, b, m, stride=1):
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
        start = scene.current[b, i, 3].item()
        wheelbase = 0.6 * scene.size[b, i, 0].item()
        before = [start, *signals["vel"][:-1]]
        signals["steer"] = [math.atan(wheelbase * c[1] / max(z, 1.0)) for c, z in zip(u, before, strict=True)]
        wished = scene.reference_speed[b, i].item()
        signals["velref"] = [z - wished for z in signals["vel"]]
        line = scene.references[b, i, parameters.reference[b, m, i]].tolist()
        signals["lane"] = [min(distance_to_segment(p, *ends) for ends in pairwise(line)) for p in path]
        signals["jerk"] = [(b[0] - a[0]) / dt for a, b in pairwise(u)]
        signals["turnacc"] = [(b[1] - a[1]) / dt for a, b in pairwise(u)]
        chosen = parameters.reference_controls[b, m, i].tolist()
        signals["accref"], signals["turnrref"] = ([c[e] - d[e] for c, d in zip(u, chosen, strict=True)] for e in (0, 1))
        for name, values in signals.items():
            total += 0.5 * sum((own[name][b, m, i].item() * z) ** 2 for z in values)
            if name + "b" not in own:
                continue
            low, high = BOUNDS[name]
            total += 0.5 * sum((own[name + "b"][b, m, i].item() * max(0, z - high, low - z)) ** 2 for z in values)
        goal = parameters.goals[b, m, i].tolist()
        total += 0.5 * own["goal"][b, m, i].item() ** 2 * ((x - goal[0]) ** 2 + (y - goal[1]) ** 2)
        wanted = parameters.goal_headings[b, m, i].item()
        total += 0.5 * (own["heading"][b, m, i].item() * (theta - wanted)) ** 2
        paths.append(path)
    pair = 0
    for i in range(len(paths)):
        for j in range(i + 1, len(paths)):
            reach = (scene.size[b, i, 0] + scene.size[b, j, 0]).item() / 2
            w = parameters.pair_weights["proximity"][b, m, pair].item()
            steps = list(zip(paths[i], paths[j], strict=True))[stride - 1 :: stride]
            total += 0.5 * sum((w * max(0.0, reach - math.dist(p, q))) ** 2 for p, q in steps)
            pair += 1
    return total


@pytest.mark.parametrize("stride", [1, 3])
def test_energy_equals_plain_arithmetic(stride):
    scene = random_scene(2, 3, size=2.0, dtype=torch.float64)
    parameters = random_game(scene)
    scene.references[0, :, :, 3:] = scene.references[0, :, :, 2:3]  # a line with fewer points repeats its last one
    energy = FeatureEnergy(ALL, bounds=BOUNDS, pair_stride=stride)
    value = energy(scene, parameters, parameters.initial_controls)
    for b in range(2):
        for m in range(2):
            expected = slow_energy(scene, parameters, parameters.initial_controls, b, m, stride)
            assert value[b, m].item() == pytest.approx(expected, rel=1e-12)
    residuals = energy.residuals(scene, parameters, parameters.initial_controls)
    assert all((residuals[name] != 0).any() for name in (*ALL, "proximity")), "every hinge should be active somewhere"


@settings(max_examples=30)
@given(
    agents=st.integers(1, 4),
    modes=st.integers(1, 3),
    horizon=st.integers(2, 8),
    own=st.sets(st.sampled_from(ALL), min_size=1),
    size=st.sampled_from([0.01, 2.0]),
    integrator=st.sampled_from(["euler", "semi_implicit", "heun"]),
    stride=st.sampled_from([1, 3]),
    seed=st.integers(0, 1000),
)
def test_normal_equations_equal_automatic_differentiation(agents, modes, horizon, own, size, integrator, stride, seed):
    torch.manual_seed(seed)
    scene = random_scene(2, agents, history=2, size=size, dtype=torch.float64)
    parameters = random_game(scene, modes, horizon)
    stride = min(stride, horizon)
    energy = FeatureEnergy(sorted(own), bounds=BOUNDS, dynamics=Unicycle(integrator), pair_stride=stride)
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


def test_absent_agents_do_not_change_the_energy():
    scene = random_scene(2, 2, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, own=ALL)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    padded, wide = pad(scene, agents=2), widen(parameters)
    alone = energy(scene, parameters, parameters.initial_controls)
    together = energy(padded, wide, wide.initial_controls)
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("source", [Source.STEP, Source.TRAJECTORY])
def test_absent_agents_do_not_change_gradients_of_functions_without_a_derivative_at_zero(registry, source):
    pair_feature("inverse", source)(lambda first, second: 1.0 / (first[..., 0] * second[..., 0]))
    scene = random_scene(2, 2, history=2, dtype=torch.float64)
    scene.history[..., 0].add_(9.0)
    game = random_game(scene, own=("acc",))
    alone = replaced(game, pair_weights={"inverse": game.pair_weights["proximity"]})
    games = leaves_of(alone), leaves_of(widen(alone))
    for game, where in zip(games, (scene, pad(scene)), strict=True):
        directions = torch.ones(2, *game.initial_controls.shape, dtype=torch.float64)
        parts = FeatureEnergy(["acc"], ["inverse"]).linearisation(where, game, game.initial_controls, directions)
        sum(part.square().sum() for part in parts).backward()
    alone, wide = (game.initial_controls.grad for game in games)
    torch.testing.assert_close(wide, torch.cat((alone, torch.zeros_like(alone)), 2), rtol=1e-12, atol=1e-12)


def test_coincident_agents_have_a_finite_energy_and_a_gradient_of_zero():
    point = torch.zeros(1, 3, 2, dtype=torch.float64, requires_grad=True)
    distance, normal = separation(point, point.detach())
    depth = overlap(distance, torch.tensor([[0.5]], dtype=torch.float64))
    assert (depth == 0.5).all()
    assert (normal == 0).all()
    depth.sum().backward()
    assert (point.grad == 0).all()


def test_touching_is_not_active():
    touching = torch.tensor([0.5])
    depth, slope, _ = pair_derivatives(PAIR_FEATURES["proximity"], touching, touching)
    assert depth.item() == slope.item() == 0


def test_the_nearest_point_slides_along_its_segment():
    line = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
    points = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [3.0, 1.5], [0.5, -1.0]], dtype=torch.float64)
    nearest, tangent = nearest_point(points, line)
    # The first point is as near to the first segment as to the last one, and the first one counts.
    expected = torch.tensor([[1.0, 0.0], [0.0, 0.0], [2.0, 1.5], [0.5, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(nearest, expected, rtol=0, atol=0)
    slides = torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(tangent, slides, rtol=0, atol=0)
    jacobian = torch.func.jacfwd(lambda p: nearest_point(p, line)[0].sum(0))(points).transpose(0, 1)
    torch.testing.assert_close(jacobian, slides[..., :, None] * slides[..., None, :], rtol=0, atol=1e-15)


def test_absent_reference_lines_have_no_effect():
    scene = random_scene(2, 2, history=2)
    parameters = random_game(scene)
    scene.reference_mask[:] = False
    scene.references[:] = torch.nan
    residuals = FeatureEnergy(["lane", "acc"]).residuals(scene, parameters, parameters.initial_controls)
    assert (residuals["lane"] == 0).all()


def test_the_energy_is_an_exact_potential_of_the_agents_costs():
    """The defining property of a potential game: dE/du_i is the gradient of agent i's own terms and its pairs."""
    scene = random_scene(1, 3, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
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
        ({"own": "goal"}, "energy.own must be a list of names, not 'goal'"),
        ({"own": 3}, "energy.own must be a list of names, not 3"),
        ({"own": ["goal", None]}, "energy.own must be a list of names"),
        ({"own": ["goal"], "pair": [["proximity"]]}, "energy.pair must be a list of names"),
        ({"own": ["goal", "goal"]}, "twice"),
        ({"own": [], "pair": []}, "at least one feature"),
        ({"own": ["velb"]}, "needs energy.bounds.vel"),
        ({"own": ["vel"], "bounds": {"velocity": (0.0, 1.0)}}, "unknown signal energy.bounds.velocity"),
        ({"own": ["acc"], "pair_stride": 0}, "energy.pair_stride must be a whole number"),
        ({"own": ["acc"], "pair_stride": 1.5}, "energy.pair_stride must be a whole number, 1 or more, not 1.5"),
        ({"own": ["acc"], "pair_stride": True}, "energy.pair_stride must be a whole number"),
        ({"own": ["velb"], "bounds": {"vel": (1.0, 0.0)}}, r"energy.bounds.vel must be \[lowest, highest\]"),
        ({"own": ["velb"], "bounds": {"vel": (float("nan"), 1.0)}}, r"energy.bounds.vel must be \[lowest, highest\]"),
        ({"own": ["velb"], "bounds": {"vel": ("0", 1.0)}}, r"energy.bounds.vel must be \[lowest, highest\]"),
        ({"own": ["velb"], "bounds": {"vel": 2.0}}, r"energy.bounds.vel must be \[lowest, highest\], .*, not 2.0"),
        ({"own": ["velb"], "bounds": {"vel": (0.0, 1.0, 2.0)}}, r"energy.bounds.vel must be \[lowest, highest\]"),
        ({"own": ["velb"], "bounds": [0.0, 1.0]}, "energy.bounds must map signals"),
        ({"own": ["goal"], "dynamics": HalfSpeed()}, "are defined for dynamics=unicycle, not for HalfSpeed"),
    ],
)
def test_bad_energies_are_refused(arguments, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checks would come first
    with pytest.raises(ConfigError, match=message):
        FeatureEnergy(**arguments)
    with pytest.raises(ConfigError, match=message):
        build("energy", {"name": "features", **arguments})


@pytest.mark.skipif(isinstance(interface.find(), str), reason="only the compiled kernel reads addresses")
def test_tensors_on_another_device_than_the_controls_are_named():
    """The device ``meta`` stands for a GPU: kernels would read an address of the other device's memory."""
    scene = random_scene(1, 2)
    parameters, energy = random_game(scene, own=("goal",)), FeatureEnergy(["goal"])
    weights = {"goal": parameters.own_weights["goal"].to("meta")}
    for moved, game, named in (
        (scene.to("meta"), parameters, r"on the CPU, and scene\.history, .* on another device"),
        (scene, replaced(parameters, goals=parameters.goals.to("meta")), r"and parameters\.goals on another device"),
        (scene, replaced(parameters, own_weights=weights), r"and parameters\.own_weights\['goal'\] on another device"),
    ):
        with pytest.raises(ValueError, match=named):
            LevenbergMarquardt(backend="compiled")(energy, moved, game)


def test_terms_that_an_energy_does_not_name_are_refused():
    """They would be minimised, and be no part of any agent's objective."""
    scene = random_scene(1, 2)
    parameters = random_game(scene, own=("goal", "acc"))
    with pytest.raises(ValueError, match=r"Unnamed\.own_terms returns \['acc', 'goal'\], and own names \['goal'\]"):
        Unnamed().objectives(scene, parameters, parameters.initial_controls)


def test_a_stride_beyond_the_horizon_is_refused():
    scene = random_scene(1, 2)
    parameters = random_game(scene, horizon=20)
    FeatureEnergy(["acc"], pair_stride=20).validate(scene, parameters, parameters.initial_controls)
    with pytest.raises(ValueError, match=r"energy.pair_stride=21 evaluates pairs at no step: .* K = 20"):
        FeatureEnergy(["acc"], pair_stride=21).validate(scene, parameters, parameters.initial_controls)


def test_features_of_installed_packages_are_found_in_plain_python(tmp_path):
    (tmp_path / "third_party.py").write_text(
        "from epo_lightning.game.features import own_feature\n"
        "@own_feature('curvature')\n"
        "def curvature(states, controls):\n"
        "    return controls[..., 1] / states[..., 3].clamp_min(1.0)\n"
    )
    metadata = tmp_path / "third_party-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[epo_lightning.parts]\nthird_party = third_party\n")
    script = (
        "from epo_lightning.game.feature_energy import FeatureEnergy\n"
        "print(FeatureEnergy(own=['goal', 'curvature']).own)\n"
        "FeatureEnergy(own=['curvatur'])\n"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(epo_lightning.__file__).parents[1])])
    result = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stdout == "['goal', 'curvature']\n", result.stderr
    assert "did you mean 'curvature'?" in result.stderr


def test_shapes_that_do_not_fit_are_refused_by_name(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the tests' own checks would come first
    scene = random_scene(2, 2)
    parameters = random_game(scene)
    energy = FeatureEnergy(ALL, bounds=BOUNDS)
    controls = parameters.initial_controls
    with pytest.raises(ValueError, match="controls have shape"):
        energy.validate(scene, parameters, controls[:1])
    with pytest.raises(ValueError, match="at least 2"):
        energy.validate(scene, parameters, controls[..., :1, :])
    with pytest.raises(ValueError, match="own_weights lacks the feature 'jerk'"):
        fewer = {name: w for name, w in parameters.own_weights.items() if name != "jerk"}
        energy.validate(scene, replaced(parameters, own_weights=fewer), controls)
    with pytest.raises(ValueError, match=r"own_weights\['vel'\] has shape \[2, 3, 2\]"):
        weights = {**parameters.own_weights, "vel": parameters.own_weights["vel"][:, [0, 0, 1]]}
        energy.validate(scene, replaced(parameters, own_weights=weights), controls)
    with pytest.raises(ValueError, match=r"parameters\.goals is None"):
        energy.validate(scene, replaced(parameters, goals=None), controls)
    with pytest.raises(ValueError, match=r"'lane', but parameters\.reference is None"):
        energy.validate(scene, replaced(parameters, reference=None), controls)
    with pytest.raises(ValueError, match=r"parameters\.reference has shape \[2, 3, 2\]"):
        energy.validate(scene, replaced(parameters, reference=parameters.reference[:, [0, 0, 1]]), controls)
    with pytest.raises(ValueError, match=r"R = 2 lines"):
        energy.validate(scene, replaced(parameters, reference=parameters.reference - 2), controls)
    with pytest.raises(ValueError, match=r"'lane', but scene\.references is None"):
        energy.validate(replaced(scene, references=None, reference_mask=None), parameters, controls)
    with pytest.raises(ValueError, match=r"'velref', but scene\.reference_speed is None"):
        energy.validate(replaced(scene, reference_speed=None), parameters, controls)
    with pytest.raises(ValueError, match=r"'steer', but scene\.size is None"):
        energy.validate(replaced(scene, size=None), parameters, controls)
    energy = FeatureEnergy(["goal"])
    with pytest.raises(ValueError, match=r"radii from scene\.size"):
        energy.validate(replaced(scene, size=None), parameters, controls)
