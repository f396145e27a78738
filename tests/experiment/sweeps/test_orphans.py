"""Worker processes end with the command that started them, at whatever moment it is killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from experiment.sweeps.rpi_sweep import SRC

PROGRAM = """
import multiprocessing, os, signal, time

from epo_lightning.experiment.sweeps.orphans import end_with


def work(driver, late):
    if late:
        os.kill(driver, signal.SIGKILL)
        while os.getppid() == driver:
            time.sleep(0.01)
    end_with(driver)
    if not late:
        os.kill(driver, signal.SIGKILL)
    time.sleep(100)


if __name__ == "__main__":
    multiprocessing.get_context("spawn").Process(target=work, args=(os.getpid(), {late})).start()
    time.sleep(100)
"""


@pytest.mark.parametrize("late", [False, True])
def test_a_worker_ends_with_its_driver_also_if_that_was_killed_before_its_first_job(tmp_path: Path, late: bool) -> None:
    (tmp_path / "driver.py").write_text(PROGRAM.format(late=late))
    environment = {**os.environ, "PYTHONPATH": str(SRC)}
    driver = subprocess.Popen([sys.executable, "driver.py"], cwd=tmp_path, env=environment, stderr=subprocess.PIPE)
    driver.communicate(timeout=60)  # returns when both processes have ended
    assert driver.returncode == -9
