"""Bounds by kind of agent: every agent is bounded as in a game whose agents are all of its kind."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch
from games import leaves_of, random_game, random_scene

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.limits import DEFAULT, bounds_of_agents
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS, Scene
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

OWN = ("vel", "acc", "turnr", "jerk", "velb", "accb", "turnrb", "jerkb")
LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "vel": {"pedestrian": (0.0, 0.4), "truck": (0.2, 0.9), DEFAULT: (-0.5, 1.5)},
    "acc": {"pedestrian": (-0.1, 0.1), DEFAULT: (-0.6, 0.3)},
    "turnr": {"bicycle": (-0.2, 0.2), DEFAULT: (-0.4, 0.4)},
    "jerk": {"pedestrian": (-1.0, 1.0), "truck": (-3.0, 2.0), DEFAULT: (-5.0, 5.0)},
}
AGENTS = ("pedestrian", "car", "truck", "bicycle")


def of_kind(kind: str) -> FeatureEnergy:
    """The energy with the bounds of one kind for all agents."""
    return FeatureEnergy(OWN, (), {name: limits.get(kind, limits[DEFAULT]) for name, limits in LIMITS.items()})


def game() -> tuple[Scene, GameParameters]:
    """Agents of four kinds in different orders, of which one is absent."""
    torch.manual_seed(0)
    scene = random_scene(4, 4, dtype=torch.float64)
    kind = torch.stack([torch.tensor([KINDS.index(name) for name in AGENTS]).roll(shift) for shift in range(4)])
    present = torch.ones(4, 4, dtype=torch.bool)
    present[1, 2] = False
    return dataclasses.replace(scene, kind=kind, agent_mask=present), random_game(scene, own=OWN, pair=())


def test_bounds_of_agents_equal_a_plain_loop():
    kind = torch.tensor([[KINDS.index("car"), KINDS.index("pedestrian")], [KINDS.index("truck")] * 2])
    lower, upper = bounds_of_agents(LIMITS["vel"], kind, torch.float64)
    assert lower.shape == upper.shape == (2, 1, 2, 1)
    for scene in range(2):
        for agent in range(2):
            limits = LIMITS["vel"]
            expected = limits.get(KINDS[int(kind[scene, agent])], limits[DEFAULT])
            assert (float(lower[scene, 0, agent, 0]), float(upper[scene, 0, agent, 0])) == expected


def test_residuals_of_every_agent_are_those_of_its_kind():
    scene, parameters = game()
    energy = FeatureEnergy(OWN, (), LIMITS)
    found = energy.residuals(scene, parameters, parameters.initial_controls)
    for name in AGENTS:
        expected = of_kind(name).residuals(scene, parameters, parameters.initial_controls)
        mine = scene.kind == KINDS.index(name)
        for feature in OWN:
            ours, theirs = (each[feature].movedim(1, 2)[mine] for each in (found, expected))
            torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    violated = {name: bool((found[name] != 0).any()) for name in OWN if name.endswith("b")}
    assert all(violated.values()), "every bound is exceeded somewhere"


@pytest.mark.parametrize("adaptive", [False, True])
def test_solutions_and_gradients_of_every_agent_are_those_of_its_kind(adaptive):
    """Without pairs, agents are independent: a mixed game is solved like the games of one kind each."""
    scene, parameters = game()
    solve = LevenbergMarquardt(steps=4, damping=1.0, adaptive=adaptive, backend="pytorch")

    def solved(energy: FeatureEnergy) -> tuple[torch.Tensor, torch.Tensor]:
        leaves = leaves_of(parameters)
        controls = solve(energy, scene, leaves).controls
        if not adaptive:
            controls.square().sum().backward()
        grad = leaves.own_weights["velb"].grad
        return controls.detach(), torch.zeros(4, 2, 4) if grad is None else grad

    if adaptive:  # one damping per game: all agents of a game are of one kind
        scene = dataclasses.replace(scene, kind=scene.kind[:, :1].expand(-1, 4).contiguous())
    controls, gradient = solved(FeatureEnergy(OWN, (), LIMITS))
    for name in AGENTS:
        theirs, their_gradient = solved(of_kind(name))
        mine = (scene.kind == KINDS.index(name)) & scene.agent_mask
        torch.testing.assert_close(controls.movedim(1, 2)[mine], theirs.movedim(1, 2)[mine], rtol=0, atol=1e-12)
        torch.testing.assert_close(gradient.movedim(1, 2)[mine], their_gradient.movedim(1, 2)[mine], rtol=0, atol=1e-10)


def test_the_compiled_layer_leaves_such_games_to_pytorch():
    scene, parameters = game()
    energy = FeatureEnergy(OWN, (), LIMITS)
    with pytest.raises(ValueError, match=r"takes bounds of all agents, not bounds of 'vel' by kind"):
        LevenbergMarquardt(backend="compiled")(energy, scene, parameters)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        auto = LevenbergMarquardt()(energy, scene, parameters).controls
    torch.testing.assert_close(auto, LevenbergMarquardt(backend="pytorch")(energy, scene, parameters).controls)


def test_bounds_by_kind_that_no_feature_uses_change_nothing():
    scene, parameters = game()
    bounds = {"vel": (0.0, 1.0), "acc": LIMITS["acc"]}
    energy, plain = FeatureEnergy(("velb",), (), bounds), FeatureEnergy(("velb",), (), {"vel": (0.0, 1.0)})
    assert not energy.bounded_by_kind
    for backend in ("auto", "pytorch"):
        solve = LevenbergMarquardt(backend=backend)
        torch.testing.assert_close(
            solve(energy, scene, parameters).controls, solve(plain, scene, parameters).controls, rtol=0, atol=0
        )


def test_a_scene_without_kinds_is_refused():
    scene, parameters = game()
    with pytest.raises(ValueError, match=r"the bounds of 'vel' are by kind of agent, but scene\.kind is None"):
        FeatureEnergy(OWN, (), LIMITS)(dataclasses.replace(scene, kind=None), parameters, parameters.initial_controls)


@pytest.mark.parametrize(
    ("bound", "message"),
    [
        ({"walker": (0.0, 1.0), DEFAULT: (0.0, 1.0)}, r"unknown kind energy\.bounds\.vel\.walker"),
        ({"pedestrian": (0.0, 1.0)}, r"energy\.bounds\.vel has no bounds of the kind 'car': name it, or add default"),
        (
            {"pedestrian": (2.0, 1.0), DEFAULT: (0.0, 1.0)},
            r"energy\.bounds\.vel\.pedestrian must be \[lowest, highest\]",
        ),
        ({}, r"energy\.bounds\.vel has no bounds of the kind 'car'"),
    ],
)
def test_invalid_bounds_by_kind_are_refused(bound, message):
    with pytest.raises(ConfigError, match=message):
        FeatureEnergy(("velb",), (), {"vel": bound})
