"""The features of docs/extend.md, run as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from games import leaves_of, random_game, random_scene

from epo_lightning.game import features
from epo_lightning.game.energy import Energy
from epo_lightning.scene import Status
from epo_lightning.solvers.levenberg_marquardt import LevenbergMarquardt

PAGE = Path(__file__).parents[2] / "docs" / "extend.md"


@pytest.fixture
def documented(monkeypatch):
    """Runs the page's blocks on features, and forgets their features afterwards."""
    monkeypatch.setattr(features, "OWN_FEATURES", features.OWN_FEATURES)
    before = dict(features.OWN_FEATURES)
    section = PAGE.read_text().split("## An energy feature")[1].split("\n## ")[0]
    blocks = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(block, {})
    yield set(features.OWN_FEATURES) - set(before)
    for name in set(features.OWN_FEATURES) - set(before):
        del features.OWN_FEATURES[name]


def test_documented_features_work_in_the_layer(documented):
    assert documented == {"lateral", "hurry"}
    scene = random_scene(3, 2, history=2, dtype=torch.float64)
    scene.history[..., 3] += 29.5
    own = ("goal", "acc", "turnr", "lateral", "hurry")
    leaves = leaves_of(random_game(scene, own=own))
    solution = LevenbergMarquardt()(Energy(own), scene, leaves)
    assert (solution.status == Status.SOLVED).all()
    assert (solution.energy < solution.initial_energy).all()
    solution.states.sum().backward()
    for name in documented:
        assert leaves.own_weights[name].grad.abs().max() > 0, name
