"""Scores of trained runs, on the test or validation split of their data, or on other data."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.callbacks import TQDMProgressBar

from epo_lightning import pretrained
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.experiment import assembly, gpus, logs
from epo_lightning.experiment.callbacks import ScoringLines, style_of
from epo_lightning.experiment.config.replaced import keys_of
from epo_lightning.experiment.config.settings import EvaluateSettings, Settings, TrainerSettings
from epo_lightning.experiment.opening import open_checkpoint, open_data, refuse_unfinished, settings_of, split_of
from epo_lightning.experiment.other_data import open_other
from epo_lightning.experiment.provenance import of_other_code
from epo_lightning.experiment.score_files import alone, keep, keep_other
from epo_lightning.experiment.truth import TruthTest
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.registry import ConfigError
from epo_lightning.report.columns import TRUE
from epo_lightning.run_folder import RunFolder, discover, neighbour
from epo_lightning.schema import read


def evaluate(config: dict[str, Any], overrides: Sequence[str] = ()) -> list[tuple[RunFolder, Path, dict[str, float]]]:
    """Score one run, or all runs below a folder, and write each one's scores to a file.

    Args:
        config: the resolved configuration of ``epo evaluate`` as plain values.
        overrides: the user's overrides; settings of other data that they name do not follow the run.

    Returns:
        run, file and scores of every run, with the errors of inferred costs where the true ones are known.

    Raises:
        ConfigError: no run, a run that is not finished, changed data, or a checkpoint that does not fit. Among several
            runs, those that cannot be scored are left out with a line each, unless that is all of them.
    """
    assembly.quiet()
    settings, given = read(EvaluateSettings, config), keys_of(overrides)
    scored, refused = [], []
    for run in _chosen(settings):
        try:
            scored.append((run, *score(run, settings, given=given)))
        except ConfigError as error:
            if settings.run is not None:
                raise
            refused.append(error)
            print(f"{run.path}: left out, {error}")
    others = [run for run, *_ in scored if of_other_code(run.record) and not pretrained.ships(run.path)]
    if others:
        print(
            f"{len(others)} of the {len(scored)} scored runs were trained by other code than the present one, the first one "
            f"{others[0].path}: if their forecaster has changed, train them again in another folder"
        )
    if refused and scored:
        print(f"{len(refused)} of {len(refused) + len(scored)} runs left out")
    if refused and not scored:
        where = "" if settings.data is None else " on this data"
        raise ConfigError(f"no run in or below {settings.runs} can be scored{where}: {refused[0]}")
    return scored


def _chosen(settings: EvaluateSettings) -> list[RunFolder]:
    if settings.run is not None:
        return [RunFolder.open(settings.run)]
    folder = Path(str(settings.runs)).expanduser()
    if not folder.is_dir():
        beside = neighbour(folder)
        raise ConfigError(
            f"no folder {folder} of runs: " + (f"did you mean {beside}?" if beside else "it does not exist")
        )
    found = list(discover(folder))
    finished = []
    for run in found:
        try:
            if run.finished:
                finished.append(run)
                continue
            failed = run.state == "failed"
            why = f"failed: {run.record.get('error')}" if failed else f"not finished (`epo train resume={run.path}`)"
        except ConfigError as damaged:
            why = str(damaged)
        print(f"{run.path}: left out, {why}")
    if not finished:
        raise ConfigError(f"no finished run in or below {folder} ({len(found)} others): train one with `epo train`")
    return finished


def score(
    run: RunFolder,
    settings: EvaluateSettings,
    machine: TrainerSettings | None = None,
    devices: int | list[int] = 1,
    given: Collection[str] = (),
) -> tuple[Path, dict[str, float]]:
    """Score one run and write its scores to a file, except for runs that ship with the package.

    Scores on the run's own data go to the files of :func:`.score_files.keep`, those on other data to those of
    :func:`.score_files.keep_other`.

    Args:
        run: a finished run.
        settings: the data, the split, the checkpoint and the batch size.
        machine: the accelerator and the threads to compute with; by default those that the run began with.
        devices: the device to compute on, as :func:`.gpus.placed` yields it.
        given: keys that the user has set (:func:`.other_data.open_other`).

    Raises:
        ConfigError: see :func:`evaluate`.
    """
    refuse_unfinished(run)
    if not pretrained.ships(run.path) and not os.access(run.path, os.W_OK):
        raise ConfigError(
            f"{run.path} cannot be written, and its scores are kept there: score a copy that you may write"
        )
    of_run = settings_of(run)
    checkpoint = run.checkpoint(settings.checkpoint)
    forecaster = open_checkpoint(of_run, checkpoint)
    which = settings.checkpoint if settings.checkpoint in ("best", "last") else checkpoint.name
    if settings.data is not None:
        other = open_other(run, of_run, forecaster, settings.data, settings.split, given, settings.workers)
        forecaster.test_metrics = ForecastMetrics(other.task.subsets, other.task.shape)
        metrics, _ = _test(run, of_run, forecaster, other.loader(settings.batch_size), machine, devices)
        for note in other.notes:
            print(f"  {note}")
        if pretrained.ships(run.path):
            return run.path, metrics
        with alone(run):
            return keep_other(run, other, which, checkpoint, metrics), metrics
    data = open_data(run, of_run, settings.batch_size)
    if data.task.subsets != forecaster.task.subsets:  # a checkpoint that is older than the subsets of its data
        forecaster.test_metrics = ForecastMetrics(data.task.subsets, data.task.shape)
    loader = split_of(data, settings.own_split)
    truths = TruthTest(data.records(settings.own_split)["weight"]) if isinstance(data, RPIData) else None
    metrics, costs = _test(run, of_run, forecaster, loader, machine, devices, truths)
    shown = {**metrics, **{f"{TRUE}{name}": value for name, value in costs.items()}}
    if pretrained.ships(run.path):
        return run.metrics_file(settings.own_split), shown
    scored = {"split": settings.own_split, "data_digest": data.digest, "checkpoint": which, "metrics": metrics}
    if costs:
        scored["truth"] = costs
    with alone(run):
        file = keep(run, scored, checkpoint)
    if file == run.metrics_file():
        logs.publish(run)
    return file, shown


def _test(
    run: RunFolder,
    of_run: Settings,
    forecaster: Any,
    loader: Any,
    machine: TrainerSettings | None,
    devices: int | list[int],
    truths: TruthTest | None = None,
) -> tuple[dict[str, float], dict[str, Any]]:
    """Scores of a forecaster on the batches of a loader, and the costs of ``truths``."""
    style = style_of(of_run.callbacks)
    scenes = len(loader.dataset) if hasattr(loader, "dataset") else None  # a loader of one's own may not say it
    if style != "none":
        print("scoring" if scenes is None else f"scoring {scenes} scenes", flush=True)
    seed_everything(of_run.seed, workers=True, verbose=False)
    machine = machine or of_run.trainer
    torch.set_num_threads(machine.threads)
    double = of_run.trainer.precision == "64-true"
    with assembly.naming(machine, run):
        trainer = Trainer(
            accelerator=gpus.accelerator(replace(machine, graph=False)),  # graphs are of training steps
            devices=devices if machine.devices == 1 else 1,
            precision=None if double else of_run.trainer.precision,  # type: ignore[arg-type]
            plugins=[assembly.Double()] if double else None,
            deterministic=of_run.trainer.deterministic,
            inference_mode=False,  # the layer differentiates its energy also when it only forecasts
            callbacks=[
                *([] if truths is None else [truths]),
                *([TQDMProgressBar(refresh_rate=of_run.callbacks.refresh)] if style == "bar" else []),
                *([ScoringLines(scenes)] if style == "lines" and scenes is not None else []),
            ],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=style == "bar",
            enable_model_summary=False,
        )
    with assembly.signals():
        (scores,) = trainer.test(forecaster, dataloaders=loader, verbose=False)
    metrics = {name.removeprefix("test/"): float(value) for name, value in scores.items()}
    return metrics, {} if truths is None else truths.scores()
