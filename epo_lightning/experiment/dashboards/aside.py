"""Separation of a training from its dashboards, so that a dashboard can neither stop nor delay the training.

Each dashboard has a thread that takes rows from a queue; the training only puts rows into the queue. If the thread raises an
exception, the queue becomes too long, or the thread does not finish at the end of the run, the dashboard is switched off for
this run, with one warning.
"""

from __future__ import annotations

import math
import queue
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from lightning.pytorch.loggers import Logger

from epo_lightning.experiment.dashboards.base import Dashboard, Ending, Row
from epo_lightning.masking import mask
from epo_lightning.registry import kind_and_message

BEHIND = 20_000
"""Largest number of rows in a dashboard's queue: less than a hundred megabytes."""


class Aside(Logger):
    """Lightning logger for a dashboard. It never raises an exception, and waits for the dashboard only at the end of a run.

    Args:
        dashboard: the dashboard that gets the rows.
        patience: seconds to wait for the dashboard at the end of the run.
        past: rows that were logged before this process began.
    """

    def __init__(self, dashboard: Dashboard, patience: float = 10.0, past: Sequence[Row] = ()) -> None:
        super().__init__()
        self.dashboard, self.patience = dashboard, patience
        self.off: str | None = None
        self._past = past
        self._queue: queue.Queue[Row | Ending] = queue.Queue(BEHIND)
        # A daemon thread, because a dashboard that never answers must not keep the process alive.
        self._thread = threading.Thread(target=self._work, name=dashboard.label, daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        return self.dashboard.label

    @property
    def version(self) -> str:
        return self.dashboard.facts.id

    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """The dashboard has the whole configuration already."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        self._put((step or 0, dict(metrics)))

    def close(self, ending: Ending) -> None:
        """Send the end of the run to the dashboard; waits at most ``patience`` seconds."""
        self._put(ending)
        self._thread.join(0.0 if self.off else self.patience)
        if self._thread.is_alive():
            self._switch_off(f"it did not answer for {self.patience:g} s")

    def _put(self, item: Row | Ending) -> None:
        if self.off:
            return
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self._switch_off(f"it is {BEHIND} rows behind")

    def _work(self) -> None:
        try:
            self.dashboard.open()
            self.dashboard.log(self._past)
            while not self.off:
                rows, ending = self._waiting()
                self.dashboard.log(rows)
                if ending:
                    self.dashboard.close(ending)
                    return
        except BaseException as error:  # no error of a dashboard may reach the training, not even SystemExit
            self._switch_off(mask(kind_and_message(error))[:300])

    def _waiting(self) -> tuple[list[Row], Ending | None]:
        """The next rows in the queue: the first one and those that arrive soon after it; and the ending, if it is there."""
        rows: list[Row] = []
        until = math.inf
        while True:
            try:
                left = until - time.monotonic()
                item = self._queue.get(timeout=None if left == math.inf else max(left, 0.0))
            except queue.Empty:
                return rows, None
            if isinstance(item, Ending):
                return rows, item
            rows.append(item)
            until = min(until, time.monotonic() + self.dashboard.every)

    def _switch_off(self, why: str) -> None:
        if self.off:
            return
        self.off = why
        folder = self.dashboard.facts.folder
        print(
            f"{self.dashboard.label}: switched off for this run ({why}). The run continues, and its complete log is in "
            f"{folder / 'logs' / 'metrics.csv'}. When the dashboard works again, `epo evaluate run={folder}` sends it",
            file=sys.stderr,
            flush=True,
        )
