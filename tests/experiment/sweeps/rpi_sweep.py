"""A sweep over four rows of RPI."""

from __future__ import annotations

from pathlib import Path

from epo_lightning.experiment.sweeps.sweep import Sweep

SRC = Path(__file__).parents[3]


def the_sweep(runs: str = "runs") -> Sweep:
    (record,) = Path(runs).glob("sweeps/*/sweep.json")
    return Sweep(record.parent.absolute())
