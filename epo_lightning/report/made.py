"""Provenance of every row of a report, for checking and reproducing its numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from epo_lightning.identity import row_identity
from epo_lightning.registry import ConfigError
from epo_lightning.report.records import Records
from epo_lightning.report.rows import Row
from epo_lightning.report.runs import data_name
from epo_lightning.report.tables import Table, distinct
from epo_lightning.report.timings import Timing


@dataclass(frozen=True)
class MadeRun:
    """Provenance of one run as text; empty where its records have no entry.

    Attributes:
        seed, folder, command, commit, data_digest, parameters, steps, seconds, began: of the run.
        versions: versions of the packages used.
    """

    seed: int
    folder: str
    command: str
    commit: str
    data_digest: str
    parameters: str
    steps: str
    seconds: str
    began: str
    versions: str


@dataclass(frozen=True)
class Made:
    """The runs of one row; ``what`` is their data, and the split of the scores."""

    name: str
    what: str
    budget: str
    runs: tuple[MadeRun, ...]

    @property
    def seeds(self) -> str:
        return ", ".join(str(run.seed) for run in self.runs)

    @property
    def parameters(self) -> str:
        return ", ".join(dict.fromkeys(run.parameters or "-" for run in self.runs))

    @property
    def commits(self) -> str:
        return ", ".join(dict.fromkeys(short(run.commit) for run in self.runs))

    @property
    def digests(self) -> str:
        return ", ".join(dict.fromkeys(run.data_digest for run in self.runs))


def how_made(tables: Sequence[Table], timings: Sequence[Timing] = ()) -> list[Made]:
    """Provenance of the rows of all tables, then of runs that were only timed."""
    rows = [_of_row(row) for row in distinct(tables)]
    known = {run.folder for row in rows for run in row.runs}
    return [*rows, *_timed([timing for timing in timings if str(timing.run.path) not in known])]


def _of_row(row: Row) -> Made:
    runs = tuple(
        _run(run.records, run.seed, run.command, run.git_commit, run.data_digest, run.parameters) for run in row.runs
    )
    return Made(row.name, f"{row.runs[0].data}, {row.runs[0].split} split", row.budget, runs)


def _timed(timings: Iterable[Timing]) -> list[Made]:
    found: dict[str, tuple[dict[str, Any], list[MadeRun]]] = {}
    for timing in timings:
        config, record = timing.run.config(), timing.run.record
        digest = str(record.get("data_digest", ""))
        made = _run(
            timing.run,
            int(config.get("seed", 0)),
            str(record.get("command", "")),
            str(record.get("git_commit") or ""),
            digest,
            record.get("parameters"),
        )
        found.setdefault(row_identity(config, digest), (config, []))[1].append(made)
    return [
        Made(
            str(config.get("title", "untitled")),
            f"{data_name(config['data'])}, runtime",
            str((config.get("budget") or {}).get("name", "-")),
            tuple(sorted(runs, key=lambda run: run.seed)),
        )
        for config, runs in found.values()
    ]


def _run(run: Records, seed: int, command: str, commit: str, digest: str, parameters: Any) -> MadeRun:
    try:
        record = run.record
    except ConfigError:  # read once already: it is being replaced
        record = {}
    versions = record.get("versions") or {}
    seconds = record.get("seconds")
    return MadeRun(
        seed=seed,
        folder=str(run.path),
        command=command,
        commit=commit,
        data_digest=digest,
        parameters="" if parameters is None else str(parameters),
        steps=str(record.get("steps", "")),
        seconds=f"{seconds:.0f}" if isinstance(seconds, int | float) else "",
        began=str(record.get("began", "")),
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
    )


def short(commit: str) -> str:
    """Abbreviated hash of a commit; ``+`` means uncommitted changes."""
    if not all(letter in "0123456789abcdef+" for letter in commit):
        return commit
    return commit[:10] + ("+" if commit.endswith("+") else "")
