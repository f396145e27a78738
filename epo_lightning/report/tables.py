"""Tables of a report: which rows and columns they show, in which order, and the best values of each group.

A *table* shows one data set and one split. A *group* contains the rows that are ranked against each other: those with the
same backbone and the same knowledge of goals (``goal``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from epo_lightning.report.columns import (
    ALTERNATIVES,
    EQUILIBRIUM,
    INTERACTIVE,
    MAIN,
    OF_ALTERNATIVES,
    OF_MODES,
    OWN,
    PAIR_EFFECT,
    PROBABILITIES,
    STOPPED,
    TRUTH,
    Column,
)
from epo_lightning.report.folds import joined, named_by_fold, whole_data
from epo_lightning.report.labels import natural
from epo_lightning.report.paper import PAPER
from epo_lightning.report.rows import Row, plain_rows, require_comparable
from epo_lightning.report.runs import EvaluatedRun

BACKBONES = tuple(dict.fromkeys(backbone for _, backbone, _ in PAPER))
FORECASTERS = ("marginal", "scene_consistent", "epo")
"""The paper's order of groups, and of rows within a group; others follow in the order of the runs."""


@dataclass(frozen=True)
class Table:
    """Rows, and the columns that show their scores."""

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
        """Whether it is the main table, which has all rows; the other tables show parts of it."""
        return self.columns == MAIN


def build_tables(runs: Iterable[EvaluatedRun]) -> list[Table]:
    """Tables of every data set and split: the main table, and tables of subsets, modes and games.

    The further tables show scores by subset, of the k most likely modes, of probabilities and missed alternatives, of
    initial beside solved strategies, the effect of pair terms, the distance of forecasts from an equilibrium of their
    game, of inferred costs from the true ones, and registered metrics. They contain the rows that have such scores. Runs
    on one data set that were tested on different groups of recordings are in different tables.

    Raises:
        ConfigError: rows of one table that were trained under different conditions, or the same run twice.
    """
    parts: dict[tuple[str, str], list[EvaluatedRun]] = {}
    for run in named_by_fold(runs):
        parts.setdefault((run.data, run.split), []).append(run)
    tables = []
    for (data, split), members in sorted(parts.items()):
        rows = build_rows(members)
        where = f"{data}, {split} split"
        tables.append(Table(where, MAIN, rows))
        columns = subset_columns(rows, (Column("minSADE", "SADE"), Column("minSFDE", "SFDE")))
        subsets = dict.fromkeys(column.metric.split("/")[0] for column in columns)
        tables += _shown(f"{where}: {' and '.join(subsets)} apart", columns, rows)
        if INTERACTIVE in subsets:
            columns = tuple(Column(f"{INTERACTIVE}/{column.metric}", column.label) for column in MAIN)
            tables += _shown(f"{where}: {INTERACTIVE} scenes", columns, rows)
        found = (OF_MODES.fullmatch(metric) for row in rows for metric in row.cells)
        most = max((int(match[1]) for match in found if match), default=0)
        if most > 1:  # k = 1 alone would repeat the main table
            modes = tuple(Column(f"minSADE_{k}", f"SADE, k={k}") for k in range(1, most + 1))
            tables += _partly_shown(f"{where}: accuracy of the k most likely modes", modes, rows)
        scored = [row for row in rows if "brier_minSADE" in row.cells]
        apart = (c for c in subset_columns(scored, OF_ALTERNATIVES) if c.metric.split("/")[0] in ALTERNATIVES)
        tables += _partly_shown(f"{where}: probabilities of the modes", (*PROBABILITIES, *apart), scored)
        initial = tuple(
            Column(prefix + metric, f"{stage} {metric.removeprefix('min')}")
            for metric in ("minSADE", "minSFDE")
            for prefix, stage in (("initial/", "initial"), ("", "solved"))
        )
        tables += _shown(f"{where}: initial and solved strategies", initial, rows)
        effect = (Column(PAIR_EFFECT, "all scenes"), *subset_columns(rows, (Column(PAIR_EFFECT, ""),)))
        tables += _partly_shown(f"{where}: effect of the other agents", effect, rows)
        tables += _partly_shown(f"{where}: equilibrium", EQUILIBRIUM, [row for row in rows if "nash_gap" in row.cells])
        lost = (Column(STOPPED, "all scenes"), *subset_columns(rows, (Column(STOPPED, ""),)))
        tables += _partly_shown(f"{where}: share of modes that violate hard constraints", lost, rows)
        tables += _partly_shown(f"{where}: inferred against true costs", TRUTH, rows)
        own = sorted({metric for row in rows for metric in row.cells if metric.startswith(OWN)})
        measured = tuple(Column(metric, metric.removeprefix(OWN)) for metric in own)
        tables += _partly_shown(f"{where}: further metrics", (*measured, *subset_columns(rows, measured)), rows)
    return tables


def over_folds(tables: Iterable[Table]) -> list[Table]:
    """The main tables of the test splits of a cross-validation as one, whose rows have a score per fold instead of per seed.

    There is one table for every data set with several test splits that have no group in common.
    """
    members: dict[str, list[EvaluatedRun]] = {}
    for table in tables:
        if table.main and table.split == "test":
            for run in (run for row in table.rows for run in row.runs):
                members.setdefault(whole_data(run), []).append(run)
    members.pop("", None)  # the runs that are no folds
    found = []
    for data, runs in members.items():
        if units := joined(runs):
            number = len({run.seed for run in units})
            found.append(Table(f"{data}, {number} test splits", MAIN, tuple(plain_rows(units))))
    return found


def subset_columns(rows: Iterable[Row], columns: Sequence[Column]) -> tuple[Column, ...]:
    """The columns for every named subset of the data of which a row has scores, subset by subset."""
    names = {metric.split("/")[0] for row in rows for metric in row.cells if "/" in metric}
    # The executed mode comes first, although "alternative" precedes "executed" in the files.
    subsets = sorted(names - {"initial", OWN.removesuffix("/")}, key=lambda name: (name != "executed", name))
    return tuple(Column(f"{name}/{c.metric}", f"{name} {c.label}".strip()) for name in subsets for c in columns)


def distinct(tables: Iterable[Table]) -> list[Row]:
    """The rows of all tables without repetition; the tables of one data set and split share rows."""
    rows: dict[tuple[str, str, str], Row] = {}
    for row in (row for table in tables for row in table.rows):
        rows.setdefault(row.key, row)
    return list(rows.values())


def trained_rows(tables: Iterable[Table]) -> dict[str, list[Row]]:
    """Rows of all tables by data set; a row that was evaluated on two splits appears once, as it was trained once."""
    found: dict[str, dict[str, Row]] = {}
    for row in distinct(tables):
        found.setdefault(row.runs[0].data, {}).setdefault(row.identity, row)
    return {data: list(rows.values()) for data, rows in found.items()}


def _shown(title: str, columns: tuple[Column, ...], rows: Sequence[Row]) -> list[Table]:
    """The table of the rows that have all columns, with their own ranks; empty if there are none."""
    having = tuple(row for row in rows if all(column.metric in row.cells for column in columns))
    return [Table(title, columns, _with_ranks(having))] if columns and having else []


def _partly_shown(title: str, columns: Sequence[Column], rows: Sequence[Row]) -> list[Table]:
    """The table of the rows and columns that have a cell, with their own ranks; empty if there are none."""
    having = tuple(row for row in rows if any(column.metric in row.cells for column in columns))
    known = tuple(column for column in columns if any(column.metric in row.cells for row in having))
    return [Table(title, known, _with_ranks(having))] if having else []


def build_rows(runs: Sequence[EvaluatedRun]) -> tuple[Row, ...]:
    """Rows of a table with ranks, in the paper's order; rows that are not in the paper follow in the order of the runs.

    Raises:
        ConfigError: as :func:`build_tables`.
    """
    require_comparable(runs)
    rows = plain_rows(runs)
    backbones = list(dict.fromkeys([*BACKBONES, *(row.group[0] for row in rows)]))
    titles = list(dict.fromkeys(row.title for row in rows))
    remedies = list(dict.fromkeys(loss_of(row)[1:] for row in rows))

    def order(row: Row) -> tuple[object, ...]:
        """Sort key: the paper's goal first, rows of one loss together, baselines without a backbone last."""
        backbone, goal = row.group
        rank = FORECASTERS.index(row.forecaster) if row.forecaster in FORECASTERS else len(FORECASTERS)
        place = backbones.index(backbone)
        loss = remedies.index(loss_of(row)[1:]), loss_of(row)[0]
        return backbone == "", place, goal != "energy", goal, loss, rank, titles.index(row.title), natural(row.settings)

    return _with_ranks(sorted(rows, key=order))


def loss_of(row: Row) -> tuple[float, float, float]:
    """Power, share of all modes and temperature of the row's imitation loss at the beginning of the training."""
    forecaster, objective = (row.runs[0].config.get(section) or {} for section in ("forecaster", "objective"))
    # The objective belongs to EPO alone; the other forecasters have the same settings of their own.
    section = objective if row.forecaster == "epo" else forecaster
    return float(section.get("power", 1.0)), float(section.get("relaxation", 0.0)), float(section.get("annealing", 0.0))


def _with_ranks(rows: Sequence[Row]) -> tuple[Row, ...]:
    return tuple(_ranked(row, [other for other in rows if other.group == row.group]) for row in rows)


def _ranked(row: Row, group: Sequence[Row]) -> Row:
    """A row with ranks for the best and second best of its group; equal printed values get equal ranks."""
    cells = {}
    for metric, cell in row.cells.items():
        column = Column(metric, "")
        means = [other.cells[metric].mean for other in group if metric in other.cells]
        places = sorted({float(column.text(mean)) for mean in means if math.isfinite(mean)})
        own = float(column.text(cell.mean)) if math.isfinite(cell.mean) else math.nan
        rank = places.index(own) + 1 if column.ranked and len(means) > 1 and own in places else None
        cells[metric] = replace(cell, rank=rank if rank in (1, 2) else None)
    return replace(row, cells=cells)
