"""Small run folders as training and evaluation leave them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from epo_lightning.run_folder import RunFolder, write_json

METRICS = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp", "overlap_authors")


def scores(value: float, overlap: float = 0.0) -> dict[str, float]:
    """Metrics of which every displacement is ``value``."""
    return {metric: overlap if "overlap" in metric else value for metric in METRICS}


def make_run(
    path: Path,
    title: str,
    forecaster: str,
    metrics: Mapping[str, float] | None,
    *,
    seed: int = 0,
    backbone: str = "v_lstm",
    goal: str = "energy",
    budget: str = "reduced",
    digest: str = "abc",
    trained_digest: str | None = None,
    split: str = "test",
) -> RunFolder:
    """Write a run folder, evaluated if there are metrics."""
    config: dict[str, Any] = {
        "title": title,
        "seed": seed,
        "goal": goal,
        "budget": {"name": budget},
        "data": {"name": "rpi", "batch_size": 32},
        "backbone": {"name": backbone},
        "forecaster": {"name": forecaster},
    }
    run = RunFolder(path)
    run.begin(config, {"data_digest": trained_digest or digest, "git_commit": "0123456789abcdef", "parameters": 1234})
    if metrics is not None:
        write_json(run.metrics_file(), {"data_digest": digest, "split": split, "metrics": dict(metrics)})
    return run
