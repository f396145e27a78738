"""The data module ``highway_sim``: scenes are extracted from the recordings that the simulation makes."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from epo_lightning.data import simulate
from epo_lightning.experiment.assembly import build_data
from epo_lightning.experiment.config.compose import compose

DRIVEN = Path(__file__).parents[2] / "fixtures" / "exid_sim"
"""A few seconds of simulated traffic in exiD's format."""


def test_scenes_are_extracted_from_simulated_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def drive(folder: Path, *settings: Any) -> Path:
        return Path(shutil.copytree(DRIVEN, folder))

    monkeypatch.setattr(simulate, "make_recordings", drive)
    words = ["data=highway_sim", f"data.root={tmp_path}", "data.test=null", "data.val_by=recording"]
    data = build_data(compose("generate", words)["data"])
    folder = data.generate(workers=1, progress=False)
    data.setup("fit")
    assert folder.parent == tmp_path
    assert len(data.dataset("train")) > 0
    assert data.generate(workers=1, progress=False) == folder


@pytest.mark.parametrize(
    "words",
    [
        ["data=highway_sim"],
        ["data=highway_sim_dense"],
        ["data=highway_sim", "+data.traffic=dense", "data.minutes=2.0", "data.layouts=[1,2]"],
        ["data=highway_sim_dense", "data.traffic=free", "data.recordings=2", "data.seed=3"],
    ],
)
def test_the_command_of_a_data_set_makes_the_same_traffic(words: list[str]) -> None:
    data = build_data(compose("generate", words)["data"])
    epo, generate, *named = shlex.split(data.command)
    assert (epo, generate) == ("epo", "generate")
    assert build_data(compose("generate", named)["data"]).folder_of_recordings == data.folder_of_recordings
