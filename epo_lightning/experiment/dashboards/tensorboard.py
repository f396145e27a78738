"""TensorBoard dashboard: event files beside ``metrics.csv``, so that TensorBoard shows the run under its folder's name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from epo_lightning.experiment.config.settings import TensorBoardSettings
from epo_lightning.experiment.dashboards.base import Dashboard, Ending, Facts, Row


class TensorBoard(Dashboard):
    """TensorBoard dashboard of a run. A continued run is written again from its rows: no point is missing or repeated."""

    label = "TensorBoard"

    def __init__(self, facts: Facts, settings: TensorBoardSettings) -> None:
        super().__init__(facts)
        self._settings = settings
        self._last = 0

    def open(self) -> None:
        from torch.utils.tensorboard import SummaryWriter

        folder = self.facts.folder / "logs"
        for old in folder.glob("events.out.tfevents.*"):
            old.unlink()
        # With purge_step, a running TensorBoard drops the points that it has read from the old files.
        self._writer: Any = SummaryWriter(folder, flush_secs=10, purge_step=0)

    def log(self, rows: Sequence[Row]) -> None:
        for step, metrics in rows:
            self._last = max(self._last, step)
            for name, value in metrics.items():
                self._writer.add_scalar(name, value, step)

    def close(self, ending: Ending) -> None:
        self.log([(self._last, ending.summary)])
        if self._settings.hyperparameters:
            self._hyperparameters(ending)
        for path in ending.pictures[: self._settings.pictures]:
            self._picture(path.stem, path)
        self._writer.close()

    def _hyperparameters(self, ending: Ending) -> None:
        """Write the run's parameters and summary together, which TensorBoard's HPARAMS tab requires."""
        from torch.utils.tensorboard.summary import hparams

        plain = {
            name: value if isinstance(value, bool | int | float) and not _endless(value) else str(value)
            for name, value in self.facts.parameters().items()
        }
        for record in hparams(plain, dict(ending.summary)):
            self._writer.file_writer.add_summary(record)

    def _picture(self, name: str, path: Any) -> None:
        import numpy
        from PIL import Image

        with Image.open(path) as image:
            self._writer.add_image(name, numpy.asarray(image.convert("RGB")), self._last, dataformats="HWC")


def _endless(value: float) -> bool:
    return isinstance(value, float) and not math.isfinite(value)
