"""The suites of dynamics, energies and features, for all built-in ones."""

from __future__ import annotations

from suites import DynamicsSuite, EnergySuite, FeatureSuite

from epo_lightning.game.features import OWN_FEATURES, PAIR_FEATURES
from epo_lightning.registry import parts

OWN = ["goal", "lane", "velref", "steer", "vel", "acc", "turnr", "jerk", "turnacc"]
BOUNDS = {"vel": [0.2, 0.9], "acc": [-0.3, 0.3], "turnr": [-0.2, 0.2], "jerk": [-1.0, 1.0], "turnacc": [-1.0, 1.0]}


class TestUnicycle(DynamicsSuite):
    config = {"name": "unicycle"}


class TestHeun(DynamicsSuite):
    config = {"name": "unicycle", "integrator": "heun"}


class TestDoubleIntegrator(DynamicsSuite):
    config = {"name": "double_integrator"}


class TestFeatures(EnergySuite):
    config = {"name": "features", "own": OWN, "pair": ["proximity", "circles"], "bounds": BOUNDS}


class TestNeural(EnergySuite):
    config = {"name": "neural", "own": ["acc"], "pair": ["proximity"]}


class TestCollision(EnergySuite):
    config = {"name": "collision", "own": ["acc"], "waypoints": 3}


class TestConvexAlong(EnergySuite):
    config = {"name": "convex", "own": ["goal", "lateral", "velref", "lat_vel", "acc", "lat_acc", "jerk", "lat_jerk"]}
    linear = True


class TestConvexAcross(EnergySuite):
    config = {"name": "convex", "own": ["goal", "acc", "lat_acc"], "direction": "across"}
    linear = True


def feature(kind: str, name: str) -> type[FeatureSuite]:
    return type(f"TestFeature_{name}", (FeatureSuite,), {kind: name, "bounds": BOUNDS if name.endswith("b") else {}})


SUITES = [feature("own", name) for name in OWN_FEATURES] + [feature("pair", name) for name in PAIR_FEATURES]
globals().update({suite.__name__: suite for suite in SUITES})


def test_every_built_in_part_has_its_suite():
    tried = {suite.config["name"] for suite in EnergySuite.__subclasses__() if suite is not FeatureSuite}
    assert tried >= set(parts("energy"))
    assert {suite.config["name"] for suite in DynamicsSuite.__subclasses__()} >= set(parts("dynamics"))
