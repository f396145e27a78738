"""Evaluated runs, read from the folders that training and evaluation left behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover, read_json


@dataclass(frozen=True)
class EvaluatedRun:
    """One run and its scores.

    Attributes:
        path: the run folder.
        name: how its row is called in tables.
        seed: of the run.
        data: what its data set is called.
        backbone, forecaster: names of its parts.
        experiment: the configuration file it was made from, empty for none.
        goal: who knows a given goal, ``energy`` or ``all``.
        budget: name of its budget.
        split: which part of the data it was evaluated on.
        data_digest: digest of the data it was evaluated on.
        trained_digest: digest of the data it was trained on.
        metrics: scores by name, displacements in m.
        git_commit: of the code, where known.
        parameters: number of trained parameters, where known.
    """

    path: Path
    name: str
    seed: int
    data: str
    backbone: str
    forecaster: str
    experiment: str
    goal: str
    budget: str
    split: str
    data_digest: str
    trained_digest: str
    metrics: Mapping[str, float]
    git_commit: str
    parameters: int | None

    @property
    def learned(self) -> bool:
        """Whether anything was trained: constant velocity knows neither a budget nor training data."""
        return self.forecaster != "constant_velocity"


def collect(folder: str | Path) -> list[EvaluatedRun]:
    """All evaluated runs in and below a folder, in the order of their paths.

    Raises:
        ConfigError: no folder, no run or no evaluated run (with the command that makes one), or a damaged file.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ConfigError(f"no folder {folder} to report on: train a run first, epo train experiment=rpi/v_lstm_epo")
    known = list(discover(folder))
    evaluated = [run for run in known if run.metrics_file().is_file()]
    if not known:
        raise ConfigError(f"no run in or below {folder}: train one first, epo train experiment=rpi/v_lstm_epo")
    if not evaluated:
        raise ConfigError(
            f"none of the {len(known)} runs in or below {folder} is evaluated: epo evaluate runs={folder} does it"
        )
    return [read_run(run) for run in evaluated]


def not_evaluated(folder: str | Path) -> list[Path]:
    """Run folders in and below a folder that a report has to leave out."""
    return [run.path for run in discover(Path(folder).expanduser()) if not run.metrics_file().is_file()]


def read_run(run: RunFolder) -> EvaluatedRun:
    """Read one evaluated run folder.

    Raises:
        ConfigError: a file is missing or damaged, or lacks an entry; the message names both.
    """
    config, record, result = run.config(), run.record, read_json(run.metrics_file())

    def entry(content: Any, file: Path, *keys: str) -> Any:
        for key in keys:
            content = content.get(key) if isinstance(content, Mapping) else None
        if content is None:
            raise ConfigError(f"{file} has no entry {'.'.join(keys)}: was it written by another version?")
        return content

    metrics = entry(result, run.metrics_file(), "metrics")
    if not isinstance(metrics, Mapping) or not all(isinstance(value, int | float) for value in metrics.values()):
        raise ConfigError(f"{run.metrics_file()}: metrics must be numbers by name")
    digest = str(entry(result, run.metrics_file(), "data_digest"))
    return EvaluatedRun(
        path=run.path,
        name=str(entry(config, run.config_file, "title")),
        seed=int(entry(config, run.config_file, "seed")),
        data=str(entry(config, run.config_file, "data", "dataset" if "dataset" in config.get("data", {}) else "name")),
        backbone=str(entry(config, run.config_file, "backbone", "name")),
        forecaster=str(entry(config, run.config_file, "forecaster", "name")),
        experiment=str(config.get("experiment") or ""),
        goal=str(config.get("goal", "energy")),
        budget=str(entry(config, run.config_file, "budget", "name")),
        split=str(result.get("split", "test")),
        data_digest=digest,
        trained_digest=str(record.get("data_digest") or digest),
        metrics={name: float(value) for name, value in metrics.items()},
        git_commit=str(record.get("git_commit") or "unknown"),
        parameters=record.get("parameters"),
    )
