"""Callbacks of a training run: checkpoints of its best and last epoch, early stopping, random states and progress."""

from __future__ import annotations

import contextlib
import math
import os
import random
import socket
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch import callbacks as of_lightning
from lightning.pytorch.callbacks import TQDMProgressBar

from epo_lightning.experiment.config.settings import CallbackSettings
from epo_lightning.files import write_json
from epo_lightning.forecasters.step_means import StepMeans
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.report.columns import is_own
from epo_lightning.run_folder import RunFolder


class RandomStates(Callback):
    """Callback that stores the states of all random number generators in checkpoints and restores them.

    A continued run then draws the same random numbers as an uninterrupted one. Lightning itself restores weights, optimiser
    and loops only.
    """

    def __init__(self) -> None:
        self._restored: dict[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        name, keys, position, has_gauss, gauss = numpy.random.get_state()  # noqa: NPY002 - numpy's global generator
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
        """Restore the states. They were stored at the end of an epoch, and this epoch has not drawn any number yet.

        In an uninterrupted run, the loader's iterator of this epoch is created after this call, and draws a number. In a
        continued run, Lightning has created it already; it is created again.
        """
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
        batches = trainer.fit_loop._data_fetcher
        assert batches is not None
        iter(batches)


class NextEpoch(Callback):
    """Callback that begins a continued run with the epoch after its checkpoint, also if the run ends after some steps.

    The checkpoint is written at the end of an epoch, before Lightning counts the epoch as completed. In a run of a number of
    epochs, Lightning goes on with the next one. In a run of a number of steps, Lightning enters the same epoch again: it
    takes a batch more, or counts the epochs wrongly, on which the order of the scenes depends.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        loop = trainer.fit_loop
        if not loop.restarted_on_epoch_end:
            return
        loop.epoch_progress.increment_completed()
        loop.on_iteration_done()  # as after an epoch of an uninterrupted run
        # The setter of `loop` itself ignores this value in runs of a number of steps.
        loop.epoch_loop.restarting = False


# ModelCheckpoint and EarlyStopping have the names of Lightning's classes: checkpoints store callback states under them.


class ModelCheckpoint(of_lightning.ModelCheckpoint):
    """Lightning's ModelCheckpoint, whose stored paths follow a run folder that was moved."""

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking or _decides(self.monitor, trainer, pl_module):
            super().on_validation_end(trainer, pl_module)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        def here(path: str) -> str:
            return str(Path(str(self.dirpath)) / Path(path).name) if path else path

        moved = {
            "dirpath": self.dirpath,
            "best_k_models": {here(path): score for path, score in state_dict["best_k_models"].items()},
            **{key: here(state_dict[key]) for key in ("best_model_path", "kth_best_model_path", "last_model_path")},
        }
        super().load_state_dict({**state_dict, **moved})


class LastCheckpoint(ModelCheckpoint):
    """The checkpoint of the end of an epoch, which gets its name ``last`` when the epoch's row is in the log.

    Lightning logs that row after all callbacks. A run that is stopped in between continues from the epoch before, so that
    its log has every row.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(
            folder, filename="ended", save_on_train_epoch_end=True, every_n_epochs=1, enable_version_counter=False
        )
        self._ended, self._last = folder / "ended.ckpt", folder / "last.ckpt"

    @property
    def state_key(self) -> str:
        """Key of a :class:`ModelCheckpoint`, as in runs of earlier versions: there, Lightning warns of any other key."""
        return super().state_key.replace(type(self).__name__, ModelCheckpoint.__name__, 1)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Reads nothing: all paths are known.

        Earlier versions stored ``last.ckpt`` as the path of their latest file. Lightning would delete it before the new one
        has its name, in a run folder that is reached through a link.
        """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_global_zero:
            self._ended.unlink(missing_ok=True)  # of a run that was stopped before the row

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_global_zero and self._ended.is_file():
            self._ended.replace(self._last)

    on_train_end = on_train_epoch_start


class EarlyStopping(of_lightning.EarlyStopping):
    """Lightning's EarlyStopping, which also stops a continued run that had run out of patience before it was killed."""

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking or _decides(self.monitor, trainer, pl_module):
            super().on_validation_end(trainer, pl_module)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        trainer.should_stop = trainer.should_stop or self.wait_count >= self.patience


def _decides(monitor: str | None, trainer: Trainer, module: LightningModule) -> bool:
    """Whether a validation has a value of the monitored score; a metric of the user may have none in any scene.

    Raises:
        ConfigError: the forecaster does not log this score; the message names those that it logs.
    """
    if monitor is None:
        return True
    if _without_value(monitor, module):
        warnings.warn(f"callbacks.monitor={monitor} has no value in a validation, which is left out", stacklevel=2)
        return False
    if monitor not in trainer.callback_metrics:
        raise ConfigError(
            f"callbacks.monitor={monitor} is not logged by this forecaster: {nearest(monitor, trainer.callback_metrics)}"
        )
    return True


def _without_value(monitor: str, module: LightningModule) -> bool:
    """Whether a score is a metric of the user that had no value in the last validation; Lightning keeps an earlier one."""
    return is_own(monitor) and monitor not in module.scored  # type: ignore[operator]


class EpochLines(Callback):
    """Callback that prints one line per validated epoch, for log files and for several runs in one terminal.

    The line is printed before the losses of the epoch are logged. With several devices, it prints the loss of the first one.
    """

    def __init__(self, title: str, monitor: str) -> None:
        self._title, self._monitor = title, monitor
        self._best = math.inf
        self._validated: int | None = None
        self._started = time.monotonic()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._started = time.monotonic()
        for kept in trainer.checkpoint_callbacks:  # of a resumed run, they hold the best score so far
            if isinstance(kept, ModelCheckpoint) and kept.monitor and kept.best_model_score is not None:
                self._best = float(kept.best_model_score)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._validated = None if trainer.sanity_checking else trainer.global_step

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if (validated := self._validated) is None:
            return
        self._validated = None
        metrics = trainer.callback_metrics
        lost = _without_value(self._monitor, pl_module)
        value = math.nan if lost else float(metrics.get(self._monitor, math.nan))
        self._best = min(self._best, value) if not math.isnan(value) else self._best
        means: StepMeans = pl_module.step_means  # type: ignore[assignment]
        loss = float(means.means().get("train/loss", math.nan))
        epochs = f"/{trainer.max_epochs}" if trainer.max_epochs and trainer.max_epochs > 0 else ""
        at = f"at step {validated}, " if validated < trainer.global_step else ""  # the epoch went on after it
        print(
            f"{self._title}: epoch {trainer.current_epoch + 1}{epochs}, step {trainer.global_step}, loss {loss:.4f}, "
            f"{self._monitor} {value:.4f} ({at}best {self._best:.4f}), {time.monotonic() - self._started:.0f} s",
            flush=True,
        )


class FirstLine(Callback):
    """Callback that prints the length and the folder of a training when it begins, long before its first epoch ends."""

    def __init__(self, title: str, folder: Path) -> None:
        self._title, self._folder = title, folder

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        steps = trainer.estimated_stepping_batches
        length = f"at most {steps:.0f} steps" if math.isfinite(steps) else "no limit of steps"
        begun = f"from step {trainer.global_step}, " if trainer.global_step else ""
        print(f"{self._title}: {begun}{length}, in {self._folder}", flush=True)


class ScoringLines(Callback):
    """Callback that prints how many scenes are scored, every half minute: games that are solved to their end take minutes.

    Args:
        scenes: number of scenes that are scored.
    """

    every = 30.0
    """Time [s] between two lines."""

    def __init__(self, scenes: int) -> None:
        self._scenes, self._scored = scenes, 0
        self._began = self._told = time.monotonic()

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        self._scored += len(batch.history)
        now = time.monotonic()
        if now - self._told < self.every or not 0 < self._scored < self._scenes:
            return
        self._told = now
        left = (now - self._began) * (self._scenes - self._scored) / self._scored
        print(f"{self._scored} of {self._scenes} scenes scored, about {left:.0f} s left", flush=True)


class Progress(Callback):
    """Callback that writes the current step to ``progress.json`` in the run folder every few seconds."""

    def __init__(self, run: RunFolder, every: float = 2.0) -> None:
        self._run, self._every = run, every
        self._began = self._told = -math.inf
        self._from_step = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._began, self._from_step = time.monotonic(), trainer.global_step
        self._tell(trainer)

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        self._tell(trainer)

    def on_validation_batch_end(self, trainer: Trainer, *_: Any) -> None:
        self._tell(trainer)

    def _tell(self, trainer: Trainer) -> None:
        now = time.monotonic()
        if now - self._told < self._every or not math.isfinite(self._began):
            return
        self._told = now
        steps = trainer.estimated_stepping_batches
        content = {
            "step": trainer.global_step,
            "from_step": self._from_step,
            "steps": int(steps) if math.isfinite(steps) else None,
            "seconds": now - self._began,
            "host": socket.gethostname(),
            "process": os.getpid(),
            "time": time.time(),
        }
        with contextlib.suppress(OSError):  # a full disk is reported when a checkpoint or the log is written
            write_json(self._run.progress_file, content)


def style_of(settings: CallbackSettings) -> str:
    """How progress is shown here: ``bar``, ``lines`` or ``none``."""
    if settings.progress == "auto":
        return "bar" if sys.stdout.isatty() else "lines"
    return settings.progress


def run_callbacks(settings: CallbackSettings, run: RunFolder, title: str) -> list[Callback]:
    """The callbacks of a run.

    The checkpoint ``best`` is written when a validation ends. The checkpoint ``last`` is written at the end of the epoch,
    after all other callbacks: only then everything that the next epoch needs has its final value.
    """
    best = ModelCheckpoint(
        run.checkpoints,
        filename="best",
        monitor=settings.monitor,
        mode="min",
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
    found: list[Callback] = [NextEpoch(), RandomStates(), Progress(run), best, LastCheckpoint(run.checkpoints)]
    if settings.patience is not None:
        stopping = EarlyStopping(
            settings.monitor,
            min_delta=settings.min_delta,
            patience=settings.patience,
            mode="min",
            check_on_train_epoch_end=False,
            check_finite=False,
        )
        found.insert(3, stopping)
    style = style_of(settings)
    if style in ("bar", "lines"):
        found.append(FirstLine(title, run.path))
    if style == "bar":
        found.append(TQDMProgressBar(refresh_rate=settings.refresh))
    elif style == "lines":
        found.append(EpochLines(title, settings.monitor))
    return found
