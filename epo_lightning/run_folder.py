"""The folder that a run leaves behind, and how to find it again.

::

    <run folder>/
        config.yaml            the resolved configuration: all that is needed to continue or evaluate the run
        run.json               record: title, experiment, budget, seed, data digest, versions, parameters, status;
                               `identity`, a hash of everything that decides on the result; `row`, the same without seed
        checkpoints/best.ckpt  the epoch with the smallest `callbacks.monitor` (validation minSADE)
        checkpoints/last.ckpt  the last finished epoch, with everything that continuing needs
        logs/                  metrics.csv: what was logged while training; TensorBoard's and W&B's files lie beside it
        metrics.json           scores on the test split, written by ``evaluate``: "split", "data_digest", "checkpoint",
                               "metrics", and on RPI "truth", the errors of inferred costs, where the run infers costs
        metrics-val.json       scores on the validation split, where `score` or `epo evaluate` asks for them
        runtime.json           time of one joint forecast, where `score` asks for it
        scores-<split>-<checkpoint>-<digest>.json
                               scores of another checkpoint than ``best``, or scores that differ from those in
                               ``metrics.json`` or ``metrics-val.json``
        scores-on-<data>-<split>-<digest>-<digest>.json
                               scores on other data; the digests are those of the test and of the checkpoint
        runtime-<device>-<threads>.json
                               an earlier ``runtime.json``, set aside by a sweep: ``cpu`` or ``gpu``, and number of threads
        progress.json          step and machine of the training; exists only while it runs
        .scores.lock           locked while a process writes scores
        .lock                  locked as long as a process works on the run; the system releases it when the process dies

Files are replaced as a whole, so a reader never sees an incomplete one, even if the writing process is killed.
Names of the forms ``scores-..`` and ``runtime-..`` that are taken get a number, as in ``runtime-cpu-1-2.json``.
``metrics.json`` holds no time, path or version, so that two equal runs give the same bytes.
"""

from __future__ import annotations

import csv
import difflib
import io
import itertools
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from epo_lightning import pretrained
from epo_lightning.files import read_json, write_file, write_json
from epo_lightning.masking import mask
from epo_lightning.registry import ConfigError, nearest, one_line

TRAINING, FINISHED, FAILED = "training", "finished", "failed"
State = Literal["waiting", "running", "interrupted", "failed", "finished"]
"""State of a run. Waiting: it has not begun. Interrupted: it has begun, no process works on it, and no error is recorded."""
SILENCE = 600.0
"""Seconds without new progress after which a run on another machine, whose lock may be invisible here, is interrupted."""
OTHER = "scores-on-"
"""Beginning of the names of files with scores on data on which a run was not trained."""
LOCK = ".lock"
HEADER = "# The resolved configuration of this run.\n"


def numbered(path: Path) -> Iterator[Path]:
    """``scores.json``, ``scores-2.json``, ``scores-3.json``, ...: names for files that may not replace each other."""
    yield path
    for number in itertools.count(2):
        yield path.with_stem(f"{path.stem}-{number}")


def neighbour(folder: Path) -> Path | None:
    """The folder beside a missing one whose name is most like it; None where there is none."""
    try:
        beside = [entry.name for entry in folder.parent.iterdir() if entry.is_dir()]
    except OSError:  # no such folder, or one that may not be listed
        return None
    close = difflib.get_close_matches(folder.name, beside, n=1)
    return folder.parent / close[0] if close else None


def read_log(path: Path) -> list[dict[str, str]]:
    """The rows of a ``metrics.csv`` as text without empty entries, each with a whole number ``step``.

    A missing file has no rows. A last line without its line break is left out: it was cut off by a kill or a full disk.
    """
    try:
        text = path.read_bytes().decode("utf-8", errors="replace")
    except FileNotFoundError:
        return []
    lines = io.StringIO(text[: text.rfind("\n") + 1], newline="")
    rows = [{key: value for key, value in row.items() if key and value} for row in csv.DictReader(lines)]
    return [row for row in rows if row.get("step", "").isdecimal()]


@dataclass(frozen=True)
class RunFolder:
    """Paths and records of one run."""

    path: Path

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """The run in the folder ``path``. If there is no such folder, ``path`` may be the name of a run in the package.

        Raises:
            ConfigError: there is no run; the message names the runs below ``path``.
        """
        run = cls(pretrained.folder_of(path) or Path(path).expanduser())
        if run.path.is_file():
            raise ConfigError(
                f"{run.path} is a file, and not a run folder: name the folder with config.yaml and run.json"
            )
        if not run.path.is_dir():
            beside = neighbour(run.path)
            raise ConfigError(
                f"no run folder {run.path}: "
                + (f"did you mean {beside}? " if beside else "")
                + "The folder does not exist, and no run of that name ships with the package "
                f"({nearest(str(path), pretrained.names())})"
            )
        if not run.config_file.is_file() or not run.record_file.is_file():
            below = [str(found.path) for found in discover(run.path)]
            hint = (
                f"; runs below it: {', '.join(below[:8])} (epo evaluate and epo report take all of them by runs={run.path})"
                if below
                else ""
            )
            if cls(run.path.parent).config_file.is_file():
                hint = f"; its run is {run.path.parent}"
            raise ConfigError(f"{run.path} is not a run folder: it has no config.yaml and run.json{hint}")
        return run

    @property
    def config_file(self) -> Path:
        return self.path / "config.yaml"

    @property
    def record_file(self) -> Path:
        return self.path / "run.json"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def logs(self) -> Path:
        return self.path / "logs"

    def checkpoint(self, which: str = "best") -> Path:
        """Path of a checkpoint: ``which`` is best, last, the name of a run in the package (its best), or the path itself."""
        if which in ("best", "last"):
            return self.checkpoints / f"{which}.ckpt"
        return pretrained.checkpoint_of(which) or Path(which).expanduser()

    @property
    def progress_file(self) -> Path:
        return self.path / "progress.json"

    def metrics_file(self, split: str = "test") -> Path:
        """File of the scores on the split ``test`` or ``val``; for ``time``, the file of the time of a forecast."""
        names = {"test": "metrics.json", "time": "runtime.json"}
        return self.path / names.get(split, f"metrics-{split}.json")

    @property
    def exists(self) -> bool:
        """Whether anything was written here; a config.yaml alone does not count: a run that was killed at once leaves it."""
        if not self.path.is_dir():
            return self.path.exists()
        entries = {entry.name for entry in self.path.iterdir() if not entry.name.startswith(".")}
        if entries == {self.config_file.name}:
            return not self.config_file.read_text(encoding="utf-8", errors="replace").startswith(HEADER)
        return bool(entries)

    @property
    def record(self) -> dict[str, Any]:
        """The contents of run.json."""
        return read_json(self.record_file)

    def names(self) -> list[str]:
        """Names of the files in the folder, sorted; none if there is no folder."""
        return sorted(entry.name for entry in self.path.iterdir() if entry.is_file()) if self.path.is_dir() else []

    def content(self, name: str) -> dict[str, Any]:
        """The contents of a JSON file in the folder, as :func:`read_json`."""
        return read_json(self.path / name)

    def log(self) -> list[dict[str, str]]:
        """The rows of logs/metrics.csv, as :func:`read_log`."""
        return read_log(self.logs / "metrics.csv")

    @property
    def finished(self) -> bool:
        return self.record_file.is_file() and self.record.get("status") == FINISHED

    @property
    def state(self) -> State:
        """State of the run."""
        if not self.record_file.is_file():
            return "running" if self.path.is_dir() and self.locked else "waiting"
        status = self.record.get("status")
        if status == FINISHED:
            return "finished"
        if self.locked:
            return "running"
        return "failed" if status == FAILED else "interrupted"

    @property
    def progress(self) -> dict[str, Any]:
        """Progress as last written by the process that trains the run; empty where there is none."""
        try:
            return read_json(self.progress_file)
        except ConfigError:
            return {}

    @property
    def locked(self) -> bool:
        """Whether a process works on the run."""
        if not (self.path / LOCK).exists():
            return False
        try:
            with self.lock(wait=0.0):
                pass
        except (ConfigError, OSError):  # another process holds the lock, or the file belongs to another user
            return True
        progress = self.progress
        elsewhere = progress.get("host", socket.gethostname()) != socket.gethostname()
        return elsewhere and time.time() - float(progress.get("time", 0.0)) < SILENCE

    @contextmanager
    def lock(self, wait: float | None = 2.0) -> Iterator[None]:
        """Keep every other process away from the run; the lock of a process that dies is released.

        Args:
            wait: seconds to wait for a process that holds the lock; None waits without a limit.

        Raises:
            ConfigError: another process still works on it.
        """
        from filelock import FileLock, Timeout

        self.path.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.path / LOCK)
        try:
            lock.acquire(timeout=-1 if wait is None else wait, poll_interval=0.2)
        except Timeout:
            progress = self.progress
            who = f" (process {progress['process']} on {progress['host']})" if "process" in progress else ""
            raise ConfigError(f"another process{who} works on {self.path}: wait for it, or stop it") from None
        try:
            yield
        finally:
            lock.release()

    def config(self) -> dict[str, Any]:
        """The resolved configuration as plain Python values.

        Raises:
            ConfigError: config.yaml is missing or damaged.
        """
        import yaml

        try:
            content = yaml.safe_load(self.config_file.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"cannot read {self.config_file}: {error.strerror}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"{self.config_file} is not YAML ({one_line(error)}); was it edited, or copied incompletely?"
            ) from error
        if not isinstance(content, dict):
            raise ConfigError(f"{self.config_file} holds no configuration")
        if isinstance(trainer := content.get("trainer"), dict):
            trainer.pop("log_every", None)  # in runs of older versions, where it had no effect
        return content

    def begin(self, config: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Write the configuration, then the record, both without secrets: a folder with both is a run."""
        import yaml

        text = yaml.safe_dump(mask(dict(config)), sort_keys=False, default_flow_style=None, width=120)
        write_file(self.config_file, HEADER + text)
        write_json(self.record_file, mask({**record, "status": TRAINING}))

    def update(self, **changes: Any) -> None:
        """Change entries of run.json."""
        write_json(self.record_file, mask({**self.record, **changes}))


def discover(root: str | Path) -> Iterator[RunFolder]:
    """All runs in or below ``root``, in the order of their paths."""
    root = Path(root).expanduser()
    for record in sorted(root.rglob("run.json")):
        run = RunFolder(record.parent)
        if run.config_file.is_file():
            yield run
