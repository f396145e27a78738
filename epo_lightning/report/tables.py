"""Evaluated runs -> rows: mean and standard deviation over seeds, the best of each group, the paper's value beside.

A *table* is one data set and one split. A *row* is what a paper's table calls a method: all runs that differ in nothing
but their seed. A *group* is what may be ranked against each other: rows of the same backbone that know equally much
(``goal``).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from epo_lightning.registry import ConfigError
from epo_lightning.report.paper import paper_values
from epo_lightning.report.runs import EvaluatedRun

FORECASTERS = ("marginal", "scene_consistent", "epo")
"""The order of rows within a group."""


@dataclass(frozen=True)
class Column:
    """One column: which metric it shows and how."""

    metric: str
    label: str

    @property
    def digits(self) -> int:
        """Rates are small: a single overlap in 6000 scenes should be seen."""
        return 4 if "overlap" in self.metric else 3


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        mean, deviation: over seeds; the sample standard deviation is None for a single seed.
        rank: 1 for the best of the group, 2 for the second, None for others and where there is nothing to rank.
        paper: the value in the paper.
    """

    mean: float
    deviation: float | None
    rank: int | None = None
    paper: float | None = None


@dataclass(frozen=True)
class Row:
    """All runs of one method."""

    name: str
    group: tuple[str, str]
    runs: tuple[EvaluatedRun, ...]
    cells: Mapping[str, Cell]

    @property
    def seeds(self) -> list[int]:
        return sorted(run.seed for run in self.runs)


@dataclass(frozen=True)
class Table:
    """Rows and which of their scores to show."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...] = field(repr=False)


MAIN = (
    Column("minADE", "ADE"),
    Column("minFDE", "FDE"),
    Column("minSADE", "SADE"),
    Column("minSFDE", "SFDE"),
    Column("overlap_jfp", "OR (JFP)"),
    Column("overlap_authors", "OR (authors)"),
)


def build_tables(runs: Iterable[EvaluatedRun]) -> list[Table]:
    """For every data set and split: the main table, the subsets apart, and initial beside solved strategies.

    Raises:
        ConfigError: rows of one table that were not made under the same conditions, or a row with the same seed twice.
    """
    parts: dict[tuple[str, str], list[EvaluatedRun]] = {}
    for run in runs:
        parts.setdefault((run.data, run.split), []).append(run)
    tables = []
    for (data, split), members in sorted(parts.items()):
        rows = build_rows(members)
        where = f"{data}, {split} split"
        tables.append(Table(where, MAIN, rows))
        names = dict.fromkeys(metric.split("/")[0] for row in rows for metric in row.cells if "/" in metric)
        # What happened comes before what could have happened as well; files sort their keys the other way.
        subsets = sorted(names.keys() - {"initial"}, key=lambda name: (name != "executed", name))
        short = (Column("minSADE", "SADE"), Column("minSFDE", "SFDE"))
        columns = tuple(Column(f"{name}/{c.metric}", f"{name} {c.label}") for name in subsets for c in short)
        tables += _shown(f"{where}: {' and '.join(subsets)} apart", columns, rows)
        initial = tuple(
            Column(prefix + metric, f"{stage} {metric.removeprefix('min')}")
            for metric in ("minSADE", "minSFDE")
            for prefix, stage in (("initial/", "initial"), ("", "solved"))
        )
        tables += _shown(f"{where}: initial and solved strategies", initial, rows)
    return tables


def _shown(title: str, columns: tuple[Column, ...], rows: Sequence[Row]) -> list[Table]:
    """The table of those rows that have all of the columns, if there are any."""
    having = tuple(row for row in rows if all(column.metric in row.cells for column in columns))
    return [Table(title, columns, having)] if columns and having else []


def build_rows(runs: Sequence[EvaluatedRun]) -> tuple[Row, ...]:
    """Runs of one table -> its rows in the paper's order, with ranks.

    Raises:
        ConfigError: as :func:`build_tables`.
    """
    require_same(runs, "data_digest (evaluated on)", lambda run: run.data_digest)
    learned = [run for run in runs if run.learned]
    require_same(learned, "data_digest (trained on)", lambda run: run.trained_digest)
    require_same(learned, "budget", lambda run: run.budget)
    members: dict[tuple[tuple[str, str], str, str], list[EvaluatedRun]] = {}
    for run in runs:
        members.setdefault((group_of(run), run.forecaster, run.name), []).append(run)
    rows = [
        _row(group, tuple(same)) for (group, _, _), same in sorted(members.items(), key=lambda item: _order(item[0]))
    ]
    return tuple(_ranked(row, [other for other in rows if other.group == row.group]) for row in rows)


def group_of(run: EvaluatedRun) -> tuple[str, str]:
    """Backbone and goal; what learns nothing has neither."""
    return (run.backbone, run.goal) if run.learned else ("", "")


def _order(key: tuple[tuple[str, str], str, str]) -> tuple[object, ...]:
    """Groups by backbone, the paper's goal first, baselines without a backbone last; in a group as the paper does."""
    (backbone, goal), forecaster, name = key
    rank = FORECASTERS.index(forecaster) if forecaster in FORECASTERS else len(FORECASTERS)
    return backbone == "", backbone, goal != "energy", goal, rank, name


def require_same(runs: Iterable[EvaluatedRun], what: str, value: Callable[[EvaluatedRun], str]) -> None:
    """Refuse a table that would compare what cannot be compared.

    Raises:
        ConfigError: the runs differ; the message names their rows and values.
    """
    rows: dict[str, list[str]] = {}
    for run in runs:
        names = rows.setdefault(value(run), [])
        if run.name not in names:
            names.append(run.name)
    if len(rows) > 1:
        found = "; ".join(f"{entry}: {', '.join(names)}" for entry, names in sorted(rows.items()))
        raise ConfigError(
            f"rows of one table differ in {what} ({found}): report on a folder whose runs share it, "
            "or run the missing ones"
        )


def _row(group: tuple[str, str], runs: tuple[EvaluatedRun, ...]) -> Row:
    """Mean and deviation of every score that all runs of the row have."""
    first, by_seed = runs[0], dict[int, EvaluatedRun]()
    for run in runs:
        twin = by_seed.setdefault(run.seed, run)
        if twin is not run:
            raise ConfigError(
                f"row {run.name!r} has seed {run.seed} twice, {twin.path} and {run.path}: move one of them away, "
                "or give it a title of its own"
            )
    paper = paper_values(first.data, first.backbone, first.forecaster, first.goal, first.experiment)
    cells = {}
    for metric in first.metrics:
        values = [run.metrics[metric] for run in runs if metric in run.metrics]
        if len(values) == len(runs):
            deviation = statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else None
            cells[metric] = Cell(statistics.fmean(values), deviation, None, paper.get(metric))
    return Row(first.name, group, runs, cells)


def _ranked(row: Row, group: Sequence[Row]) -> Row:
    """Mark the best and the second best; what prints the same ranks the same, and a row alone is not ranked."""
    cells = {}
    for metric, cell in row.cells.items():
        digits = Column(metric, "").digits
        others = {round(other.cells[metric].mean, digits) for other in group if metric in other.cells}
        places = sorted(value for value in others if math.isfinite(value))
        own = round(cell.mean, digits) if math.isfinite(cell.mean) else math.nan
        rank = places.index(own) + 1 if len(group) > 1 and own in places else None
        cells[metric] = Cell(cell.mean, cell.deviation, rank if rank in (1, 2) else None, cell.paper)
    return Row(row.name, row.group, row.runs, cells)
