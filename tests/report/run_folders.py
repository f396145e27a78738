"""Small run folders as training and evaluation leave them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from epo_lightning.files import write_json
from epo_lightning.run_folder import RunFolder

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
    data: str = "rpi",
    digest: str = "abc",
    trained_digest: str | None = None,
    split: str = "test",
    experiment: str | None = None,
    settings: Mapping[str, Any] | None = None,
    command: str = "",
) -> RunFolder:
    """Write a run folder, evaluated if there are metrics; called again with another split, it is evaluated on both.

    Args:
        settings: values of the configuration by dotted key.
        command: recorded command of the training.
    """
    config: dict[str, Any] = {
        "title": title,
        "experiment": experiment,
        "seed": seed,
        "goal": goal,
        "budget": {"name": budget},
        "data": {"name": data, "batch_size": 32},
        "backbone": {"name": backbone, "width": 128},
        "forecaster": {"name": forecaster, "note": title},  # what has another title differs in something
        "solver": {"name": "levenberg_marquardt", "steps": 2},
        "optimizer": {"name": "adam", "lr": 0.001},
        "trainer": {"max_epochs": 10, "precision": "32-true", "threads": 1},
        "callbacks": {"patience": None},
    }
    for key, value in (settings or {}).items():
        section, last = key.split(".")
        config.setdefault(section, {})[last] = value
    record = {
        "data_digest": trained_digest or digest,
        "git_commit": "0123456789abcdef",
        "parameters": 1234,
        "command": command or f"epo train experiment={experiment} seed={seed}",
    }
    run = RunFolder(path)
    run.begin(config, record)
    if metrics is not None:
        write_json(run.metrics_file(split), {"data_digest": digest, "split": split, "metrics": dict(metrics)})
    return run
