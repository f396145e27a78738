"""Score a run on a split that its training never saw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer, seed_everything

from epo_lightning.experiment import assembly, logs
from epo_lightning.experiment.config.settings import EvaluateSettings, Settings, TrainerSettings, read
from epo_lightning.experiment.opening import open_checkpoint, open_data, split_of
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover, write_json


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


def score(
    run: RunFolder,
    settings: EvaluateSettings,
    machine: TrainerSettings | None = None,
    devices: int | list[int] = 1,
) -> dict[str, float]:
    """Score one run and write its metrics file.

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
    loader = split_of(data, settings.split)
    seed_everything(of_run.seed, workers=True, verbose=False)
    machine = machine or of_run.trainer
    torch.set_num_threads(machine.threads)
    double = of_run.trainer.precision == "64-true"
    with assembly.naming(machine, run):
        trainer = Trainer(
            accelerator=machine.accelerator,
            devices=devices if machine.devices == 1 else 1,
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
