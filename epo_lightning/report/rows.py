"""Rows of the tables: mean and standard deviation over seeds of the runs of one method, with the paper's value.

A *row* contains all runs that differ only in their seed: what the paper's tables call a method.
"""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from epo_lightning.identity import differences
from epo_lightning.registry import ConfigError
from epo_lightning.report.columns import GAME, TRUE, is_own
from epo_lightning.report.labels import labels, value_text, varying, word
from epo_lightning.report.paper import interacts, is_papers, paper_values
from epo_lightning.report.runs import EvaluatedRun

CONDITIONS = ("data", "trainer", "callbacks")
"""Sections of the configuration that must be equal for the learned rows of a table; the others are compared by it."""
BATCH = "data.batch_size"
"""The only setting of these sections in which rows may differ: it belongs to the optimisation, and changes no data."""

SIDES = ("executed/missed", "alternative/missed")
"""Scores of RPI: shares of the scenes in which no mode is near the future on one side."""
MANY_MISSED = 0.2
"""Share above which a row has a note."""


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        mean, deviation: mean and sample standard deviation over seeds; the deviation is None for a single seed, and for
            methods that learn nothing and give equal scores.
        rank: 1 for the best of the group, 2 for the second, else None.
        paper: the value in the paper, None if it has none.
        n: number of seeds.
    """

    mean: float
    deviation: float | None
    rank: int | None = None
    paper: float | None = None
    n: int = 1

    @property
    def difference(self) -> float | None:
        """Ours minus the paper's."""
        return None if self.paper is None else self.mean - self.paper


@dataclass(frozen=True)
class Row:
    """One row of a table: all runs of one method.

    Attributes:
        name: label of the row: its title, with the settings that distinguish it from other rows of the same title.
        group: backbone and goal; rows are ranked within a group.
        runs: one per seed, in the order of the seeds.
        cells: cells by metric.
        settings: settings by dotted key that distinguish it from other rows of the same title; empty for most rows.
    """

    name: str
    group: tuple[str, str]
    runs: tuple[EvaluatedRun, ...]
    cells: Mapping[str, Cell]
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str, str]:
        """Data set, split and identity: equal for the same row in several tables, in which its ranks may differ."""
        return self.runs[0].data, self.runs[0].split, self.identity

    @property
    def title(self) -> str:
        """Title, which rows that differ only in settings share."""
        return self.runs[0].name

    @property
    def forecaster(self) -> str:
        return self.runs[0].forecaster

    @property
    def budget(self) -> str:
        """Budget of the training; "none" if the method learns nothing."""
        return self.runs[0].budget if self.runs[0].learned else "none"

    @property
    def identity(self) -> str:
        """Identity of the row: equal for all its runs, and different from that of every other row."""
        return self.runs[0].row

    @property
    def data_digest(self) -> str:
        """Digest of the data on which its runs were evaluated."""
        return self.runs[0].data_digest

    @property
    def seeds(self) -> list[int]:
        return sorted(run.seed for run in self.runs)

    @property
    def commits(self) -> list[str]:
        """Commits of the code of its runs; several if the code changed between runs."""
        return sorted({run.git_commit for run in self.runs})

    @property
    def missing(self) -> list[int]:
        """Seeds of the runs of RPI whose modes are trained by the closest one, and miss one of the sides in many scenes."""
        config = self.runs[0].config
        if (config.get("forecaster") or {}).get("one_game") or not interacts(config):
            return []  # equilibria of one game, or agents that do not react: nothing is taught to single modes
        return [
            run.seed
            for run in self.runs
            if run.parameters != 0 and any(run.metrics.get(name, 0.0) > MANY_MISSED for name in SIDES)
        ]

    @property
    def commands(self) -> list[str]:
        """Commands of its runs, in the order of the seeds."""
        return [run.command for run in self.runs]


def cell_of(values: Sequence[float], learned: bool, paper: float | None = None) -> Cell:
    """Mean and deviation of the scores of seeds; no deviation for equal scores of a method that learns nothing."""
    sampled = len(values) > 1 and all(map(math.isfinite, values)) and (learned or len({*values}) > 1)
    return Cell(statistics.fmean(values), statistics.stdev(values) if sampled else None, None, paper, len(values))


def plain_rows(runs: Iterable[EvaluatedRun]) -> list[Row]:
    """Rows with labels, without ranks, in the order of the runs; they need not be comparable.

    Raises:
        ConfigError: the same run twice, or runs of one row with different metrics.
    """
    members: dict[str, list[EvaluatedRun]] = {}
    for run in runs:
        members.setdefault(run.row, []).append(run)
    rows = [_row(sorted(same, key=lambda run: run.seed)) for same in members.values()]
    titles: dict[str, list[Row]] = {}
    for row in rows:
        titles.setdefault(row.title, []).append(row)
    named: dict[str, Row] = {}
    for title, same in titles.items():
        config = same[0].runs[0].config
        settings = varying([row.runs[0].config for row in same])
        names = labels(title, settings, config, [row.identity for row in same])
        for row, name, own in zip(same, names, settings, strict=True):
            named[row.identity] = replace(row, name=name, settings=own)
    return [named[row.identity] for row in rows]


def group_of(run: EvaluatedRun) -> tuple[str, str]:
    """Backbone and goal of a run; empty for methods that learn nothing."""
    return (run.backbone, run.goal) if run.learned else ("", "")


def require_comparable(runs: Sequence[EvaluatedRun]) -> None:
    """Check that one table may compare the runs: equal data, budget, checkpoint and conditions of training.

    Backbone, forecaster, dynamics, energy, solver, backward, objective, optimizer, batch size, goal and seed may differ:
    these are what tables compare. Commits may differ too, and are shown.

    Raises:
        ConfigError: the message names the rows, and the key and values in which they differ.
    """
    require_same(runs, "data_digest (evaluated on)", lambda run: run.data_digest)
    learned = [run for run in runs if run.learned]
    require_same(learned, "data_digest (trained on)", lambda run: run.trained_digest)
    require_same(learned, "budget", lambda run: run.budget)
    require_same(learned, "checkpoint", lambda run: run.checkpoint)
    for key in unequal_conditions([run.config for run in learned]):
        require_same(learned, key, lambda run, key=key: value_text(setting(run.config, key)))  # type: ignore[misc]


def unequal_conditions(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Dotted keys of :data:`CONDITIONS`, without :data:`BATCH`, in which resolved configurations differ, in order."""
    found = {key for config in configs for key, _, _ in differences(configs[0], config)}
    return sorted(key for key in found if key.split(".")[0] in CONDITIONS and key != BATCH)


def setting(config: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key of a configuration; None where there is none."""
    value: Any = config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def require_same(runs: Iterable[EvaluatedRun], what: str, value: Callable[[EvaluatedRun], str]) -> None:
    """Check that ``value`` is equal for all runs.

    Raises:
        ConfigError: the runs differ; the message names their rows and values.
    """
    having: dict[str, list[EvaluatedRun]] = {}
    for run in runs:
        having.setdefault(value(run), []).append(run)
    if len(having) > 1:
        rows = {entry: ", ".join(dict.fromkeys(run.name for run in same)) for entry, same in sorted(having.items())}
        found = "; ".join(f"{entry}: {names}" for entry, names in rows.items())
        paths = ", ".join(str(same[0].path) for _, same in sorted(having.items()))
        apart = " or ".join(f"`epo report {word('runs', folder)}`" for folder in _folders_apart([*having.values()]))
        raise ConfigError(
            f"rows of one table differ in {what} ({found}): report on a folder whose runs share it"
            + (f", {apart}," if apart else ",")
            + f" or run the missing ones; such runs are {paths}"
        )


def _may_be_missing(metric: str) -> bool:
    """Whether a scored run may lack the metric: users' own, and comparisons of weights that are the same in all scenes."""
    return is_own(metric) or metric.startswith(TRUE)


def _folders_apart(groups: Sequence[Sequence[EvaluatedRun]]) -> list[str]:
    """For each group of runs the folder that holds all of them; without those that hold a run of another group as well."""
    paths = [[run.path for run in group] for group in groups]
    if len({path.is_absolute() for group in paths for path in group}) > 1:  # they have no folder in common
        return []
    folders = [os.path.commonpath(group) for group in paths]
    return [
        folder
        for folder, group in zip(folders, paths, strict=True)
        if not any(path.is_relative_to(folder) for other in paths if other is not group for path in other)
    ]


def _row(runs: Sequence[EvaluatedRun]) -> Row:
    """A row of runs that differ in their seed, with mean and deviation of every score."""
    first, by_seed = runs[0], dict[int, EvaluatedRun]()
    for run in runs:
        twin = by_seed.setdefault(run.seed, run)
        if twin is not run:
            raise ConfigError(
                f"row {run.name!r} has seed {run.seed} twice, {twin.path} and {run.path} are the same run: "
                "move one of them away"
            )
        # Metrics of the game may be missing in some runs as well.
        for metric in sorted(
            name for name in {*first.metrics} ^ {*run.metrics} if name not in GAME and not _may_be_missing(name)
        ):
            one, other = (first, run) if metric in first.metrics else (run, first)
            raise ConfigError(
                f"row {run.name!r}: {one.path} was scored by {metric} and {other.path} was not: "
                f"epo evaluate run={other.path} split={run.split} scores it again"
            )
    steps = setting(first.config, "solver.steps") if first.forecaster == "epo" else None
    known = (first.data, first.backbone, first.forecaster, first.goal, first.experiment, first.split, steps)
    in_paper = is_papers(first.forecaster, first.config) and (first.forecaster != "epo" or interacts(first.config))
    paper = paper_values(*known) if in_paper else {}
    cells = {}
    for metric in dict.fromkeys(metric for run in runs for metric in run.metrics):
        scored = [run for run in runs if metric in run.metrics] if _may_be_missing(metric) else runs
        values = [run.metrics.get(metric, math.nan) for run in scored]
        cells[metric] = cell_of(values, first.learned, paper.get(metric))
    return Row(first.name, group_of(first), tuple(runs), cells)
