"""The suite of objectives, for all built-in ones."""

from __future__ import annotations

import math

import pytest
import torch
from games import random_scene
from suites import ObjectiveSuite

from epo_lightning.objectives.terms import imitation_terms
from epo_lightning.registry import parts
from epo_lightning.scene import JointForecast


class TestImitation(ObjectiveSuite):
    config = {"name": "imitation", "weights": {"imitation": 1.0, "goal": 0.1, "probability": 0.1, "initial": 1.0}}


class TestRelaxedImitation(ObjectiveSuite):
    config = {**TestImitation.config, "relaxation": 0.5, "power": 1.05}


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


class TestLaplace(ObjectiveSuite):
    config = {"name": "laplace", "weights": {"density": 1.0, "initial": 1.0, "goal": 0.1}}


def test_every_built_in_objective_has_its_suite():
    assert {suite.config["name"] for suite in ObjectiveSuite.__subclasses__()} >= set(parts("objective"))


def test_imitation_takes_the_closest_mode_and_a_share_of_all_with_distances_to_a_power():
    scene = random_scene(1, 2, horizon=3)
    offset = torch.tensor([2.0, 1.0])[:, None, None, None] * torch.tensor([1.0, 0.0, 0.0, 0.0])
    forecast = JointForecast(scene.future[:, None] + offset, torch.tensor([[0.75, 0.25]]))
    weights = {"imitation": 1.0, "probability": 0.1}
    for relaxation, power in ((0.0, 1.0), (0.5, 1.0), (0.0, 2.0), (0.5, 2.0)):
        terms = imitation_terms(scene, forecast, weights, relaxation, power)
        far, closest = 2.0**power, 1.0
        expected = (1 - relaxation) * closest + relaxation * (far + closest) / 2
        assert terms["imitation"][1].item() == pytest.approx(expected, rel=1e-5)
        assert terms["probability"][1].item() == pytest.approx(-math.log(0.25), rel=1e-5)
