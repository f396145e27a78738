"""Workers whose sweep has died: they finish the run at hand, and end."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

_busy = threading.Lock()


@contextmanager
def working_for(driver: int) -> Iterator[None]:
    """Around a run of a sweep: if this process is a child of the ``driver``, it does not outlive it by more than this run.

    Pools of processes (joblib's) otherwise wait for more work for ever, and hold the terminal. Jobs of a cluster are
    nobody's children and go on.
    """
    if os.getppid() == driver:
        _watch(driver)
    with _busy:
        yield


@cache
def _watch(driver: int) -> None:
    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(1.0)
        with _busy:
            os._exit(1)

    threading.Thread(target=watch, name="orphan", daemon=True).start()
