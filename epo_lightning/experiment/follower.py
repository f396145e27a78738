"""Followers of a training on several devices: processes that train the run of the leader process (:mod:`.distributed`)."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from datetime import timedelta
from pathlib import Path

import torch.distributed as dist
from lightning.pytorch import seed_everything
from lightning.pytorch.callbacks import Checkpoint, EarlyStopping

from epo_lightning.experiment import assembly, callbacks
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.distributed import DDP, GRACE, HOST, PATIENCE, Place, here
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import read


def trained_as_follower(devices: int, run: RunFolder) -> bool:
    """Train as a follower if Slurm started this process as a follower; returns whether this is the case.

    Raises:
        ConfigError: see :func:`here` and :func:`follow`.
    """
    place = here(devices)
    if not place.leads:
        follow(place, run)
    return not place.leads


def follow(place: Place, run: RunFolder | None = None) -> None:
    """Train the leader's run together with it. The leader sends the configuration.

    Args:
        place: rank of this process, number of processes, and port of the leader.
        run: the run's folder, if known: if the run is finished already, there is no leader to wait for.

    Raises:
        ConfigError: no leader answers.
    """
    store = _find(place, run)
    if store is None:
        return
    task = json.loads(store.get("task"))
    settings, run = read(Settings, task["config"]), RunFolder(Path(task["run"]))
    assembly.quiet()
    seed_everything(settings.seed, workers=True, verbose=False)
    data, model = assembly.build(settings)
    watchers = callbacks.run_callbacks(settings.callbacks, run, settings.title)
    # Those that decide when to stop, move the loop, or have a state in the checkpoint. Only the leader writes and prints.
    kinds = Checkpoint | EarlyStopping | callbacks.NextEpoch | callbacks.RandomStates
    deciding = [watcher for watcher in watchers if isinstance(watcher, kinds)]
    trainer = assembly.build_trainer(
        settings.trainer, run, deciding, devices=settings.trainer.devices, strategy=DDP(place, store)
    )
    trainer.fit(model, data, ckpt_path=task["last"], weights_only=True)


def _find(place: Place, run: RunFolder | None) -> dist.TCPStore | None:
    """The leader's key-value store; None if the run is finished, so that there is no leader.

    Raises:
        ConfigError: no leader answers in time.
    """
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return dist.TCPStore(HOST, place.port, is_master=False, timeout=timedelta(seconds=GRACE))
        except (dist.DistNetworkError, dist.DistStoreError) as error:
            if run is not None and run.finished:
                return None
            if run is not None and run.locked:  # the leader waits as well, until another job has trained the run
                deadline = time.monotonic() + PATIENCE
            elif time.monotonic() > deadline:
                raise ConfigError(f"process {place.rank} of {place.world} finds no leader: {error}") from error


def _end_with(leader: int) -> None:
    """End this process when the other end of the pipe ``leader`` is closed."""

    def wait() -> None:
        while os.read(leader, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True, name="epo-leader").start()


if __name__ == "__main__":
    _end_with(sys.stdin.fileno())
    follow(Place(*map(int, sys.argv[1:])))
