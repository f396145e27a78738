"""Scores of trained runs on the test or validation split."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer, seed_everything

from epo_lightning import pretrained
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.experiment import assembly, logs
from epo_lightning.experiment.config.settings import EvaluateSettings, Settings, TrainerSettings
from epo_lightning.experiment.opening import open_checkpoint, open_data, split_of
from epo_lightning.experiment.truth import TruthTest
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover, read_json, write_json
from epo_lightning.schema import read

TOLERANCE = 1e-5
"""Relative difference below which two scores are the same: machines and batch sizes change the last digits."""


def evaluate(config: dict[str, Any]) -> list[tuple[RunFolder, Path, dict[str, float]]]:
    """Score one run, or all runs below a folder, and write each one's scores to a file.

    Returns:
        run, file and scores of every run.

    Raises:
        ConfigError: no run, a run that is not finished, changed data, or a checkpoint that does not fit.
    """
    assembly.quiet()
    settings = read(EvaluateSettings, config)
    return [(run, *score(run, settings)) for run in _chosen(settings)]


def _chosen(settings: EvaluateSettings) -> list[RunFolder]:
    if settings.run is not None:
        return [RunFolder.open(settings.run)]
    folder = Path(str(settings.runs)).expanduser()
    found = list(discover(folder))
    finished = [run for run in found if run.finished]
    if not finished:
        raise ConfigError(f"no finished run in or below {folder} ({len(found)} unfinished): train one with `epo train`")
    for run in found:
        if run not in finished:
            print(f"{run.path}: left out, not finished (`epo train resume={run.path}`)")
    return finished


def score(
    run: RunFolder,
    settings: EvaluateSettings,
    machine: TrainerSettings | None = None,
    devices: int | list[int] = 1,
) -> tuple[Path, dict[str, float]]:
    """Score one run and write its scores to a file (:func:`keep`), except for runs that ship with the package.

    Args:
        run: a finished run.
        settings: the split, the checkpoint and the batch size.
        machine: the accelerator and the threads to compute with; by default those that the run began with.
        devices: the device to compute on, as :func:`.gpus.placed` yields it.

    Raises:
        ConfigError: see :func:`evaluate`.
    """
    if not run.finished:
        raise ConfigError(f"{run.path} is not finished: continue it with `epo train resume={run.path}`")
    of_run = read(Settings, run.config())
    checkpoint = run.checkpoint(settings.checkpoint)
    forecaster = open_checkpoint(of_run, checkpoint)
    data = open_data(run, of_run, settings.batch_size)
    if data.task.subsets != forecaster.task.subsets:  # a checkpoint that is older than the subsets of its data
        forecaster.test_metrics = ForecastMetrics(data.task.subsets, data.task.shape)
    loader = split_of(data, settings.split)
    seed_everything(of_run.seed, workers=True, verbose=False)
    machine = machine or of_run.trainer
    torch.set_num_threads(machine.threads)
    double = of_run.trainer.precision == "64-true"
    truths = TruthTest(data.records(settings.split)["weight"]) if isinstance(data, RPIData) else None
    with assembly.naming(machine, run):
        trainer = Trainer(
            accelerator=machine.accelerator,
            devices=devices if machine.devices == 1 else 1,
            precision=None if double else of_run.trainer.precision,  # type: ignore[arg-type]
            plugins=[assembly.Double()] if double else None,
            deterministic=of_run.trainer.deterministic,
            inference_mode=False,  # the layer differentiates its energy also when it only forecasts
            callbacks=[] if truths is None else [truths],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
    with assembly.signals():
        (scores,) = trainer.test(forecaster, dataloaders=loader, verbose=False)
    metrics = {name.removeprefix("test/"): float(value) for name, value in scores.items()}
    if pretrained.ships(run.path):
        return run.metrics_file(settings.split), metrics
    scored = {
        "split": settings.split,
        "data_digest": data.digest,
        "checkpoint": settings.checkpoint if settings.checkpoint in ("best", "last") else checkpoint.name,
        "metrics": metrics,
    }
    if truths is not None and (costs := truths.scores()):
        scored["truth"] = costs
    file = keep(run, scored, checkpoint)
    if file == run.metrics_file():
        logs.publish(run)
    return file, metrics


def keep(run: RunFolder, scored: dict[str, Any], checkpoint: Path) -> Path:
    """Write scores without ever replacing others, and return the file that holds them.

    The scores of the best checkpoint are ``metrics.json`` (``metrics-val.json`` on the validation split). If that file holds
    the same scores already it stays as it is; if they lack scores that older versions did not compute, these are added.
    Scores of another checkpoint, and scores that differ from those in the file, go to
    ``scores-<split>-<checkpoint>-<digest>.json``, which records the digest of the checkpoint as well as of the data.
    """
    file = run.metrics_file(scored["split"])
    if scored["checkpoint"] == "best":
        if not _readable(file):
            write_json(file, scored)
        stored = read_json(file)
        if _same(stored, scored):
            completed = {**scored, **stored, "metrics": {**scored["metrics"], **stored["metrics"]}}
            if completed.keys() != stored.keys() or completed["metrics"].keys() != stored["metrics"].keys():
                write_json(file, completed)
            return file
    digest = hashlib.sha256(checkpoint.read_bytes()).hexdigest()[:16]
    other = run.path / f"scores-{scored['split']}-{Path(scored['checkpoint']).stem}-{digest[:8]}.json"
    if not other.is_file():
        write_json(other, {**scored, "checkpoint_digest": digest})
    return other


def _readable(file: Path) -> bool:
    """Whether a file holds scores. The caller replaces a missing or damaged file."""
    try:
        return isinstance(read_json(file).get("metrics"), dict)
    except ConfigError:
        return False


def _same(stored: dict[str, Any], scored: dict[str, Any]) -> bool:
    """Whether new scores are of the same data and checkpoint as stored ones, and equal them up to the last digits."""
    if any(stored.get(key) != scored[key] for key in ("split", "data_digest", "checkpoint")):
        return False
    pairs = [(value, scored["metrics"].get(name, math.inf)) for name, value in stored["metrics"].items()]
    return all(
        math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=1e-9) or (math.isnan(one) and math.isnan(other))
        for one, other in pairs
    )
