"""Logging of a run: ``logs/metrics.csv`` in its folder, and copies of it in dashboards (TensorBoard, W&B, MLflow).

Only an error of the CSV file (a full disk, for instance) ends a run. Dashboards are served by threads of their own
(:mod:`.dashboards.aside`); rows that a dashboard missed can be sent again from the run folder (:func:`publish`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import DashboardSettings, PredictSettings, Settings
from epo_lightning.experiment.csv_log import CSVLog
from epo_lightning.experiment.dashboards.aside import Aside
from epo_lightning.experiment.dashboards.base import Dashboard, Ending, Facts, Row
from epo_lightning.experiment.dashboards.mlflow import MLflow
from epo_lightning.experiment.dashboards.tensorboard import TensorBoard
from epo_lightning.experiment.dashboards.wandb import WandB
from epo_lightning.experiment.opening import open_checkpoint
from epo_lightning.experiment.pictures import choose, draw, forecast_of
from epo_lightning.files import read_json
from epo_lightning.identity import SECTIONS, identity
from epo_lightning.masking import mask
from epo_lightning.registry import kind_and_message
from epo_lightning.run_folder import RunFolder, read_log
from epo_lightning.schema import read


def rows(run: RunFolder) -> list[Row]:
    """Everything in the run's metrics.csv."""
    return [
        (int(row["step"]), {key: float(value) for key, value in row.items() if key != "step"})
        for row in read_log(run.logs / "metrics.csv")
    ]


def scores(run: RunFolder, monitor: str) -> dict[str, float]:
    """Summary of a run: ``best/...``, its validation scores in the epoch with the smallest ``monitor``, and ``test/...``."""
    validated = [metrics for _, metrics in rows(run) if monitor in metrics and metrics[monitor] == metrics[monitor]]
    best = min(validated, key=lambda metrics: metrics[monitor], default={})
    found = {f"best/{name[4:]}": value for name, value in best.items() if name.startswith("val/")}
    if run.metrics_file().is_file():
        found |= {f"test/{name}": float(value) for name, value in read_json(run.metrics_file())["metrics"].items()}
    return found


@contextmanager
def open_logs(settings: Settings, config: Mapping[str, Any], run: RunFolder, step: int = 0) -> Iterator[list[Logger]]:
    """Context with the loggers of a run, the CSV file first. They are closed at its end; after an exception, they report it.

    Args:
        config: the resolved configuration.
        step: the optimisation step that a continued run starts from.
    """
    run.logs.mkdir(parents=True, exist_ok=True)
    file = CSVLog(run, settings.logger.csv.flush, step)
    dashboards = _dashboards(settings, config, run)
    failed = True
    try:
        yield [file, *dashboards]
        file.save()
        failed = False
    finally:
        if failed:
            with suppress(OSError):  # an error here must not hide the exception that ended the training
                file.save()
        _close(dashboards, settings, run, failed)


def publish(run: RunFolder) -> None:
    """Send the contents of the run folder to the run's dashboards, after an evaluation or if a dashboard was unreachable."""
    config = run.config()
    settings = read(Settings, config)
    _close(_dashboards(settings, config, run), settings, run, failed=False)


def _dashboards(settings: Settings, config: Mapping[str, Any], run: RunFolder) -> list[Aside]:
    chosen = settings.logger
    if chosen.tensorboard is None and chosen.wandb is None and chosen.mlflow is None:
        return []
    facts, past = _facts(settings, config, run), rows(run)
    made: list[tuple[Dashboard, DashboardSettings]] = []
    if chosen.tensorboard is not None:
        made.append((TensorBoard(facts, chosen.tensorboard), chosen.tensorboard))
    if chosen.wandb is not None:
        made.append((WandB(facts, chosen.wandb), chosen.wandb))
    if chosen.mlflow is not None:
        made.append((MLflow(facts, chosen.mlflow, Path(settings.runs)), chosen.mlflow))
    return [Aside(dashboard, section.patience, past) for dashboard, section in made]


def _facts(settings: Settings, config: Mapping[str, Any], run: RunFolder) -> Facts:
    record = run.record
    key = record.get("identity") or identity(config, str(record.get("data_digest")))
    # The second in which the run began is part of the id. A run that begins anew (with corrected code) is then a new curve.
    began = "".join(filter(str.isdigit, str(record.get("began", ""))))
    sweep = run.config().get("sweep")  # of the command that began the run; another sweep may continue it
    return Facts(
        id=f"{key}-{began}",
        name=mask(f"{settings.title} (seed {settings.seed})"),
        group=Path(sweep).name if sweep else None,
        config=mask({name: config.get(name) for name in ("title", "experiment", "budget", *SECTIONS)}),
        tags={
            "identity": key,
            "data_digest": str(record.get("data_digest")),
            "commit": str(record.get("git_commit")),
        },
        folder=run.path,
    )


def _close(dashboards: Sequence[Aside], settings: Settings, run: RunFolder, failed: bool) -> None:
    if not dashboards:
        return
    chosen = (settings.logger.tensorboard, settings.logger.wandb, settings.logger.mlflow)
    count = 0 if failed else max(section.pictures for section in chosen if section is not None)
    pictures = _pictures(settings, run, count) if count else []
    ending = Ending(failed, scores(run, settings.callbacks.monitor), pictures)
    for dashboard in dashboards:
        dashboard.close(ending)


def _pictures(settings: Settings, run: RunFolder, count: int) -> list[Path]:
    """Pictures of forecasts of the best checkpoint on the validation split, in ``logs/figures``; existing ones are kept."""
    if drawn := sorted((run.logs / "figures").glob("*.png")):
        return drawn
    try:
        forecaster = open_checkpoint(settings, run.checkpoint("best"))
        data = assembly.build_data(settings.data)
        scenes, _ = choose(data, "val", max(64, count))
        request = PredictSettings(run=str(run.path), out=str(run.logs), split="val", figures=count)
        forecast = forecast_of(forecaster, scenes)
        return [path for path, _ in draw(request, settings.title, forecaster.task.shape, scenes, forecast)]
    except Exception as error:  # a run must not fail because a picture cannot be drawn
        print(f"{run.path}: no pictures ({mask(kind_and_message(error))[:300]})", file=sys.stderr)
        return []
