"""End of worker processes when the process of their sweep ends; their runs continue at the next start of the sweep."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from functools import cache


@cache
def end_with(driver: int) -> None:
    """End this process when the process ``driver`` ends, or has ended already, if that process started it.

    Otherwise the worker processes of joblib would continue, wait for further work and keep the terminal occupied. Jobs of a
    cluster have another parent and continue.
    """

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(0.5)
        os._exit(1)

    parent = multiprocessing.parent_process()  # also if it has ended, unlike os.getppid
    if parent is not None and parent.pid == driver:
        threading.Thread(target=watch, name="orphan", daemon=True).start()
