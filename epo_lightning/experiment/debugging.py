"""Debugging of a training: overfitting a few batches, profiling steps, locating the first number that is not finite."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from lightning import LightningDataModule
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor, nn
from torch.autograd.profiler_util import EventList
from torch.profiler import ProfilerActivity, profile
from torch.utils.data import DataLoader
from torch.utils.hooks import RemovableHandle
from torchmetrics import Metric

from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.files import write_file
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.scene import Scene

WARM_UP, PROFILED = 5, 10
"""Number of training steps before the profile begins, and number that it covers."""
ROWS = 40
"""Largest number of rows in the profile's table."""
MOST_SCENES = 16
"""Largest number of scenes that a message names."""


def debug_callbacks(settings: TrainerSettings, run: RunFolder) -> list[Callback]:
    """Debugging callbacks that a configuration asks for."""
    found: list[Callback] = []
    if settings.profiler:
        found.append(Profile(run.path / "profile"))
    if settings.detect_anomaly:
        found.append(NonFinite())
    return found


class FewBatches(LightningDataModule):
    """Data module with the first batches of the training split in every epoch, for training and for validation.

    Args:
        data: data module whose batches are taken.
        batches: number of batches.
    """

    def __init__(self, data: LightningDataModule, batches: int) -> None:
        super().__init__()
        self.batches = list(islice(data.train_dataloader(), batches))

    def train_dataloader(self) -> DataLoader:
        return DataLoader(self.batches, batch_size=None)  # type: ignore[arg-type]  # a list is enough of a data set

    def val_dataloader(self) -> DataLoader:
        return self.train_dataloader()


class Profile(Callback):
    """Callback that profiles a few training steps: a table of the most expensive operations, and a trace.

    Args:
        folder: folder for ``operations.txt`` and ``trace.json.gz``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: profile | None = None
        self._steps = 0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Scene, batch_idx: int) -> None:
        if self._steps == WARM_UP and trainer.is_global_zero:
            gpu = [ProfilerActivity.CUDA] if torch.cuda.is_available() else []
            self._running = profile(activities=[ProfilerActivity.CPU, *gpu])
            self._running.start()
        self._steps += 1

    def on_train_batch_end(self, *_: Any) -> None:
        if self._steps == WARM_UP + PROFILED:
            self._write()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._write()
        if self._steps <= WARM_UP:
            print(f"profile: none, the training has {self._steps} steps and the profile begins after {WARM_UP}")

    def _write(self) -> None:
        """End the profile, write its files, and print their paths."""
        if self._running is None:
            return
        running, self._running = self._running, None
        running.stop()
        operations: EventList = running.key_averages()
        order = "self_cuda_time_total" if torch.cuda.is_available() else "self_cpu_time_total"
        table = operations.table(sort_by=order, row_limit=ROWS, max_name_column_width=60)
        steps = self._steps - WARM_UP
        write_file(
            self.folder / "operations.txt", f"{steps} training steps, the most expensive operations first\n{table}"
        )
        running.export_chrome_trace(str(self.folder / "trace.json.gz"))
        print(f"profile of {steps} training steps: {self.folder / 'operations.txt'}")
        print(f"trace: {self.folder / 'trace.json.gz'}, for https://ui.perfetto.dev or chrome://tracing")


class NonFinite(Callback):
    """Callback that stops at the first number that is not finite: in the data, a module's output, the loss or a gradient.

    Raises:
        ConfigError: in that training step; names the step, the module, loss term or parameter, and the scenes.
    """

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._hooks: list[RemovableHandle] = []
        self._step = 0

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for name, module in pl_module.named_modules():
            if not isinstance(module, Metric):
                # Submodules return before their parent, so the first error names the innermost module.
                self._hooks.append(module.register_forward_hook(partial(self._look, name or "the forecaster")))

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        for hook in self._hooks:
            hook.remove()
        self._hooks.clear()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Scene, batch_idx: int) -> None:
        self._scene, self._step = batch, trainer.global_step
        broken = (~batch.finite).nonzero().flatten().tolist()
        if broken:
            self._stop("the data contain numbers that are not finite", broken)

    def _look(self, name: str, module: nn.Module, _: Any, output: Any) -> None:
        if not module.training or self._scene is None:
            return
        for tensor in _tensors(output):
            if tensor.is_floating_point() and not tensor.isfinite().all():
                number = "nan" if tensor.isnan().any() else "inf"
                what = f"{name} ({type(module).__name__}) returns {number}"
                self._stop(what, _rows(tensor, len(self._scene.history)))

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        if loss.isfinite().all():
            return
        terms = pl_module.losses(self._scene, pl_module(self._scene))  # type: ignore[operator]
        guilty = [name for name, (_, value) in terms.items() if not value.isfinite().all()]
        self._stop(f"the loss is {loss.item()}" + (f", by its term {' and '.join(guilty)}" if guilty else ""))

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        parameters = {name: each for name, each in pl_module.named_parameters() if each.grad is not None}
        guilty = [name for name, each in parameters.items() if not each.grad.isfinite().all()]  # type: ignore[union-attr]
        if guilty:
            more = f" and of {len(guilty) - 1} more parameters" if guilty[1:] else ""
            self._stop(f"the gradient of {guilty[-1]}{more} is not finite{self._operation(pl_module)}")

    def _operation(self, forecaster: LightningModule) -> str:
        """The operation whose derivative is the first that is nan, found by repeating the step in anomaly mode."""
        try:
            with torch.autograd.set_detect_anomaly(True), warnings.catch_warnings(record=True) as noted:
                warnings.simplefilter("always")
                terms = forecaster.losses(self._scene, forecaster(self._scene))  # type: ignore[operator]
                torch.stack([weight * value for weight, value in terms.values()]).sum().backward()
        except RuntimeError as error:
            # PyTorch warns with the traceback of the forward call; its last line is the operation.
            places = [line.strip() for each in noted for line in str(each.message).splitlines() if "File " in line]
            return f": {str(error).splitlines()[0].rstrip('.')}" + (f" ({places[-1]})" if places else "")
        return ""

    def _stop(self, what: str, rows: list[int] | None = None) -> None:
        assert self._scene is not None
        ids = torch.arange(len(self._scene.history)) if self._scene.id is None else self._scene.id
        chosen = [int(ids[row]) for row in (range(len(ids)) if rows is None else rows)]
        shown = ", ".join(map(str, chosen[:MOST_SCENES])) + (", ..." if chosen[MOST_SCENES:] else "")
        raise ConfigError(
            f"step {self._step}: {what}; scenes of the training split: {shown}; "
            "look at these scenes, or try a smaller optimizer.lr, or optimizer.clip=1"
        )


def _tensors(value: Any) -> Iterator[Tensor]:
    """All tensors in a module's output: nested mappings, sequences and data classes."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for entry in value.values():
            yield from _tensors(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _tensors(entry)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _tensors(getattr(value, field.name))


def _rows(tensor: Tensor, scenes: int) -> list[int] | None:
    """Indices of scenes in which a tensor is not finite; None if its first dimension does not enumerate scenes."""
    if tensor.dim() == 0 or len(tensor) % scenes:
        return None
    bad = ~tensor.isfinite().reshape(scenes, -1).all(1)
    return bad.nonzero().flatten().tolist()
