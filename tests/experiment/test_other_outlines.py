"""Overlap rates on other data are those of the outlines that the other data's agents have."""

from __future__ import annotations

import json
from pathlib import Path

from experiment import pedestrians
from experiment.conftest import Epo

from epo_lightning.experiment.opening import open_checkpoint, settings_of
from epo_lightning.experiment.other_data import open_other
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.run_folder import RunFolder


def test_pedestrians_are_discs_also_for_a_run_of_vehicles(epo: Epo, tmp_path: Path) -> None:
    drawn = ("data=drawn", "data.like=highway", "data.scenes=24")
    quiet = ("budget=untrained", "callbacks.progress=none")
    assert epo("train", "experiment=highway/const_vel", *drawn, *quiet, "run_dir=run") == 0
    folder = pedestrians.square(tmp_path / "data", seed=3)  # some of them meet
    assert epo("evaluate", "run=run", "data=ucy", f"data.folder={folder}", "workers=1") == 0
    (file,) = Path("run").glob("scores-on-*.json")
    written = json.loads(file.read_text())
    run = RunFolder(Path("run"))
    settings = settings_of(run)
    forecaster = open_checkpoint(settings, run.checkpoint())
    other = open_other(run, settings, forecaster, written["settings"], "all", {"data.root"}, workers=1)
    rates = {}
    for shape in ("disc", "box"):
        metrics = ForecastMetrics(other.task.subsets, shape)
        for batch in other.loader(64):
            metrics.update(forecaster.predict(batch), batch)
        rates[shape] = float(metrics.compute()["overlap_jfp"])
    assert forecaster.task.shape == "box"
    assert rates["disc"] != rates["box"]
    assert written["metrics"]["overlap_jfp"] == rates["disc"]
