"""The paper's three backbones, with and without a map, with and without the goal as an input."""

from __future__ import annotations

import pytest
import torch
from games import random_scene
from suites import BackboneSuite

from epo_lightning.registry import ConfigError, build
from epo_lightning.scene import Scene

NAMES = ["v_lstm", "vibes", "hivt_m"]


class TestVLSTM(BackboneSuite):
    config = {"name": "v_lstm"}


class TestVLSTMWithGoal(BackboneSuite):
    config = {"name": "v_lstm", "goal_input": True}


class TestVIBES(BackboneSuite):
    config = {"name": "vibes"}


class TestHiVTM(BackboneSuite):
    config = {"name": "hivt_m"}


class TestHiVTMWithGoal(BackboneSuite):
    config = {"name": "hivt_m", "goal_input": True}


@pytest.mark.parametrize("name", NAMES)
def test_a_single_state_is_refused(name):
    with pytest.raises(ValueError, match="H = 1 state"):
        build("backbone", {"name": name})(random_scene(1, 2, history=1))


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_without_a_map_is_refused_where_one_is_read(name):
    with pytest.raises(ValueError, match=r"scene\.lanes .* is None"):
        build("backbone", {"name": name}, map_input=True)(random_scene(1, 2))


@pytest.mark.parametrize("name", NAMES)
def test_without_a_map_there_are_no_parameters_for_lanes(name):
    blind, reading = build("backbone", {"name": name}), build("backbone", {"name": name}, map_input=True)
    assert not [key for key in blind.state_dict() if "lane" in key]
    assert set(blind.state_dict()) < set(reading.state_dict())


@pytest.mark.parametrize("name", NAMES)
def test_features_depend_on_positions_relative_to_the_scale(name):
    features = []
    for scale in (1.0, 50.0):
        torch.manual_seed(1)
        scene = random_scene(2, 3, lanes=4)
        scene.history[..., :2] *= scale
        scene = Scene(**{**vars(scene), "lanes": scale * scene.lanes, "goal_candidates": scale * scene.goal_candidates})
        torch.manual_seed(1)
        features.append(build("backbone", {"name": name, "scale": scale}, map_input=True, goal_input=True)(scene))
    torch.testing.assert_close(features[0], features[1], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": 0.0}, "scale, the unit .* must be positive, not 0.0"),
        *(({"dropout": share}, r"dropout, .*, must be in \[0, 1\)") for share in (-0.1, 1.0, 1.5)),
        ({"lane_depth": 0}, "lane_depth must be 1 or more"),
        ({"name": "hivt_m", "history_heads": 5}, r"must be a multiple of twice the number of heads \(5\)"),
        ({"name": "hivt_m", "history_depth": 0}, "history_depth must be 1 or more"),
    ],
)
def test_invalid_sizes_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        build("backbone", {"name": "v_lstm", **changes}, map_input=True)


@pytest.mark.parametrize("name", NAMES)
def test_dropout_leaves_out_features_in_training_only(name):
    scene = random_scene(2, 3, lanes=4)
    plain, leaky = (build("backbone", {"name": name, "dropout": share}, map_input=True) for share in (0.0, 0.5))
    leaky.load_state_dict(plain.state_dict())
    assert torch.equal(leaky.eval()(scene), plain.eval()(scene))
    leaky.train()
    assert not torch.equal(leaky(scene), leaky(scene))
    gates = [module for module in leaky.modules() if isinstance(module, torch.nn.Dropout)]
    assert {gate.p for gate in gates} == {0.5}
    assert len(gates) == (2 if name == "v_lstm" else 3)


@pytest.mark.parametrize("name", NAMES)
def test_without_dropout_training_draws_no_random_number(name):
    backbone, scene = build("backbone", {"name": name}, map_input=True).train(), random_scene(2, 3, lanes=4)
    before = torch.get_rng_state()
    assert torch.equal(backbone(scene), backbone(scene))
    assert torch.equal(torch.get_rng_state(), before)
