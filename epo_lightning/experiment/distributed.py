"""Training on several devices of one machine, one process per device, with the numbers of a single process.

The leader, rank 0, is the process that was asked to train: a command line, a job of a sweep or a worker of a launcher. It
starts the followers, and sends them the configuration through a shared TCP store, so they need neither Hydra nor the
leader's command line. Followers only compute: the leader alone writes the run folder, its lock, the logs and the terminal.
Followers end when the leader ends or dies, and the leader fails when a follower fails. Afterwards the leader's process is
as before: no environment variable, port or process group remains for the next job.

If Slurm has started one task per device, these tasks are the processes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import IO, Any

import torch
import torch.distributed as dist
from lightning.fabric.plugins import ClusterEnvironment
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.strategies.launchers.launcher import _Launcher
from lightning.pytorch.utilities.exceptions import SIGTERMException

from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder

HOST = "127.0.0.1"
PATIENCE = 600.0
"""Longest wait for the other processes to connect to the store [s]."""
GRACE = 10.0
"""Longest wait for followers to exit by themselves, or for the failure of a follower to become visible [s]."""


@dataclass(frozen=True)
class Place:
    """Rank of this process among a run's processes.

    Attributes:
        rank: rank of this process; 0 is the leader.
        world: number of processes.
        port: port of the store; 0 if the leader starts the other processes itself and can choose any free port.
    """

    rank: int = 0
    world: int = 1
    port: int = 0

    @property
    def leads(self) -> bool:
        return self.rank == 0


def here(devices: int) -> Place:
    """The place of this process in a run on ``devices`` devices: its Slurm rank if Slurm started a task per device, else 0.

    Raises:
        ConfigError: Slurm has started another number of tasks, or tasks on several nodes.
    """
    tasks = int(os.environ.get("SLURM_STEP_NUM_TASKS", "1"))
    if devices == 1 or tasks == 1:
        return Place(world=devices)
    if tasks != devices or os.environ.get("SLURM_STEP_NUM_NODES", "1") != "1":
        raise ConfigError(
            f"trainer.devices is {devices}, but Slurm has started {tasks} tasks on "
            f"{os.environ.get('SLURM_STEP_NUM_NODES', '1')} nodes: ask for one node, with one task or one for each device"
        )
    return Place(int(os.environ["SLURM_PROCID"]), devices, 15000 + int(os.environ.get("SLURM_JOB_ID", "0")) % 10000)


def strategy(devices: int, run: RunFolder, config: Mapping[str, Any], last: Path | None) -> DDP | None:
    """Lightning strategy of the leader for training on ``devices`` devices; None for one device.

    Args:
        config: the resolved configuration, from which followers build the same forecaster and data.
        last: checkpoint from which the run continues; None for a new run.
    """
    if devices == 1:
        return None
    task = {"run": str(run.path.resolve()), "config": dict(config), "last": str(last.resolve()) if last else None}
    return DDP(here(devices), task=json.dumps(task))


class DDP(DDPStrategy):
    """Lightning's DDP for processes that connect through their own TCP store.

    Args:
        place: rank of this process.
        store: the leader's store, for a follower; None for the leader, which opens it.
        task: run folder, configuration and checkpoint as JSON, which the leader sends to the followers.
    """

    def __init__(self, place: Place, store: dist.TCPStore | None = None, task: str = "") -> None:
        super().__init__(cluster_environment=_Machine(place))
        self.place = place
        self.processes = _Processes(place, store, task)

    def _configure_launcher(self) -> None:
        self._launcher = self.processes

    def setup_distributed(self) -> None:
        """Join the process group. Unlike Lightning's own method, this changes neither random state nor environment."""
        self.set_world_ranks()
        self._process_group_backend = self._get_process_group_backend()
        on_gpu = self.root_device.type != "cpu"
        dist.init_process_group(
            self._process_group_backend,
            store=self.processes.meet(),
            rank=self.place.rank,
            world_size=self.place.world,
            timeout=self._timeout,
            device_id=self.root_device if on_gpu else None,
        )


class _Machine(ClusterEnvironment):
    """Cluster environment with the ranks of a place; environment variables are not read."""

    def __init__(self, place: Place) -> None:
        super().__init__()
        self._place = place

    creates_processes_externally = True
    main_address = HOST

    @property
    def main_port(self) -> int:
        return self._place.port

    @staticmethod
    def detect() -> bool:
        return False

    def world_size(self) -> int:
        return self._place.world

    def set_world_size(self, size: int) -> None:
        pass

    def global_rank(self) -> int:
        return self._place.rank

    def set_global_rank(self, rank: int) -> None:
        pass

    def local_rank(self) -> int:
        return self._place.rank

    def node_rank(self) -> int:
        return 0


class _Processes(_Launcher):
    """Launcher that starts the followers before a training, and ends them after it."""

    is_interactive_compatible = True

    def __init__(self, place: Place, store: dist.TCPStore | None, task: str) -> None:
        self._place, self._store, self._task = place, store, task
        self._followers: list[tuple[subprocess.Popen[bytes], IO[bytes]]] = []
        self._over = threading.Event()
        self._watcher: threading.Thread | None = None

    def launch(self, function: Callable[..., Any], *args: Any, trainer: Any = None, **kwargs: Any) -> Any:
        """Result of ``function``, called while the followers run.

        Raises:
            ChildProcessError: a follower has failed.
        """
        try:
            if self._place.leads:
                self._start()
            result = function(*args, **kwargs)
            self._wait()
            return result
        except (RuntimeError, ValueError) as error:  # raised by torch when other processes stop answering
            self._wait(patience=1.0)
            raise (self._failure() or error) from error
        finally:
            self._end()

    def kill(self, signum: Any) -> None:
        """Raise at once on SIGTERM: Lightning's handler would broadcast during another collective call and hang."""
        raise SIGTERMException(128 + int(signum))

    def meet(self) -> dist.TCPStore:
        """The store, once all processes have connected to it.

        Raises:
            ChildProcessError: a process failed.
            RuntimeError: a process did not connect in time.
        """
        assert self._store is not None
        self._store.set(f"here/{self._place.rank}", "")
        ranks = [f"here/{rank}" for rank in range(self._place.world)]
        deadline = time.monotonic() + PATIENCE
        while not self._store.check(ranks):
            if failure := self._failure():
                raise failure
            if time.monotonic() > deadline:
                raise RuntimeError(
                    f"not all {self._place.world} processes of the run connected within {PATIENCE:.0f} s"
                )
            time.sleep(0.02)
        return self._store

    def _start(self) -> None:
        """Open the store, and start the followers unless Slurm did."""
        # The port is bound before followers learn its number, so two runs never choose the same port.
        self._store = dist.TCPStore(
            HOST, self._place.port, is_master=True, wait_for_workers=False, timeout=timedelta(seconds=PATIENCE)
        )
        self._store.set("task", self._task)
        if self._place.port:
            return
        for rank in range(1, self._place.world):
            errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
            words = [str(rank), str(self._place.world), str(self._store.port)]
            process = subprocess.Popen(
                [sys.executable, "-m", "epo_lightning.experiment.follower", *words],
                # Lightning and W&B log only where LOCAL_RANK is 0. PYTHONPATH: followers import the same modules.
                env={**os.environ, "LOCAL_RANK": str(rank), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.PIPE,  # closed when this process dies; the follower then ends
                stdout=subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,  # Ctrl-C reaches the leader only
            )
            self._followers.append((process, errors))
        self._watcher = threading.Thread(target=self._watch, args=(self._over,), daemon=True, name="epo-followers")
        self._watcher.start()

    def _watch(self, over: threading.Event) -> None:
        """Abort NCCL when a follower has failed: unlike gloo, it does not notice the death of a process."""
        while not over.wait(1.0):
            if self._failure() and dist.is_initialized() and dist.get_backend() == "nccl":
                torch.distributed.distributed_c10d._get_default_group().abort()
                return

    def _failure(self) -> ChildProcessError | None:
        """Error with exit status and last line of the first follower that failed; None if none has.

        It is an OSError, so that the command ends with one line: the leader's traceback says nothing about the follower.
        """
        for rank, (process, errors) in enumerate(self._followers, 1):
            code = process.poll()
            if code:
                errors.seek(0)
                said = errors.read().decode(errors="replace").strip()
                how = f"was killed by signal {-code}" if code < 0 else f"ended with exit status {code}"
                reason = f": {said.splitlines()[-1]}" if said else ""
                return ChildProcessError(f"process {rank} of the run's {self._place.world} {how}{reason}")
        return None

    def _wait(self, patience: float = GRACE) -> None:
        """Wait until all followers have ended, one has failed, or ``patience`` seconds have passed."""
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline and not self._failure():
            if all(process.poll() is not None for process, _ in self._followers):
                break
            time.sleep(0.02)

    def _end(self) -> None:
        """End followers, process group and store, so that the process is as before."""
        self._over.set()
        if self._watcher is not None:  # it reads the followers' files
            self._watcher.join()
        for process, errors in self._followers:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
            errors.close()
        self._followers = []
        if dist.is_initialized():
            dist.destroy_process_group()
        self._store = None
