"""`epo predict`: the chosen scenes, their pictures and animations, and the written files."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from experiment import tiny
from PIL import Image
from torch import Tensor

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.data.datamodule import SceneDataModule
from epo_lightning.experiment.pictures import choose, even, eventful, forecast_of
from epo_lightning.experiment.predict import MEANING
from epo_lightning.forecast import JointForecast
from epo_lightning.registry import register
from epo_lightning.scene import KINDS, Scene
from epo_lightning.task import Task

Epo = Callable[..., int]
LANE = 3.6
CHANGES = (3, 6)
"""Scenes of eight in which the second of three vehicles changes lane."""


def road_scenes(indices: Tensor) -> Scene:
    """Three vehicles side by side in a bend, at 5 Hz."""
    count = len(indices)
    time = 0.2 * torch.arange(-9, 21)
    sideways = LANE * torch.tensor([-1.0, 0.0, 1.0])[None, :, None] + 0.8 * time.clamp(min=0) ** 2
    sideways = sideways.expand(count, 3, 30).clone()
    changing = torch.isin(indices, torch.tensor(CHANGES))
    sideways[changing, 1, 10:] += torch.linspace(0, LANE, 20)
    along = (25.0 * time).expand(count, 3, 30) + 12.0 * torch.arange(3)[:, None]
    states = torch.stack([along, sideways, torch.zeros_like(along), torch.full_like(along, 25.0)], -1)
    x = torch.arange(-200.0, 300.0, 20.0)
    lane = torch.stack([x[:-1], torch.zeros(len(x) - 1), x[1:], torch.zeros(len(x) - 1)], -1)
    return Scene(
        history=states[:, :, :10],
        dt=0.2,
        future=states[:, :, 10:],
        goal_candidates=states[:, :, -1:, :2],
        size=torch.tensor([4.5, 1.8]).expand(count, 3, 2),
        kind=torch.zeros(count, 3, dtype=torch.long),
        lanes=lane.expand(count, 1, *lane.shape),
        id=100 + indices,
    )


class RoadSet:
    """Eight scenes; remembers which ones were asked for."""

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def __len__(self) -> int:
        return 8

    def __getitem__(self, indices: Tensor) -> Scene:
        self.asked.append(indices.tolist())
        return road_scenes(indices)

    def set_epoch(self, epoch: int) -> None:
        pass

    def provenance(self, ids: list[int]) -> list[dict[str, object]]:
        return [{"recording": "07", "frame": 10 * i, "tracks": [i, i + 1, i + 2]} for i in ids]


@register("data", "tiny_road")
class TinyRoad(SceneDataModule):
    """See the module."""

    task, num_agents = Task(horizon=20, dt=0.2, shape="box"), 3
    digest = "tiny-road"

    def __init__(self, batch_size: int = 4) -> None:
        super().__init__(batch_size, seed=0)

    def open(self, split: str) -> RoadSet:
        return RoadSet()

    def generate(self, workers: int | None = None, progress: bool = True) -> Path:
        return Path("memory")

    def report(self) -> dict[str, object]:
        return {}


def train(epo: Epo, data: str = "tiny_road") -> None:
    words = ("data=tiny", f"data.name={data}", "data.batch_size=4", "budget=smoke", "callbacks.progress=none")
    assert epo("train", "experiment=rpi/const_vel", *words, "run_dir=run") == 0


def test_highway_scenes_are_drawn_one_by_one_with_their_provenance(epo: Epo) -> None:
    from safetensors.torch import load_file

    train(epo)
    assert epo("predict", "run=run", "out=out", "scenes=null", "figures=2", "animate=1") == 0
    tensors, index = load_file("out/forecasts.safetensors"), json.loads(Path("out/index.json").read_text())
    assert set(tensors) == set(index["tensors"])
    assert torch.equal(tensors["id"], 100 + torch.arange(8))
    assert tensors["lanes"].shape == (8, 1, 24, 4)
    assert "goals" not in tensors
    assert index["pictures"] == [
        {"file": "figures/scene_103.png", "rows": [3]},
        {"file": "figures/scene_106.png", "rows": [6]},
        {"file": "figures/scene_103.gif", "rows": [3]},
    ]
    for picture, kind in zip(index["pictures"], ("PNG", "PNG", "GIF"), strict=True):
        with Image.open(Path("out") / picture["file"]) as image:
            assert image.format == kind
            assert image.width > 500
    assert index["provenance"][3] == {"recording": "07", "frame": 1030, "tracks": [103, 104, 105]}
    assert len(index["provenance"]) == 8
    assert index["kinds"] == list(KINDS)


def test_pedestrian_scenes_share_one_picture(epo: Epo) -> None:
    train(epo, "tiny")
    assert epo("predict", "run=run", "out=out", "scenes=6", "figures=2") == 0
    index = json.loads(Path("out/index.json").read_text())
    assert index["pictures"] == [{"file": "figures/joint_predictions.png", "rows": [0, 5]}]
    assert "provenance" not in index
    assert sorted(path.name for path in Path("out/figures").iterdir()) == ["joint_predictions.png"]


def test_nothing_is_drawn_unless_asked_for(epo: Epo, refused: Callable[..., str]) -> None:
    train(epo)
    assert epo("predict", "run=run", "out=out", "scenes=3", "figures=0") == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["forecasts.safetensors", "index.json"]
    assert "animate must be 0 or more, not -1" in refused("predict", "run=run", "out=other", "animate=-1")


def test_only_the_chosen_scenes_are_read() -> None:
    data = TinyRoad()
    data.setup("test")
    scenes, origins = choose(data, "test", 3)
    assert data.dataset("test").asked == [[0, 4, 7]]
    assert scenes.id.tolist() == [100, 104, 107]
    assert [origin["frame"] for origin in origins] == [1000, 1040, 1070]


def test_scenes_of_any_other_loader_are_gathered() -> None:
    scenes, origins = choose(tiny.Tiny(count=20), "test", 4)
    assert scenes.id.tolist() == [0, 6, 13, 19]
    assert origins is None


@pytest.mark.parametrize(("total", "count", "expected"), [(5, None, 5), (3, 9, 3), (9, 1, 1), (9, 4, 4)])
def test_scenes_are_chosen_at_even_distances(total: int, count: int | None, expected: int) -> None:
    chosen = even(total, count)
    assert len(chosen) == len(set(chosen.tolist())) == expected
    assert 0 <= chosen.min() <= chosen.max() < total


def test_scenes_with_events_are_preferred_and_spread() -> None:
    scenes = road_scenes(torch.arange(8))
    assert eventful(scenes, 2) == list(CHANGES)
    assert eventful(scenes, 99) == list(range(8))
    assert eventful(scenes, 1) == [3]


def test_masked_states_are_no_events() -> None:
    scenes = road_scenes(torch.arange(8))
    scenes.future_mask[3, 1] = False
    scenes.agent_mask[5, 0] = False
    scenes.future[3, 1] = scenes.future[5, 0] = scenes.history[5, 0] = torch.nan
    scenes.future[5, 0, :, 1] = 1e6
    scenes.agent_mask[4, 2] = False
    scenes.future[4, 2, :, 1] = 1e6
    assert eventful(scenes, 1) == [6]
    scenes.future_mask[6, 1, 1:] = False
    scenes.future_mask[1, 0, 10:] = False  # lost in the bend: has moved less than the others, but at no time otherwise
    assert eventful(scenes, 1) == [0]


def test_many_scenes_are_forecast_in_batches_and_none_is_lost() -> None:
    forecaster, scenes = epo_lightning.load("rpi/v_lstm_sc"), pretrained.examples("rpi/v_lstm_sc")
    whole = forecaster.predict(scenes)
    torch.testing.assert_close(forecast_of(forecaster, scenes, batch_size=5).states, whole.states)


def test_events_of_the_history_count_without_a_future() -> None:
    scenes = road_scenes(torch.arange(4))
    scenes.history[2, 0, :5, 1] += 2.0
    known = dataclasses.replace(scenes, future=None, future_mask=None)
    assert eventful(known, 1) == [2]


def test_every_tensor_of_a_scene_and_a_forecast_is_explained() -> None:
    described = {entry.name for entry in dataclasses.fields(Scene)} - {"dt"}
    described |= {entry.name for entry in dataclasses.fields(JointForecast)} - {
        "parameters",
        "solution",
        "own_energy",
        "pair_energy",
        "equilibrium",  # this and the next are measured in tests alone
        "states_without_pairs",
    }
    assert set(MEANING) == described | {"goals", "headings_at_goals", "reference"}
