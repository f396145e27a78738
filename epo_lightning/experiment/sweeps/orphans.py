"""Workers end when the process of their sweep has died; their runs continue from the last epoch at the next start."""

from __future__ import annotations

import os
import threading
import time
from functools import cache


@cache
def end_with(driver: int) -> None:
    """If this process is a child of the ``driver``, do not outlive it.

    Pools of processes (joblib's) otherwise work on, wait for more for ever, and hold the terminal. Jobs of a cluster are
    no children of the sweep and go on.
    """

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(0.5)
        os._exit(1)

    if os.getppid() == driver:
        threading.Thread(target=watch, name="orphan", daemon=True).start()
