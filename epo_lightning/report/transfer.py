"""Transfer tables: the scores of runs on data on which they were not trained, by data set of training and of test.

`epo evaluate run=... data=...` writes such scores to files of their own in the run folder. A column of a table is a test: a
data set and a split, read with the same windows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from epo_lightning.report.columns import MISSING, Column
from epo_lightning.report.records import Records
from epo_lightning.report.render import Sheet, csv_text, own_text
from epo_lightning.report.rows import Cell, cell_of, plain_rows
from epo_lightning.report.runs import EvaluatedRun, is_part, read_other, read_run
from epo_lightning.report.tables import FORECASTERS

METRICS = (Column("minSADE", "SADE"), Column("minSFDE", "SFDE"), Column("overlap_jfp", "OR (JFP)"))
"""Scores that are shown; the CSV has all of them."""
HEADER = (
    *(
        "trained_on",
        "method",
        "budget",
        "checkpoint",
        "test_on",
        "split",
        "scenes",
        "metric",
        "mean",
        "std",
        "n",
        "seeds",
    ),
    *("row", "trained_digest", "data_digest"),
)


@dataclass(frozen=True)
class TestSet:
    """A data set and a split on which runs were scored.

    Attributes:
        name, split: of the data set.
        digest: hash of the settings and files of its scenes.
        variant: hash of further settings, where there are several tests of the same scenes; empty otherwise.
        about: contents of a file of scores: numbers of scenes, recordings and agents, and notes.
    """

    name: str
    split: str
    digest: str
    variant: str = ""
    about: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)


@dataclass(frozen=True)
class Line:
    """The scores of one row: by test and metric."""

    trained: str
    method: str
    runs: tuple[EvaluatedRun, ...]
    checkpoint: str
    cells: Mapping[TestSet, Mapping[str, Cell]]


def transfers(runs: Iterable[Records]) -> list[Line]:
    """The scores of all rows with a run that was scored on other data, with those on the test split of their own data.

    Scores on a part of a run's own data are shown where rows that were trained on other data were scored on the same part.

    Raises:
        ConfigError: a damaged file, as :func:`~epo_lightning.report.runs.read_run`; or the same run twice.
    """
    found: list[tuple[TestSet, EvaluatedRun]] = []
    parts: list[tuple[TestSet, EvaluatedRun]] = []
    for run in runs:
        scored = [
            (TestSet(one.data, one.split, one.data_digest, str(about["test"])[:6], about), one)
            for one, about in read_other(run)
        ]
        others = [(test, one) for test, one in scored if not is_part(one, test.about)]
        found += others
        parts += [(test, one) for test, one in scored if is_part(one, test.about)]
        if others:
            own = [one for one in read_run(run) if one.split == "test"]
            found += [(TestSet(one.data, one.split, one.data_digest), one) for one in own]
    elsewhere = {test for test, _ in found}
    found += [(test, one) for test, one in parts if test in elsewhere]
    variants: dict[tuple[str, str, str], set[str]] = {}
    for test, _ in found:
        variants.setdefault((test.name, test.split, test.digest), set()).update({test.variant} - {""})
    members: dict[tuple[str, str], dict[TestSet, dict[int, EvaluatedRun]]] = {}
    for test, one in found:
        if len(variants[test.name, test.split, test.digest]) < 2:
            test = replace(test, variant="")
        checkpoint = one.checkpoint if one.learned else "best"
        # Of the scores that several versions computed, the last ones count; runs are in the order of their files.
        members.setdefault((one.row, checkpoint), {}).setdefault(test, {})[one.seed] = one
    names = _names(one for _, one in found)
    return sorted((_line(checkpoint, scores, names) for (_, checkpoint), scores in members.items()), key=_order)


def _names(runs: Iterable[EvaluatedRun]) -> dict[str, str]:
    """Labels of rows by their identity; only rows that were trained on the same data have to differ."""
    by_data: dict[str, dict[Path, EvaluatedRun]] = {}
    for run in runs:
        by_data.setdefault(run.trained_data, {})[run.path] = run
    return {row.identity: row.name for members in by_data.values() for row in plain_rows(members.values())}


def _line(checkpoint: str, scores: Mapping[TestSet, Mapping[int, EvaluatedRun]], names: Mapping[str, str]) -> Line:
    runs = {seed: run for of_seed in scores.values() for seed, run in of_seed.items()}
    first = next(iter(runs.values()))
    cells = {test: _cells([of_seed[seed] for seed in sorted(of_seed)]) for test, of_seed in scores.items()}
    name = names[first.row] + ("" if checkpoint == "best" else f", checkpoint {checkpoint}")
    return Line(first.trained_data if first.learned else MISSING, name, tuple(runs.values()), checkpoint, cells)


def _cells(runs: Sequence[EvaluatedRun]) -> dict[str, Cell]:
    metrics = dict.fromkeys(metric for run in runs for metric in run.metrics)
    scores = {metric: [run.metrics[metric] for run in runs if metric in run.metrics] for metric in metrics}
    return {metric: cell_of(values, runs[0].learned) for metric, values in scores.items()}


def _order(line: Line) -> tuple[bool, str, str, int, str]:
    run = line.runs[0]
    rank = FORECASTERS.index(run.forecaster) if run.forecaster in FORECASTERS else len(FORECASTERS)
    return run.learned, line.trained, run.backbone, rank, line.method


def labels_of(lines: Iterable[Line]) -> dict[TestSet, str]:
    """All tests with their labels: the data sets of training first, the others by name."""
    found: dict[TestSet, TestSet] = {}
    for test in (test for line in lines for test in line.cells):
        if test not in found or test.about:
            found[test] = test
    own = {line.trained for line in lines}
    tests = sorted(
        found.values(), key=lambda test: (test.name not in own, test.name, test.split, test.digest, test.variant)
    )
    plain = [f"{test.name}, {test.split}" for test in tests]
    return {
        test: name if plain.count(name) == 1 else f"{name} ({(test.digest + test.variant)[-6:]})"
        for test, name in zip(tests, plain, strict=True)
    }


def transfer_sheets(lines: Sequence[Line]) -> list[Sheet]:
    """One table of each score in ``METRICS``, and one of the test sets; none without scores on other data."""
    if not lines:
        return []
    tests = labels_of(lines)
    ends = frozenset(
        place for place, line in enumerate(lines) if place + 1 == len(lines) or lines[place + 1].trained != line.trained
    )
    sheets = []
    for column in METRICS:
        texts = tuple(
            (line.trained, line.method, _seeds(line, column), *(_text(line, test, column) for test in tests))
            for line in lines
        )
        header = ("trained on", "method", "n", *tests.values())
        sheets.append(Sheet(f"Transfer: {column.label}", header, texts, 2, ends))
    sheets[-1] = replace(sheets[-1], note=NOTE)
    return [*sheets, _test_sheet(tests)]


NOTE = (
    "Rows were trained on one data set, columns are the tests. Displacements in m, minimum over the modes; OR (JFP) is the "
    "share of scenes whose most likely joint mode has an overlap; lower is better. Columns have different scenes: compare "
    "the rows of a column, not its numbers with those of another one."
)


def _seeds(line: Line, column: Column) -> str:
    """Largest number of seeds of a line's cells."""
    return str(max((cells[column.metric].n for cells in line.cells.values() if column.metric in cells), default=0))


def _text(line: Line, test: TestSet, column: Column) -> str:
    cell = line.cells.get(test, {}).get(column.metric)
    return MISSING if cell is None else own_text(cell, column)


def _test_sheet(tests: Mapping[TestSet, str]) -> Sheet:
    """Scenes, recordings, agents and notes of every test."""
    lines = []
    for test, label in tests.items():
        agents = test.about.get("agents", {})
        total = sum(agents.values())
        kinds = ", ".join(f"{kind} {count / total:.0%}" for kind, count in agents.items()) if total else MISSING
        notes = "; ".join(test.about.get("notes", ())) or MISSING
        counts = [str(test.about.get(key, MISSING)) for key in ("scenes", "recordings")]
        lines.append((label, kinds, notes, *counts))
    return Sheet("Transfer: test sets", ("test", "agents", "notes", "scenes", "recordings"), tuple(lines), 3)


def transfers_to_csv(lines: Sequence[Line]) -> str:
    """CSV of all scores in full precision, one metric per line."""
    tests = labels_of(lines)
    found: list[tuple[object, ...]] = []
    for line in lines:
        run, seeds = line.runs[0], " ".join(str(run.seed) for run in line.runs)
        for test in (test for test in tests if test in line.cells):
            same = (line.trained, line.method, run.budget, line.checkpoint, test.name, test.split)
            for metric, cell in line.cells[test].items():
                deviation = "" if cell.deviation is None else repr(cell.deviation)
                values = (test.about.get("scenes", ""), metric, repr(cell.mean), deviation, cell.n, seeds)
                found.append((*same, *values, run.row, run.trained_digest, test.digest))
    return csv_text(HEADER, found)
