"""Settings of conf/data: recordings in each format become scenes with kinds, sizes and, on maps, lanes and goals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from data.recorded.formats import crowd_files, interaction_files
from data.recorded.formats.levelx_files import urban_road, write_highd, write_urban
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.scene import KINDS


def highd(folder: Path) -> None:
    for number in (1, 2, 3):
        write_highd(folder, number, location=number, frames=60)


def urban(folder: Path) -> None:
    for number in range(3):
        write_urban(folder, number, location=3 + (number > 0), osm=urban_road(), frames=60)


def interaction(folder: Path) -> None:
    for place in ("DR_A", "DR_B", "DR_C"):
        interaction_files.write_recording(folder / "x", frames=30)
        (folder / "x" / "recorded_trackfiles" / interaction_files.PLACE).rename(folder / place)
        (folder / f"{place}.osm").write_text(interaction_files.map_text())


def crowd(folder: Path) -> None:
    for name in ("intersection_01", "intersection_02", "roundabout_01"):
        ped, veh = crowd_files.pedestrians(6, 60), crowd_files.vehicles(60, first=1)
        crowd_files.write(folder, name, ped, veh)


@pytest.mark.parametrize(
    ("data", "write", "kinds", "words"),
    [
        ("highd", highd, {"car", "truck"}, ("data.windows.radius=null", "data.windows.lane_change=false")),
        ("ind", urban, {"car", "truck", "bicycle"}, ()),
        ("round", urban, {"car", "truck", "bicycle"}, ()),
        ("unid", urban, {"car", "truck", "bicycle", "pedestrian"}, ("data.map=false",)),
        ("interaction", interaction, {"car", "truck"}, ()),
        ("dut", crowd, {"car", "pedestrian"}, ()),
    ],
)
def test_recordings_become_scenes(
    tmp_path: Path, data: str, write: Callable[[Path], None], kinds: set[str], words: tuple[str, ...]
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    write(folder)
    short = ("data.windows.history=3", "data.windows.horizon=4", "data.windows.least_agents=2")
    module = assembly.build_data(
        compose("generate", [f"data={data}", f"data.folder={folder}", f"data.root={tmp_path}", *short, *words])["data"]
    )
    module.generate(workers=1, progress=False)
    found: set[str] = set()
    for split in ("train", "val", "test"):
        dataset = module.open(split)
        scene = dataset[torch.arange(len(dataset))]
        present = scene.agent_mask
        assert present.sum(1).min() >= 2
        assert scene.kind is not None
        assert scene.size is not None
        found |= {KINDS[kind] for kind in scene.kind[present].tolist()}
        assert (scene.size[present] > 0).all()
        trucks = present & (scene.kind == KINDS.index("truck"))
        assert (scene.size[trucks][:, 0] > 9.0).all()
        assert (scene.lanes is not None) == module.task.map
        if module.task.map:
            assert scene.goal_candidates is not None
            ends = torch.linalg.vector_norm(scene.goal_candidates - scene.future[:, :, -1:, :2], dim=-1).amin(-1)
            assert ends[present].max() < 2.0, "a goal candidate lies near every recorded end"
    assert found == kinds
