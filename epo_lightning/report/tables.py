"""Evaluated runs -> rows: mean and standard deviation over seeds, the best of each group, the paper's value beside.

A *table* is one data set and one split. A *row* is what a paper's table calls a method: all runs that differ in nothing
but their seed. A *group* is what may be ranked against each other: rows of the same backbone that know equally much
(``goal``).
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from epo_lightning.identity import differences
from epo_lightning.registry import ConfigError
from epo_lightning.report.labels import labels, natural, value_text, varying
from epo_lightning.report.paper import PAPER, is_papers, paper_values
from epo_lightning.report.runs import EvaluatedRun

BACKBONES = tuple(dict.fromkeys(backbone for _, backbone, _ in PAPER))
FORECASTERS = ("marginal", "scene_consistent", "epo")
"""The paper's order of groups, and of rows within a group; what it does not have follows in the order of the runs."""

MISSING = "-"
"""Stands where a row has no such number."""

CONDITIONS = ("data", "trainer", "callbacks")
"""Sections of the configuration that the learned rows of one table share; the others are what a table compares."""


@dataclass(frozen=True)
class Column:
    """One column: which metric it shows and how."""

    metric: str
    label: str

    @property
    def digits(self) -> int:
        """Rates are small: a single overlap in 6000 scenes should be seen."""
        return 4 if "overlap" in self.metric else 3

    @property
    def ranked(self) -> bool:
        """Whether rows compare in it: energies, and what is made of them, are in units of each row's own."""
        return self.metric not in OWN_UNITS

    def text(self, value: float) -> str:
        """A number as tables print it; what has no size of its own has three digits, wherever they are."""
        return significant(value) if self.metric in GAME else number(value, self.digits)

    def long_text(self, value: float) -> str:
        """The same with six digits."""
        return f"{value:.6g}" if self.metric in GAME and not math.isnan(value) else number(value, 6)


OWN_UNITS = ("energy_initial", "energy_solved", "energy_optimum", "gradient_norm", "nash_gap")
GAME = (*OWN_UNITS, "nash_gap_relative")
"""Metrics of the game that a forecaster plays, of which those above have the units of its energy."""


def number(value: float, digits: int) -> str:
    """A number as tables print it; a dash where there is none."""
    return MISSING if math.isnan(value) else f"{value:.{digits}f}"


def significant(value: float) -> str:
    """A number with three digits or more: ``1534``, ``15.3``, ``0.00153``, ``1.5e-05``; a dash where there is none."""
    if math.isnan(value):
        return MISSING
    rounded = float(f"{value:.3g}")
    if rounded and not 1e-3 <= abs(rounded) < 1e5:
        return f"{value:.1e}"
    digits = 2 - math.floor(math.log10(abs(rounded))) if rounded else 0
    return f"{value:.{max(digits, 0)}f}"


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        mean, deviation: over seeds; the sample standard deviation is None for a single seed, and where nothing was
            learned and so nothing can vary.
        rank: 1 for the best of the group, 2 for the second, None for others and where there is nothing to rank.
        paper: the value in the paper.
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
    """All runs of one method.

    Attributes:
        name: its label: the title, with what tells it apart from other rows of that title.
        group: its backbone and goal.
        runs: one per seed, in the order of the seeds.
        cells: by metric.
        settings: by dotted key, those that tell it apart from other rows of the same title; empty for most rows.
    """

    name: str
    group: tuple[str, str]
    runs: tuple[EvaluatedRun, ...]
    cells: Mapping[str, Cell]
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str, str]:
        """Data set, split and identity: equal for the same row in two tables, where its ranks may differ."""
        return self.runs[0].data, self.runs[0].split, self.identity

    @property
    def title(self) -> str:
        """Title shared with rows that differ in settings only."""
        return self.runs[0].name

    @property
    def forecaster(self) -> str:
        return self.runs[0].forecaster

    @property
    def budget(self) -> str:
        """With which its runs were trained; "none" where nothing is."""
        return self.runs[0].budget if self.runs[0].learned else "none"

    @property
    def identity(self) -> str:
        """Identity that its runs share with each other and with no other row."""
        return self.runs[0].row

    @property
    def data_digest(self) -> str:
        """Digest of the data that it was evaluated on."""
        return self.runs[0].data_digest

    @property
    def seeds(self) -> list[int]:
        return sorted(run.seed for run in self.runs)

    @property
    def commits(self) -> list[str]:
        """Commits of the code that made its runs; several if the code changed in between."""
        return sorted({run.git_commit for run in self.runs})

    @property
    def commands(self) -> list[str]:
        """One per run, in the order of the seeds."""
        return [run.command for run in self.runs]


@dataclass(frozen=True)
class Table:
    """Rows and which of their scores to show."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...] = field(repr=False)

    @property
    def data(self) -> str:
        return self.rows[0].runs[0].data

    @property
    def split(self) -> str:
        return self.rows[0].runs[0].split

    @property
    def main(self) -> bool:
        """Whether it is the table of all rows, of which the others show parts."""
        return self.columns == MAIN


MAIN = (
    Column("minADE", "ADE"),
    Column("minFDE", "FDE"),
    Column("minSADE", "SADE"),
    Column("minSFDE", "SFDE"),
    Column("overlap_jfp", "OR (JFP)"),
    Column("overlap_authors", "OR (authors)"),
)

EQUILIBRIUM = (
    Column("energy_initial", "energy, initial"),
    Column("energy_solved", "energy, solved"),
    Column("energy_optimum", "energy, optimum"),
    Column("gradient_norm", "gradient norm"),
    Column("nash_gap", "Nash gap"),
    Column("nash_gap_relative", "Nash gap, relative"),
)

OF_MODES = re.compile(r"minSADE_(\d+)")
"""minSADE among the k most likely joint modes."""


def build_tables(runs: Iterable[EvaluatedRun]) -> list[Table]:
    """For every data set and split: the main table, and of the rows that have them subsets, modes and games.

    The further tables show the subsets apart, the k most likely modes, initial beside solved strategies, and how close to
    an equilibrium of its game a forecast is.

    Raises:
        ConfigError: rows of one table that were not made under the same conditions, or the same run twice.
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
        found = (OF_MODES.fullmatch(metric) for row in rows for metric in row.cells)
        most = max((int(match[1]) for match in found if match), default=0)
        if most > 1:  # of one mode it is the main table's
            modes = tuple(Column(f"minSADE_{k}", f"SADE, k={k}") for k in range(1, most + 1))
            tables += _partly_shown(f"{where}: accuracy of the k most likely modes", modes, rows)
        initial = tuple(
            Column(prefix + metric, f"{stage} {metric.removeprefix('min')}")
            for metric in ("minSADE", "minSFDE")
            for prefix, stage in (("initial/", "initial"), ("", "solved"))
        )
        tables += _shown(f"{where}: initial and solved strategies", initial, rows)
        tables += _partly_shown(f"{where}: equilibrium", EQUILIBRIUM, [row for row in rows if "nash_gap" in row.cells])
    return tables


def distinct(tables: Iterable[Table]) -> list[Row]:
    """The rows of all tables, each once: the tables of one data set and split show the same rows."""
    rows: dict[tuple[str, str, str], Row] = {}
    for row in (row for table in tables for row in table.rows):
        rows.setdefault(row.key, row)
    return list(rows.values())


def trained_rows(tables: Iterable[Table]) -> dict[str, list[Row]]:
    """The rows of all tables by data set; a row that was evaluated on two splits was trained once, and stands there once."""
    found: dict[str, dict[str, Row]] = {}
    for row in distinct(tables):
        found.setdefault(row.runs[0].data, {}).setdefault(row.identity, row)
    return {data: list(rows.values()) for data, rows in found.items()}


def _shown(title: str, columns: tuple[Column, ...], rows: Sequence[Row]) -> list[Table]:
    """The table of those rows that have all of the columns, ranked among themselves, if there are any."""
    having = tuple(row for row in rows if all(column.metric in row.cells for column in columns))
    return [Table(title, columns, _with_ranks(having))] if columns and having else []


def _partly_shown(title: str, columns: Sequence[Column], rows: Sequence[Row]) -> list[Table]:
    """The table of those rows and columns that have a cell, ranked among themselves, if there are any."""
    having = tuple(row for row in rows if any(column.metric in row.cells for column in columns))
    known = tuple(column for column in columns if any(column.metric in row.cells for row in having))
    return [Table(title, known, _with_ranks(having))] if having else []


def build_rows(runs: Sequence[EvaluatedRun]) -> tuple[Row, ...]:
    """Runs of one table -> its rows in the paper's order, with ranks; other rows in the order of the runs.

    Raises:
        ConfigError: as :func:`build_tables`.
    """
    require_comparable(runs)
    rows = plain_rows(runs)
    backbones = list(dict.fromkeys([*BACKBONES, *(row.group[0] for row in rows)]))
    titles = list(dict.fromkeys(row.title for row in rows))

    def order(row: Row) -> tuple[object, ...]:
        """The paper's goal first, baselines without a backbone last; rows of one title by their settings."""
        backbone, goal = row.group
        rank = FORECASTERS.index(row.forecaster) if row.forecaster in FORECASTERS else len(FORECASTERS)
        place = backbones.index(backbone)
        return backbone == "", place, goal != "energy", goal, rank, titles.index(row.title), natural(row.settings)

    return _with_ranks(sorted(rows, key=order))


def plain_rows(runs: Iterable[EvaluatedRun]) -> list[Row]:
    """Runs -> rows with their labels, in the order in which they are met, not compared with each other.

    Raises:
        ConfigError: the same run twice, or runs of one row that lack each other's metrics.
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
    """Backbone and goal; what learns nothing has neither."""
    return (run.backbone, run.goal) if run.learned else ("", "")


def require_comparable(runs: Sequence[EvaluatedRun]) -> None:
    """Refuse runs that no table may compare: other data, budgets, checkpoints, lengths or sizes of training.

    What may differ is what tables compare: backbone, forecaster, dynamics, energy, solver, what is learned through it,
    objective, optimiser, goal and seed. Commits may differ as well, they are shown.

    Raises:
        ConfigError: the message names the rows, and the key and values in which they differ.
    """
    require_same(runs, "data_digest (evaluated on)", lambda run: run.data_digest)
    learned = [run for run in runs if run.learned]
    require_same(learned, "data_digest (trained on)", lambda run: run.trained_digest)
    require_same(learned, "budget", lambda run: run.budget)
    require_same(learned, "checkpoint", lambda run: run.checkpoint)
    found = {key for run in learned for key, _, _ in differences(learned[0].config, run.config)}
    for key in sorted(key for key in found if key.split(".")[0] in CONDITIONS):
        require_same(learned, key, lambda run, key=key: value_text(_setting(run.config, key)))  # type: ignore[misc]


def _setting(config: Mapping[str, Any], key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def require_same(runs: Iterable[EvaluatedRun], what: str, value: Callable[[EvaluatedRun], str]) -> None:
    """Refuse a table that would compare what cannot be compared.

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
        raise ConfigError(
            f"rows of one table differ in {what} ({found}): report on a folder whose runs share it, "
            f"or run the missing ones; such runs are {paths}"
        )


def _row(runs: Sequence[EvaluatedRun]) -> Row:
    """Mean and deviation of every score of the runs of a row."""
    first, by_seed = runs[0], dict[int, EvaluatedRun]()
    for run in runs:
        twin = by_seed.setdefault(run.seed, run)
        if twin is not run:
            raise ConfigError(
                f"row {run.name!r} has seed {run.seed} twice, {twin.path} and {run.path} are the same run: "
                "move one of them away"
            )
        for metric in ({*first.metrics} ^ {*run.metrics}) - {*GAME}:  # an objective need not have a relative gap
            one, other = (first, run) if metric in first.metrics else (run, first)
            raise ConfigError(
                f"row {run.name!r}: {one.path} was scored by {metric} and {other.path} was not: "
                f"epo evaluate run={other.path} split={run.split} scores it again"
            )
    steps = _setting(first.config, "solver.steps") if first.forecaster == "epo" else None
    known = (first.data, first.backbone, first.forecaster, first.goal, first.experiment, first.split, steps)
    paper = paper_values(*known) if is_papers(first.forecaster, first.config) else {}
    cells = {}
    for metric in dict.fromkeys(metric for run in runs for metric in run.metrics):
        values = [run.metrics.get(metric, math.nan) for run in runs]
        constant = not first.learned and len({*values}) == 1
        sampled = len(values) > 1 and all(map(math.isfinite, values)) and not constant
        deviation = statistics.stdev(values) if sampled else None
        cells[metric] = Cell(statistics.fmean(values), deviation, None, paper.get(metric), len(values))
    return Row(first.name, group_of(first), tuple(runs), cells)


def _with_ranks(rows: Sequence[Row]) -> tuple[Row, ...]:
    return tuple(_ranked(row, [other for other in rows if other.group == row.group]) for row in rows)


def _ranked(row: Row, group: Sequence[Row]) -> Row:
    """Mark the best and the second best; what prints the same ranks the same, and a row alone is not ranked."""
    cells = {}
    for metric, cell in row.cells.items():
        column = Column(metric, "")
        means = [other.cells[metric].mean for other in group if metric in other.cells]
        places = sorted({float(column.text(mean)) for mean in means if math.isfinite(mean)})
        own = float(column.text(cell.mean)) if math.isfinite(cell.mean) else math.nan
        rank = places.index(own) + 1 if column.ranked and len(means) > 1 and own in places else None
        cells[metric] = replace(cell, rank=rank if rank in (1, 2) else None)
    return replace(row, cells=cells)
