"""The suite of objectives, for all built-in ones."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from games import random_scene
from suites import ObjectiveSuite
from suites.games import build_energy
from suites.objective import ENERGY

from epo_lightning import losses
from epo_lightning.forecast import GameParameters, JointForecast, Solution
from epo_lightning.objectives.imitation import _difference_ahead
from epo_lightning.objectives.terms import imitation_terms
from epo_lightning.registry import build, parts
from epo_lightning.scene import Scene
from epo_lightning.schedules import Softness


def test_the_difference_after_the_forecast_is_a_mean_over_scenes() -> None:
    """Two of three steps belong to the forecast. Four agents of one scene are off by 1 and 3, that of the other by 4."""
    controls, none = torch.zeros(2, 1, 4, 3, 2), torch.zeros(2, 1)
    initial = controls.clone()
    initial[0, ..., 0], initial[0, ..., 1] = 1.0, 3.0
    initial[1] = 4.0
    states = torch.zeros(2, 1, 4, 3, 4)
    present = torch.tensor([[True] * 4, [True] + [False] * 3])
    scene = Scene(history=torch.zeros(2, 4, 1, 4), dt=0.1, size=torch.ones(2, 4, 2), agent_mask=present)
    for ahead, expected in ((2, 3.0), (3, 0.0)):
        forecast = JointForecast(
            states=states[..., :ahead, :],
            probabilities=torch.ones(2, 1),
            parameters=GameParameters(own_weights={}, pair_weights={}, initial_controls=initial),
            solution=Solution(controls, states, none, none, none, none.long()),
        )
        assert float(_difference_ahead(scene, forecast)) == expected


def test_the_difference_after_the_forecast_teaches_the_initial_controls_alone() -> None:
    """The solution is what they should become: it is not drawn towards them. By hand: 1 / (1 mode, 1 agent, 1 step, 2)."""
    initial, controls = torch.ones(1, 1, 1, 3, 2).requires_grad_(), torch.zeros(1, 1, 1, 3, 2).requires_grad_()
    states, none = torch.zeros(1, 1, 1, 3, 4), torch.zeros(1, 1)
    forecast = JointForecast(
        states=states[..., :2, :],
        probabilities=torch.ones(1, 1),
        parameters=GameParameters(own_weights={}, pair_weights={}, initial_controls=initial),
        solution=Solution(controls, states, none, none, none, none.long()),
    )
    difference = _difference_ahead(Scene(history=torch.zeros(1, 1, 1, 4), dt=0.1), forecast)
    assert isinstance(difference, torch.Tensor)
    difference.backward()
    assert controls.grad is None
    assert initial.grad is not None
    assert initial.grad.flatten().tolist() == [0.0, 0.0, 0.0, 0.0, 0.5, 0.5]


class TestImitation(ObjectiveSuite):
    config = {"name": "imitation", "weights": {"imitation": 1.0, "goal": 0.1, "probability": 0.1, "initial": 1.0}}


class TestRelaxedImitation(ObjectiveSuite):
    config = {**TestImitation.config, "relaxation": 0.5, "power": 1.05}


class TestAnnealedImitation(ObjectiveSuite):
    config = {**TestImitation.config, "annealing": 2.0}


class TestJointDensity(ObjectiveSuite):
    config = {"name": "conditional", "weights": {"density": 1.0, "marginal": 0.1, "regression": 0.1}}
    solver = {"name": "enumeration", "candidates": 4}


class TestMarginalDensity(TestJointDensity):
    config = {**TestJointDensity.config, "density": "marginal"}
    solver = {"name": "sum_product", "candidates": 4}


class TestContrastive(ObjectiveSuite):
    weights = {"contrastive": 1.0, "magnitude": 0.1, "initial": 1.0, "goal": 0.1, "probability": 0.1}
    config = {"name": "contrastive", "weights": weights}
    solver = {"name": "langevin", "steps": 4}


class TestAnnealedMarginalDensity(TestMarginalDensity):
    config = {**TestMarginalDensity.config, "annealing": 2.0}


class TestAnnealedContrastive(TestContrastive):
    config = {**TestContrastive.config, "annealing": 2.0}


class TestLaplace(ObjectiveSuite):
    config = {"name": "laplace", "weights": {"density": 1.0, "initial": 1.0, "goal": 0.1}}


class TestAnnealedLaplace(TestLaplace):
    config = {**TestLaplace.config, "annealing": 2.0}


ANNEALED = (TestAnnealedImitation, TestAnnealedMarginalDensity, TestAnnealedContrastive, TestAnnealedLaplace)
TERMS = {"imitation": "imitation", "conditional": "regression", "contrastive": "contrastive", "laplace": "initial"}
"""The term of each objective that annealing softens."""


@pytest.mark.parametrize("suite", ANNEALED)
def test_annealing_trains_every_mode_at_first_and_the_closest_one_at_last(suite: type[ObjectiveSuite]) -> None:
    """The softened term has a gradient in every mode when hot, and when cold in those of the plain loss."""
    made, torch_state = suite(), torch.get_rng_state()
    energy = build_energy(ENERGY)

    def trained(config: dict[str, Any], step: int) -> tuple[torch.Tensor, torch.Tensor]:
        torch.set_rng_state(torch_state)
        objective = build("objective", config)
        scene, game = made.game(energy)
        game = game.map(lambda tensor: tensor.clone().requires_grad_(tensor.is_floating_point()))
        forecast = made.forecast(energy, scene, game)
        value = objective(scene, forecast, energy, step)[TERMS[config["name"]]][1]
        if config["name"] == "contrastive":  # it trains energies, not futures
            (gradient,) = torch.autograd.grad(value, game.own_weights["acc"])
        else:
            (gradient,) = torch.autograd.grad(value, game.initial_controls)
        return value, gradient.flatten(2).abs().amax(-1)

    plain_config = {key: value for key, value in suite.config.items() if key != "annealing"}
    plain, few = trained(plain_config, 0)
    hot, every = trained({**suite.config, "annealing": 50.0}, 0)
    cold, same = trained(suite.config, 2000)
    assert (every > 0).all()
    assert not (few > 0).all()
    assert torch.equal(same, few)
    assert torch.equal(cold, plain)
    assert not torch.equal(hot, plain)


def test_every_built_in_objective_has_its_suite():
    assert {suite.config["name"] for suite in ObjectiveSuite.__subclasses__()} >= set(parts("objective"))


def test_annealed_contrastive_terms_are_sums_over_modes_by_their_shares() -> None:
    """Against the plain terms of every mode alone, each of which is the closest of one mode."""
    made, energy = TestContrastive(), build_energy(ENERGY)
    scene, game = made.game(energy)
    forecast = made.forecast(energy, scene, game)
    modes = forecast.probabilities.shape[1]

    def alone(mode: int, number: int) -> dict[str, float]:
        one = forecast[number].map(lambda tensor: tensor[:, mode : mode + 1] if tensor.dim() > 1 else tensor)
        terms = build("objective", TestContrastive.config)(scene[number], one, energy)
        return {name: value.item() for name, (_, value) in terms.items()}

    distance = losses.distances(forecast.states[..., :2], scene.future, scene.future_mask)
    expected = {"contrastive": 0.0, "magnitude": 0.0}
    for number in range(3):
        far = [
            sum(distance[number, mode, i].item() for i in range(3) if scene.future_mask[number, i].any())
            / sum(bool(scene.future_mask[number, i].any()) for i in range(3))
            for mode in range(modes)
        ]
        powers = [math.exp(-(math.hypot(one, 2.0) - 2.0) / 2.0) for one in far]
        for mode in range(modes):
            for name in expected:
                expected[name] += powers[mode] / sum(powers) * alone(mode, number)[name] / 3
    terms = build("objective", TestAnnealedContrastive.config)(scene, forecast, energy)
    assert {name: terms[name][1].item() for name in expected} == pytest.approx(expected)


def test_imitation_takes_the_closest_mode_and_a_share_of_all_with_distances_to_a_power():
    scene = random_scene(1, 2, horizon=3)
    offset = torch.tensor([2.0, 1.0])[:, None, None, None] * torch.tensor([0.6, -0.8, 0.0, 0.0])
    forecast = JointForecast(scene.future[:, None] + offset, torch.tensor([[0.75, 0.25]]))
    weights = {"imitation": 1.0, "probability": 0.1}
    for relaxation, power in ((0.0, 1.0), (0.5, 1.0), (0.0, 2.0), (0.5, 2.0)):
        terms = imitation_terms(scene, forecast, weights, Softness(power, relaxation))
        # Euclidean, or the mean of both coordinates to the power.
        both = 1.0 if power == 1.0 else (0.6**power + 0.8**power) / 2
        far, closest = 2.0**power * both, both
        expected = (1 - relaxation) * closest + relaxation * (far + closest) / 2
        assert terms["imitation"][1].item() == pytest.approx(expected, rel=1e-5)
        assert terms["probability"][1].item() == pytest.approx(-math.log(0.25), rel=1e-5)
