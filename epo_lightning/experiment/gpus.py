"""Choice of a GPU for a run where several runs share a machine: the first GPU that has a free place.

Runs of a parallel sweep and runs from several terminals do not communicate. A process therefore locks a file for the place
that it uses; the system releases the lock when the process ends.
"""

from __future__ import annotations

import getpass
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import torch

from epo_lightning.experiment.config.settings import TrainerSettings
from epo_lightning.registry import ConfigError


def accelerator(settings: TrainerSettings) -> Literal["cpu", "cuda"]:
    """Name of the accelerator that Lightning's Trainer gets.

    GPUs are those of CUDA. Apple's, which Lightning would take as well, have no float64, in which scores are summed.

    Raises:
        ConfigError: a GPU or a CUDA graph is wanted, and PyTorch sees no CUDA device.
    """
    if torch.cuda.is_available():
        return "cpu" if settings.accelerator == "cpu" else "cuda"
    if settings.accelerator == "gpu":
        raise ConfigError(
            "trainer.accelerator=gpu needs a CUDA device, and PyTorch sees none here: set trainer.accelerator=cpu, "
            "for a run that has begun in its config.yaml"
        )
    if settings.graph:
        raise ConfigError("trainer.graph=true needs a CUDA device, and PyTorch sees none here: set trainer.graph=false")
    return "cpu"


@contextmanager
def placed(settings: TrainerSettings) -> Iterator[int | list[int]]:
    """Context that holds a place on a GPU for a run on one GPU, after waiting for a free one.

    Yields:
        the argument ``devices`` of Lightning's Trainer: the index of that GPU in a list, or a number of devices for runs on
        a CPU or on several devices.
    """
    if settings.accelerator == "cpu" or settings.devices > 1 or not torch.cuda.is_available():
        yield settings.devices
        return
    count = torch.cuda.device_count()
    # GPUs are identified by UUID: two jobs of a cluster may both see their GPU as number 0.
    names = [str(torch.cuda.get_device_properties(number).uuid) for number in range(count)]
    with place(names, settings.share) as number:
        yield [number]


@contextmanager
def place(names: Sequence[str], share: int, folder: Path | None = None) -> Iterator[int]:
    """Context that holds one of the ``share`` places on one of the GPUs; GPUs with fewer runs are tried first.

    Args:
        names: names of the GPUs.
        share: number of runs that a GPU takes at once.
        folder: folder of the lock files; by default a folder of this user in the system's temporary folder.

    Yields:
        the index of the GPU in ``names``.
    """
    from filelock import FileLock, Timeout

    folder = folder or Path(tempfile.gettempdir()) / f"epo-gpus-{_user()}"
    folder.mkdir(parents=True, exist_ok=True)
    told = False
    while True:
        for seat in range(share):
            for number, name in enumerate(names):
                lock = FileLock(folder / f"{name}-{seat}.lock")
                try:
                    lock.acquire(timeout=0)
                except Timeout:
                    continue
                try:
                    yield number
                finally:
                    lock.release()
                return
        if not told:
            print(
                f"all {share * len(names)} places on {len(names)} GPU(s) are taken: waiting (see trainer.share)",
                flush=True,
            )
            told = True
        time.sleep(0.5)


def _user() -> str:
    """This user's number, which a container may run under without a name; the name where the system has no numbers."""
    return str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
