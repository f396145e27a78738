"""The forecaster that ships with the package, and how it is packed."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch
from experiment.conftest import TINY, Epo
from safetensors.torch import load_file

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.experiment.ship import SCENES, ship
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, read_json

RPI = pretrained.HOME / "rpi"


def test_the_packaged_model_loads_by_name_and_forecasts_unseen_scenes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    scenes = pretrained.examples(RPI)
    forecast = epo_lightning.load("rpi").predict(scenes)
    # Untrained weights miss by half a metre.
    assert scenes.future is not None
    distances = (forecast.states - scenes.future[:, None])[..., :2].norm(dim=-1)  # [B, M, N, K]
    assert distances.mean((2, 3)).amin(1).mean() < 0.05


def test_the_packaged_record_gives_its_provenance() -> None:
    record, scores = RunFolder(RPI).record, read_json(RPI / "metrics.json")
    file = RPI / "checkpoints" / "best.ckpt"
    assert hashlib.sha256(file.read_bytes()).hexdigest() == record["sha256"]
    assert file.stat().st_size < 1_000_000
    assert record["command"].startswith("epo train experiment=rpi/v_lstm_epo_relaxed data=rpi_hard")
    assert {"git_commit", "seed", "data_digest", "versions"} <= {
        key for key, value in record.items() if value is not None
    }
    assert scores["data_digest"] == record["data_digest"]
    assert scores["metrics"]["minSADE"] < 0.03
    config = RunFolder(RPI).config()
    assert [config[key] for key in ("sweep", "run_dir", "resume")] == [None] * 3
    assert config["data"]["root"] is None


def test_predict_takes_its_name_and_example_scenes(
    epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in RPI.rglob("*")}
    assert epo("predict", "run=rpi", "figures=1", "scenes=8") == 0
    said = capsys.readouterr().out
    assert "epo generate data=rpi" in said
    assert f"{SCENES} example scenes" in said
    written = load_file(tmp_path / "predictions" / "forecasts.safetensors")
    assert written["states"].shape[:3] == (8, 2, 2)
    assert list((tmp_path / "predictions" / "figures").iterdir())
    assert {path: path.stat().st_mtime_ns for path in RPI.rglob("*")} == before


def test_a_run_folder_takes_precedence_and_unknown_names_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="rpi"):
        epo_lightning.load("rpj")
    assert RunFolder.open("rpi").path == RPI
    (tmp_path / "rpi").mkdir()
    with pytest.raises(ConfigError, match="is not a run folder"):
        RunFolder.open("rpi")


def test_a_packed_run_forecasts_like_the_run(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("train", "experiment=rpi/v_lstm_sc", *TINY, "run_dir=one") == 0
    with pytest.raises(ConfigError, match="score=test"):
        ship(RunFolder.open("one"), tmp_path / "packed")
    assert epo("evaluate", "run=one") == 0
    folder = ship(RunFolder.open("one"), tmp_path / "packed")
    scenes = pretrained.examples(folder)
    assert len(scenes.history) <= SCENES
    one = epo_lightning.load(tmp_path / "one" / "checkpoints" / "best.ckpt")
    packed = epo_lightning.load(folder / "checkpoints" / "best.ckpt")
    torch.testing.assert_close(packed.predict(scenes).states, one.predict(scenes).states, rtol=0, atol=0)
    assert (folder / "checkpoints" / "best.ckpt").stat().st_size * 2 < (
        tmp_path / "one/checkpoints/best.ckpt"
    ).stat().st_size
    assert sorted(path.name for path in folder.iterdir()) == sorted(path.name for path in RPI.iterdir())
