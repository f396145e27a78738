"""Choice of a GPU for a run where several runs share a machine: the first one that has a place left.

Runs of a parallel sweep, and runs from several terminals, know nothing of each other; files that are locked for as long as
their process lives tell them which places are taken.
"""

from __future__ import annotations

import getpass
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

from epo_lightning.experiment.config.settings import TrainerSettings


@contextmanager
def placed(settings: TrainerSettings) -> Iterator[int | list[int]]:
    """Hold a place on a GPU if the run wants just one, and wait until there is one.

    Yields:
        the argument ``devices`` of Lightning's trainer: the GPU with the place, or a number of devices.
    """
    if settings.accelerator == "cpu" or settings.devices > 1 or not torch.cuda.is_available():
        yield settings.devices
        return
    count = torch.cuda.device_count()
    # By their own names: two jobs of a cluster may both see their GPU as number 0.
    names = [str(torch.cuda.get_device_properties(number).uuid) for number in range(count)]
    with place(names, settings.share) as number:
        yield [number]


@contextmanager
def place(names: Sequence[str], share: int, folder: Path | None = None) -> Iterator[int]:
    """Hold one of ``share`` places on one of the GPUs; an empty GPU comes before one with company.

    Args:
        names: of the GPUs.
        share: how many runs a GPU takes at once.
        folder: of the lock files; one of this user in the system's folder of temporary files by default.

    Yields:
        the position in ``names`` of the GPU.
    """
    from filelock import FileLock, Timeout

    folder = folder or Path(tempfile.gettempdir()) / f"epo-gpus-{getpass.getuser()}"
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
