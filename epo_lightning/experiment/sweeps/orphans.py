"""End of worker processes when the process of their sweep ends; their runs continue at the next start of the sweep."""

from __future__ import annotations

import os
import threading
import time
from functools import cache


@cache
def end_with(driver: int) -> None:
    """End this process when the process ``driver`` ends, if it is a child of the driver.

    Otherwise the worker processes of joblib would continue, wait for further work and keep the terminal occupied. Jobs of a
    cluster are not children of the driver and continue.
    """

    def watch() -> None:
        while os.getppid() == driver:
            time.sleep(0.5)
        os._exit(1)

    if os.getppid() == driver:
        threading.Thread(target=watch, name="orphan", daemon=True).start()
