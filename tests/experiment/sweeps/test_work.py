"""One run of a sweep in a process that a launcher has chosen: its folder, its cache, and its score."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from experiment.conftest import TINY, Epo
from experiment.sweeps.rpi_sweep import the_sweep

from epo_lightning.experiment.sweeps.work import work


def test_a_worker_has_the_folder_and_the_cache_of_the_command_and_returns_the_score(
    epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "cache"))
    assert epo("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/v_lstm") == 0
    sweep = the_sweep()
    (job,) = sweep.jobs
    config, best = job.run.config(), job.run.record["best"]["val/minSADE"]
    monkeypatch.delenv("EPO_CACHE")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert work(sweep, config, job.overrides, ()) == best
    assert os.environ["EPO_CACHE"] == str(tmp_path / "cache")
    assert Path.cwd() == tmp_path
    assert len(sweep.jobs) == 1, "a run that the sweep knows is not listed as one that was found"


def test_a_worker_with_a_cache_of_its_own_keeps_it(epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "cache"))
    assert epo("sweep", "rpi_main", *TINY, "seed=0", "experiment=rpi/const_vel") == 0
    (job,) = the_sweep().jobs
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "of this machine"))
    work(the_sweep(), job.run.config(), job.overrides, ())
    assert os.environ["EPO_CACHE"] == str(tmp_path / "of this machine")


def test_lines_about_a_run_name_the_settings_in_which_it_differs(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    shown = ("callbacks.progress=lines" if word == "callbacks.progress=none" else word for word in TINY)
    assert epo("sweep", "rpi_main", *shown, "seed=0", "experiment=rpi/v_lstm", "backbone.width=16,32") == 0
    begun = [line for line in capsys.readouterr().out.splitlines() if "at most" in line]
    assert [line.partition(":")[0] for line in begun] == ["V-LSTM, width=16, seed 0", "V-LSTM, width=32, seed 0"]
