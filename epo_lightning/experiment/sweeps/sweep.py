"""A sweep: many runs that one command starts. Each run is trained only once, even if the command is given again.

::

    <runs>/sweeps/<label>/
        sweep.json       the command, and every run: its overrides, its folder (relative to <runs>) and its identity;
                         with choices=<file>, the contents of that file; folders of runs that are no longer part of it
        found/           the same for runs that a searching sweeper (Optuna) has chosen, one file each
        failures/        tracebacks of runs that failed in the last attempt, one file each
        .lock            locked as long as the sweep runs
        report/          written by ``epo report <name>``

The label is the sweep's name, followed by a hash of the overrides that change results, if there are any. The runs have the
same folders as without a sweep, so that a run that belongs to two sweeps is trained once.
"""

from __future__ import annotations

import hashlib
import os
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from epo_lightning.experiment.config.settings import Measured, measures
from epo_lightning.files import read_json, write_file, write_json
from epo_lightning.masking import mask
from epo_lightning.registry import ConfigError
from epo_lightning.report.entries import OBJECT, OBJECTS, TEXT, TEXTS, WHOLE, Check, check_entries, check_known
from epo_lightning.report.labels import word as override
from epo_lightning.run_folder import LOCK, RunFolder

State = Literal["done", "running", "interrupted", "trained, not scored", "failed", "waiting"]
BESIDE = (
    *("logger", "existing", "runs", "sweep", "sweeps"),
    *("hydra/launcher", "hydra.launcher", "hydra/hydra_logging", "hydra.sweep", "hydra.job", "hydra.verbose"),
    *("hydra.sweeper.n_trials", "hydra.sweeper.n_jobs"),
    *("callbacks.progress", "callbacks.refresh"),
    *("trainer.accelerator", "trainer.devices", "trainer.share", "trainer.threads"),
)
"""Overrides that do not change a sweep's label: they only say where it runs and what is logged or shown."""
AGAIN = "delete the file and give the command of the sweep again, which trains no finished run again"
_RECORD = {
    **dict.fromkeys(("name", "began", "command", "host"), TEXT),
    "process": WHOLE,
    "jobs": OBJECTS,
    "choices": OBJECT,
    "former": TEXTS,
}
_JOB = {"overrides": TEXTS, "folder": TEXT, "identity": TEXT, "title": TEXT, "seed": WHOLE}
_SCORE: Check = ("a list of texts", lambda value: value is None or TEXT[1](value) or TEXTS[1](value))


@dataclass(frozen=True)
class Job:
    """One run of a sweep.

    Attributes:
        overrides: Hydra overrides of the run.
        run: the run folder.
        identity: identity of the run (:mod:`epo_lightning.identity`).
        title, seed: title of its row, and its seed.
        measures: measurements to be made after the training.
        data: name of its data set; empty in records of older versions.
    """

    overrides: tuple[str, ...]
    run: RunFolder
    identity: str
    title: str
    seed: int
    measures: tuple[Measured, ...]
    data: str = ""

    @property
    def lacking(self) -> tuple[Measured, ...]:
        """The measurements whose files do not exist in the run folder."""
        return tuple(which for which in self.measures if not self.run.metrics_file(which).is_file())


@dataclass(frozen=True)
class Sweep:
    """The record of a sweep, read from its folder."""

    folder: Path

    @classmethod
    def of(cls, name: str, overrides: Sequence[str], runs: str | Path) -> Sweep:
        """The sweep of a name and overrides; it may not have begun yet."""
        return cls(Path(runs).expanduser().absolute() / "sweeps" / label(name, overrides))

    @classmethod
    def find(cls, name: str, overrides: Sequence[str], runs: str | Path) -> Sweep:
        """A sweep that has begun: the one with these overrides; without any, the latest of that name or label.

        Raises:
            ConfigError: no such sweep has begun; the message names the sweeps that have.
        """
        home = Path(runs).expanduser().absolute() / "sweeps"
        known = {sweep.label: sweep for sweep in cls.begun(runs)}
        exact = label(name, overrides)
        if exact in known and (exact != name or not any(found.startswith(f"{name}-") for found in known)):
            return known[exact]
        alike = [sweep for sweep in known.values() if sweep.record.get("name") == name or sweep.folder.name == name]
        if not alike or exact != name:
            what = f"{name} with these overrides" if exact != name else name
            begun = "; ".join(f"{key} ({sweep.record.get('command')})" for key, sweep in known.items())
            of_runs = (
                f"; `epo report {override('runs', name)}` reports on runs in a folder" if Path(name).is_dir() else ""
            )
            raise ConfigError(
                f"no sweep {what} has begun below {home}: "
                + (f"known: {begun}" if begun else "none has, `epo sweep` lists those that can be begun")
                + of_runs
            )
        return alike[0]

    @classmethod
    def begun(cls, runs: str | Path) -> list[Sweep]:
        """All sweeps that have begun, the latest first."""
        home = Path(runs).expanduser().absolute() / "sweeps"
        found = [cls(path.parent) for path in home.glob("*/sweep.json")]
        return sorted(found, key=lambda sweep: sweep.record.get("began", ""), reverse=True)

    @property
    def label(self) -> str:
        return self.folder.name

    @property
    def root(self) -> Path:
        """The folder that all runs lie below."""
        return self.folder.parents[1]

    @property
    def record(self) -> dict[str, Any]:
        """The contents of sweep.json.

        Raises:
            ConfigError: it is damaged; the message names the entry, and says what to do.
        """
        return _content(self.folder / "sweep.json")

    @property
    def jobs(self) -> list[Job]:
        """All runs of the sweep; for a searching sweep, the runs that it has chosen so far."""
        file = self.folder / "sweep.json"
        found = [(path, _content(path)) for path in sorted((self.folder / "found").glob("*.json"))]
        return [self._job(where, entry) for where, entry in [*((file, e) for e in self.record.get("jobs", [])), *found]]

    @property
    def former(self) -> list[RunFolder]:
        """Runs of earlier starts that are no longer part of the sweep, because files that it reads have changed since."""
        return [RunFolder(path) for name in self.record.get("former", ()) if (path := self.root / name).exists()]

    def _job(self, file: Path, entry: Mapping[str, Any]) -> Job:
        where = f"{file}, a run of the sweep,"
        check_entries(entry, _JOB, where, AGAIN)
        check_known(entry, {"score": _SCORE, "data": TEXT}, where, AGAIN)
        run = RunFolder(Path(os.path.relpath(self.root / entry["folder"])))
        measured = measures(entry.get("score"))  # null or a word in records of older versions
        return Job(
            tuple(entry["overrides"]),
            run,
            entry["identity"],
            entry["title"],
            entry["seed"],
            measured,
            entry.get("data", ""),
        )

    def _entry(self, job: Job) -> dict[str, Any]:
        return {
            "overrides": mask(list(job.overrides)),
            "folder": self._place(job.run),
            "identity": job.identity,
            "title": job.title,
            "seed": job.seed,
            "data": job.data,
            "score": list(job.measures),
        }

    def state(self, job: Job) -> State:
        """State of a run: ``done`` if it is trained and measured, ``failed`` also if its folder is damaged."""
        state: State | Literal["finished"]
        try:
            state = job.run.state
        except ConfigError:
            return "failed"
        if state == "finished":
            if not job.lacking:
                return "done"
            state = "running" if job.run.locked else "trained, not scored"
        return "failed" if state not in ("running", "failed") and self.has_traceback(job) else state

    def has_traceback(self, job: Job) -> bool:
        """Whether the run has failed since the last start of the sweep."""
        return self._failure(job.run).is_file()

    def error(self, job: Job) -> str:
        """Error message of a failed run in one line; empty if it has not failed."""
        try:
            if self.has_traceback(job):
                return self._failure(job.run).read_text(encoding="utf-8").partition("\n")[0]
            return str(job.run.record.get("error") or "") if job.run.record_file.is_file() else ""
        except ConfigError as error:
            return str(error)

    @property
    def has_failures(self) -> bool:
        """Whether a run has failed since the last start of the sweep."""
        return any((self.folder / "failures").glob("*.txt"))

    def _failure(self, run: RunFolder) -> Path:
        return self.folder / "failures" / f"{self._place(run).replace(os.sep, '__')}.txt"

    def _place(self, run: RunFolder) -> str:
        """A run's folder, relative to the folder of all runs, which may be moved."""
        return os.path.relpath(run.path.absolute(), self.root)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Context with the lock of the sweep, which prevents a second start of the same sweep.

        Raises:
            ConfigError: the sweep is running already.
        """
        from filelock import FileLock, Timeout

        self.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.folder / LOCK)
        try:
            lock.acquire(timeout=0.5, poll_interval=0.1)
        except Timeout:
            record = self.record if (self.folder / "sweep.json").is_file() else {}
            who = f" (process {record['process']} on {record['host']})" if "process" in record else ""
            raise ConfigError(
                f"the sweep {self.label} runs already{who}: see `epo sweep status {self.label}`, or give this one "
                "another place with runs=<folder>"
            ) from None
        try:
            yield
        finally:
            lock.release()

    def begin(
        self,
        name: str,
        command: str,
        overrides: Sequence[str],
        jobs: Sequence[Job],
        stop_on_failure: bool,
        choices: Mapping[str, Any] | None = None,
    ) -> None:
        """Write sweep.json with all runs, and delete the tracebacks of earlier attempts."""
        before = self.record if (self.folder / "sweep.json").is_file() else {}
        for entry in before.get("jobs", ()):
            check_entries(entry, _JOB, f"{self.folder / 'sweep.json'}, a run of the sweep,", AGAIN)
        earlier = {*before.get("former", ()), *(entry["folder"] for entry in before.get("jobs", ()))}
        for failure in (self.folder / "failures").glob("*.txt"):
            failure.unlink()
        content = {
            "name": name,
            "label": self.label,
            "command": command,
            "overrides": mask(list(overrides)),
            "directory": str(Path.cwd()),
            "cache": os.environ.get("EPO_CACHE"),
            "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "process": os.getpid(),
            "host": socket.gethostname(),
            "stop_on_failure": stop_on_failure,
            "jobs": [self._entry(job) for job in jobs],
            "former": sorted(earlier - {self._place(job.run) for job in jobs}),
            **({"choices": mask(dict(choices))} if choices else {}),
        }
        write_json(self.folder / "sweep.json", content)

    def add(self, job: Job) -> None:
        """Record a run that a searching sweep has chosen."""
        write_json(self.folder / "found" / self._failure(job.run).with_suffix(".json").name, self._entry(job))

    def fail(self, run: RunFolder, message: str, trace: str = "") -> None:
        """Record that a run has failed: its error in one line, and the traceback."""
        write_file(self._failure(run), f"{message}\n" + (f"\n{trace}" if trace else ""))


def _content(file: Path) -> dict[str, Any]:
    """The contents of a file of a sweep's folder.

    Raises:
        ConfigError: the file is damaged.
    """
    try:
        content = read_json(file)
    except ConfigError as error:
        raise ConfigError(f"{error}; {AGAIN}") from error
    check_known(content, _RECORD, str(file), AGAIN)
    return content


def label(name: str, overrides: Sequence[str]) -> str:
    """``name``, and six digits of a hash of the overrides that decide on results, where there are any."""
    keys = {word: word.lstrip("+~").split("=")[0].split("@")[0] for word in overrides}
    special = sorted(
        word
        for word, key in keys.items()
        if not any(key == beside or key.startswith((f"{beside}.", f"{beside}/")) for beside in BESIDE)
    )
    return name + ("-" + hashlib.sha256("\n".join(special).encode()).hexdigest()[:6] if special else "")
