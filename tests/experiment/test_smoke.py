"""Every experiment file works: a few steps forward, backward, checkpoint and evaluation, on drawn scenes. `make smoke`"""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from suites import untrained

from epo_lightning.experiment import assembly, train
from epo_lightning.experiment.config.compose import compose, tree
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.evaluate import evaluate
from epo_lightning.files import read_json
from epo_lightning.schema import read

FOLDER = tree() / "conf" / "experiment"
ROWS = sorted(str(file.relative_to(FOLDER).with_suffix("")) for file in FOLDER.rglob("*.yaml"))
EXPERIMENTS = [row for row in ROWS if not row.startswith("urban/")]
"""All rows but those on urban roads, which on drawn scenes are the same as those on highways: test_urban_rows.py."""
LIKE = {"rpi": "rpi", "ucy": "pedestrians", "dut": "pedestrians"}
"""Kind of scenes by folder of experiments; other folders have highway scenes."""
WORDS = ("data=drawn", "data.scenes=16", "data.batch_size=4", "budget=smoke", "callbacks.progress=none")
ALIKE = re.compile(r"_no_pair$|(vibes|hivt_m)_(refined|epo_)")
"""Rows that differ from another row in `energy.pair: []`, or from one of V-LSTM in a backbone that a third row trains."""
FEWER = {f"table1/{row}_dsdnet": ["solver.candidates=20"] for row in ("rpi", "highway")}
"""Changes of rows that would take 20 s: comparing 100 candidates of every two agents is slow."""


@pytest.mark.parametrize(
    "experiment", [pytest.param(row, marks=pytest.mark.slow if ALIKE.search(row) else ()) for row in EXPERIMENTS]
)
def test_every_experiment_trains_and_is_scored(experiment: str, tmp_path: Path) -> None:
    like = LIKE.get(experiment.partition("/")[0], "highway")
    words = [*WORDS, *FEWER.get(experiment, ()), f"data.like={like}", f"runs={tmp_path}"]
    if experiment.startswith("highway/") and experiment.endswith("_refined"):
        row = read(Settings, compose("train", [f"experiment={experiment.removesuffix('_refined')}", *words]))
        model = assembly.describe_model(row, assembly.build_data(row.data))
        words.append(f"forecaster.frozen={untrained(model, tmp_path / 'frozen.ckpt')}")
    run = train.train(compose("train", [f"experiment={experiment}", *words]))
    assert run.record["steps"] == (8 if run.record["parameters"] else 0)
    evaluate({"run": str(run.path), "batch_size": 16})
    metrics = read_json(run.metrics_file())["metrics"]
    assert all(math.isfinite(value) for value in metrics.values())
    # Eight steps in, trajectories that are decoded as such are still anywhere: vehicles travel a hundred metres.
    assert 0 < metrics["minSADE"] < metrics["minSFDE"] < 150
