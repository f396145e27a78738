"""What watches a training run: random states, progress, and where the log goes."""

from __future__ import annotations

import csv
import math
import os
import random
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger

from epo_lightning.experiment.settings import CallbackSettings, CSVSettings, LoggerSettings, WandbSettings
from epo_lightning.run_folder import RunFolder


class RandomStates(Callback):
    """Keep the random number generators in the checkpoint, so that a continued run draws what it would have drawn.

    Lightning restores weights, optimiser and loops, but not these.
    """

    def __init__(self) -> None:
        self._restored: dict[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        name, keys, position, has_gauss, gauss = numpy.random.get_state()  # noqa: NPY002 - the global one is meant
        return {
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
            "numpy": [
                name,
                torch.tensor(numpy.asarray(keys, dtype="int64")),
                int(position),
                int(has_gauss),
                float(gauss),
            ],
            "python": random.getstate(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._restored = state_dict

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The checkpoint was written at the end of an epoch: restore right before the next one draws its order."""
        if self._restored is None:
            return
        states, self._restored = self._restored, None
        torch.set_rng_state(states["torch"].cpu())
        if states["cuda"] and torch.cuda.device_count() == len(states["cuda"]):
            torch.cuda.set_rng_state_all(states["cuda"])
        name, keys, position, has_gauss, gauss = states["numpy"]
        numpy.random.set_state((name, keys.numpy().astype("uint32"), position, has_gauss, gauss))  # noqa: NPY002
        version, internal, gauss_next = states["python"]
        random.setstate((version, tuple(internal), gauss_next))


class EpochLines(Callback):
    """One line per validated epoch: progress for log files and for several runs that share a terminal."""

    def __init__(self, title: str, monitor: str) -> None:
        self._title, self._monitor = title, monitor
        self._best = math.inf
        self._validated = False
        self._started = time.monotonic()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._started = time.monotonic()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._validated = True

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self._validated:
            return
        self._validated = False
        metrics = trainer.callback_metrics
        value = float(metrics.get(self._monitor, math.nan))
        self._best = min(self._best, value) if not math.isnan(value) else self._best
        loss = float(metrics.get("train/loss", math.nan))
        epochs = f"/{trainer.max_epochs}" if trainer.max_epochs and trainer.max_epochs > 0 else ""
        print(
            f"{self._title}: epoch {trainer.current_epoch + 1}{epochs}, step {trainer.global_step}, loss {loss:.4f}, "
            f"{self._monitor} {value:.4f} (best {self._best:.4f}), {time.monotonic() - self._started:.0f} s",
            flush=True,
        )


def watchers(settings: CallbackSettings, run: RunFolder, title: str) -> list[Callback]:
    """The callbacks of a run.

    The best checkpoint is chosen when a validation ends. The last one is written at the end of the epoch, after all
    other callbacks, because only there everything that the next epoch needs has its final value.
    """
    best = ModelCheckpoint(
        run.checkpoints,
        filename="best",
        monitor=settings.monitor,
        mode="min",
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
    last = ModelCheckpoint(
        run.checkpoints, filename="last", save_on_train_epoch_end=True, every_n_epochs=1, enable_version_counter=False
    )
    found: list[Callback] = [RandomStates(), best, last]
    if settings.patience is not None:
        stopping = EarlyStopping(
            settings.monitor,
            min_delta=settings.min_delta,
            patience=settings.patience,
            mode="min",
            check_on_train_epoch_end=False,
            check_finite=False,
        )
        found.insert(1, stopping)
    style = settings.progress
    if style == "auto":
        style = "bar" if sys.stdout.isatty() else "lines"
    if style == "bar":
        found.append(TQDMProgressBar(refresh_rate=settings.refresh))
    elif style == "lines":
        found.append(EpochLines(title, settings.monitor))
    return found


class CSVLog(CSVLogger):
    """``logs/metrics.csv``; a continued run keeps the rows up to the step it continues from."""

    def __init__(self, run: RunFolder, settings: CSVSettings, continued_from: int = 0) -> None:
        kept = _rows(run.logs / "metrics.csv", continued_from) if continued_from else []
        (run.logs / "metrics.csv").unlink(missing_ok=True)
        super().__init__(run.path, name=run.logs.name, version="", flush_logs_every_n_steps=settings.flush)
        if kept:
            self.experiment.metrics = kept
            self.save()


def _rows(path: Path, until: int) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = [{key: value for key, value in row.items() if key and value} for row in csv.DictReader(file)]
    return [row for row in rows if str(row.get("step", "")).isdigit() and int(row["step"]) < until]


def logs(settings: LoggerSettings, run: RunFolder, title: str, config: dict[str, Any], step: int = 0) -> list[Logger]:
    """The chosen loggers; the CSV file is always among them.

    Args:
        step: the optimisation step that a continued run starts from.
    """
    run.logs.mkdir(parents=True, exist_ok=True)
    found: list[Logger] = [CSVLog(run, settings.csv, step)]
    if settings.tensorboard is not None:
        board = TensorBoardLogger(run.path, name=run.logs.name, version="tensorboard", default_hp_metric=False)
        if settings.tensorboard.hyperparameters and not step:
            # The HPARAMS tab stays empty unless a metric is named together with the parameters.
            board.log_hyperparams(config, {"val/minSADE": math.nan})
        found.append(board)
    if settings.wandb is not None:
        found.append(_wandb(settings.wandb, run, title, config))
    return found


def _wandb(settings: WandbSettings, run: RunFolder, title: str, config: dict[str, Any]) -> WandbLogger:
    offline = settings.mode == "offline" or (settings.mode == "auto" and not _wandb_answers())
    if offline:
        print(f"W&B: offline; send it later with `wandb sync {run.logs / 'wandb' / 'wandb'}/offline-run-*`")
    folder = run.logs / "wandb"
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("WANDB_SILENT", "true")
    logger = WandbLogger(
        name=f"{title} (seed {config['seed']})",
        save_dir=folder,
        project=settings.project,
        entity=settings.entity,
        tags=list(settings.tags),
        offline=offline,
    )
    logger.experiment.config.update(config, allow_val_change=True)
    return logger


def _wandb_answers(patience: float = 2.0) -> bool:
    """Whether W&B can be used online. With a key but no network its own start takes two minutes before it gives up."""
    if not os.environ.get("WANDB_API_KEY"):
        return False
    server = urlsplit(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai"))
    try:
        port = server.port or (80 if server.scheme == "http" else 443)
        socket.create_connection((server.hostname or "", port), timeout=patience).close()
    except OSError:
        return False
    return True


def close(loggers: Sequence[Logger]) -> None:
    """End every log, so that a second run in the same process starts its own."""
    for logger in loggers:
        logger.save()
        if isinstance(logger, WandbLogger):
            import wandb

            wandb.finish()
