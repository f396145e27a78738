"""The features of docs/extend.md, run unchanged."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import torch
from games import leaves_of, random_game, random_scene
from suites import FeatureSuite

from epo_lightning.experiment.config import compose
from epo_lightning.experiment.sweeps import sweeping
from epo_lightning.forecast import Status
from epo_lightning.game import features
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.neural_energy import NeuralEnergy
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general.gradient_descent import GradientDescent

PAGE = Path(__file__).parents[2] / "docs" / "extend.md"


@pytest.fixture
def documented():
    """Runs the page's blocks on features, and forgets their features afterwards."""
    before, pairs = dict(features.OWN_FEATURES), dict(features.PAIR_FEATURES)
    section = PAGE.read_text().split("## An energy feature")[1].split("\n## ")[0]
    blocks = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    assert len(blocks) == 4
    for block in blocks:
        exec(block, {})
    yield set(features.OWN_FEATURES) - set(before)
    for name in set(features.OWN_FEATURES) - set(before):
        del features.OWN_FEATURES[name]
    for name in set(features.PAIR_FEATURES) - set(pairs):
        del features.PAIR_FEATURES[name]


def test_documented_features_work_in_the_layer(documented):
    assert documented == {"curvature", "latacc", "hurry"}
    scene = random_scene(3, 2, history=2, dtype=torch.float64)
    scene.history[..., 3] += 29.5
    scene.history[..., 2] = 0.0  # side by side
    own = ("goal", "acc", "turnr", "curvature", "latacc", "hurry")
    parameters = random_game(scene, own=own)
    parameters.pair_weights["comfort"] = parameters.pair_weights["proximity"]
    leaves = leaves_of(parameters)
    solution = LevenbergMarquardt()(FeatureEnergy(own, ["proximity", "comfort"]), scene, leaves)
    assert (solution.status == Status.COMPLETED).all()
    assert (solution.energy < solution.initial_energy).all()
    solution.states.sum().backward()
    for name in documented:
        assert leaves.own_weights[name].grad.abs().max() > 0, name
    assert leaves.pair_weights["comfort"].grad.abs().max() > 0


def test_documented_features_work_beside_networks(documented):
    scene = random_scene(3, 2, history=2, horizon=7, dtype=torch.float64)
    parameters = random_game(scene, own=("latacc",))
    context = torch.randn(3, 2, 8, dtype=torch.float64)
    parameters = dataclasses.replace(
        parameters, pair_weights={"comfort": parameters.pair_weights["proximity"]}, context=context
    )
    energy = NeuralEnergy(Unicycle(), 8, 7, 1.0, own=["latacc"], pair=["comfort"]).double()
    leaves = leaves_of(parameters)
    solution = GradientDescent(steps=3, step_size=1e-3)(energy, scene, leaves)
    assert (solution.energy < solution.initial_energy).all()
    solution.controls.square().sum().backward()
    assert leaves.own_weights["latacc"].grad.abs().max() > 0


def test_the_documented_row_differs_in_its_new_feature(documented, tmp_path):
    """The files of the sections on features and on comparisons, as they stand."""
    pieces = re.findall(
        r"`((?:conf|sweeps)/[\w./]+\.yaml)`[^`]*:\n\n```yaml\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
    files = {name: text for name, text in pieces if "curvature" in name}
    assert len(files) == 3
    extra = [str(tmp_path)]
    for name, text in files.items():
        file = tmp_path / name.removeprefix("conf/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    rows = compose.jobs("train", sweeping.words_of("curvature", ["data=drawn"], extra), extra)
    assert len(rows) == 6
    usual, new = (compose.compose("train", row, extra) for row in (rows[0], rows[3]))
    assert set(new["energy"]["own"]) - set(usual["energy"]["own"]) == {"curvature"}
    assert set(usual["energy"]["own"]) <= set(new["energy"]["own"])
    assert {key for key in new if new[key] != usual[key]} == {"energy", "title", "experiment", "variant"}


class TestDocumentedFeature(FeatureSuite):
    """The page's own test, with its feature registered for as long as it runs."""

    own = "curvature"

    @pytest.fixture(autouse=True)
    def registered(self, documented):
        assert self.own in documented
