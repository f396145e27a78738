"""The suite of objectives, for all built-in ones."""

from __future__ import annotations

from suites import ObjectiveSuite

from epo_lightning.registry import parts


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
