"""Score a run on a split that its training never saw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer, seed_everything

import epo_lightning
from epo_lightning.experiment import assembly, gpus, logs
from epo_lightning.experiment.config.settings import EvaluateSettings, Settings, TrainerSettings, read
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover, write_json

ARCHITECTURE = ("forecaster", "backbone", "energy", "dynamics", "solver", "backward")
"""Sections that a checkpoint has to share with its run."""


def evaluate(config: dict[str, Any]) -> list[tuple[RunFolder, dict[str, float]]]:
    """Score one run, or all runs below a folder, and write each one's metrics file.

    Raises:
        ConfigError: no run, a run that is not finished, changed data, or a checkpoint that does not fit.
    """
    assembly.quiet()
    settings = read(EvaluateSettings, config)
    return [(run, score(run, settings)) for run in _chosen(settings)]


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


def score(run: RunFolder, settings: EvaluateSettings, machine: TrainerSettings | None = None) -> dict[str, float]:
    """Score one run and write its metrics file.

    Args:
        run: a finished run.
        settings: the split, the checkpoint and the batch size.
        machine: the accelerator and the threads to compute with; by default those that the run began with.

    Raises:
        ConfigError: see :func:`evaluate`.
    """
    if not run.finished:
        raise ConfigError(f"{run.path} is not finished: continue it with `epo train resume={run.path}`")
    of_run = read(Settings, run.config())
    checkpoint = run.checkpoint(settings.checkpoint)
    forecaster = open_checkpoint(of_run, checkpoint)
    data = open_data(run, of_run, settings.batch_size)
    loader = split_of(data, settings.split)
    seed_everything(of_run.seed, workers=True, verbose=False)
    machine = machine or of_run.trainer
    torch.set_num_threads(machine.threads)
    double = of_run.trainer.precision == "64-true"
    with assembly.naming(machine, run):
        trainer = Trainer(
            accelerator=machine.accelerator,
            devices=gpus.devices(machine) if machine.devices == 1 else 1,
            precision=None if double else of_run.trainer.precision,  # type: ignore[arg-type]
            plugins=[assembly.Double()] if double else None,
            deterministic=of_run.trainer.deterministic,
            inference_mode=False,  # the layer differentiates its energy also when it only forecasts
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
    with assembly.signals():
        (scores,) = trainer.test(forecaster, dataloaders=loader, verbose=False)
    metrics = {name.removeprefix("test/"): float(value) for name, value in scores.items()}
    write_json(
        run.metrics_file(settings.split),
        {
            "split": settings.split,
            "data_digest": data.digest,
            "checkpoint": settings.checkpoint if settings.checkpoint in ("best", "last") else checkpoint.name,
            "metrics": metrics,
        },
    )
    if settings.split == "test":
        logs.publish(run)
    return metrics


def open_checkpoint(settings: Settings, path: Path) -> Any:
    """The forecaster in a checkpoint, which must be of the architecture that ``settings`` describe.

    Raises:
        ConfigError: the file is missing, no checkpoint, or of another architecture; the message names the difference.
    """
    forecaster = epo_lightning.load(path)
    expected = assembly.describe_model(settings, assembly.build_data(settings.data))
    found = forecaster.configuration
    for section in (*ARCHITECTURE, "goal", "horizon", "dt"):
        if found.get(section) != expected[section]:
            raise ConfigError(
                f"{path} holds another architecture than this run: {section} is {found.get(section)} in the checkpoint "
                f"and {expected[section]} in the run's config.yaml"
            )
    return forecaster


def open_data(run: RunFolder, settings: Settings, batch_size: int | None = None) -> Any:
    """The run's data, which must be what it was trained on.

    Raises:
        ConfigError: the data is missing or has changed.
    """
    section = dict(settings.data)
    if batch_size is not None and "batch_size" in section:
        section["batch_size"] = batch_size
    data = assembly.build_data(section)
    data.setup("test")
    began_with = run.record.get("data_digest")
    if began_with != data.digest:
        raise ConfigError(
            f"the data has changed since {run.path} was trained (digest {began_with}, now {data.digest}): bring it back, "
            "or train again"
        )
    return data


def split_of(data: Any, split: str) -> Any:
    """The loader of a split, in a fixed order."""
    if split == "test":
        return data.test_dataloader()
    data.setup("validate")
    return data.val_dataloader()
