"""Tables -> a terminal (rich), Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable

from rich.box import SIMPLE_HEAD
from rich.table import Table as RichTable
from rich.text import Text

from epo_lightning.report.tables import Cell, Column, Row, Table

LEGEND = (
    "Displacements in m, minimum over the modes; overlap rates (OR) of the most likely joint mode; lower is better. "
    "Mean ± standard deviation over n seeds; the paper's value in brackets. **Bold** is the best and <u>underlined</u> "
    "the second best of the rows with the same backbone that know equally much. OR (JFP) is the share of scenes with "
    "an overlap, as the paper defines its OR; OR (authors) counts overlapping pairs divided by agents, as the authors' "
    "code does."
)

CSV_HEADER = (
    *("data", "split", "method", "backbone", "forecaster", "goal", "budget", "seeds"),
    *("metric", "mean", "std", "paper"),
)


def number(value: float, digits: int) -> str:
    """A number as tables print it; a dash where there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def own_text(cell: Cell, column: Column) -> str:
    """Mean ± deviation."""
    mean = number(cell.mean, column.digits)
    return mean if cell.deviation is None else f"{mean} ± {number(cell.deviation, column.digits)}"


def to_rich(table: Table) -> RichTable:
    """For the terminal, where 80 columns have to do: deviations stand under their means, the paper's values below a row."""
    rich = RichTable(title=table.title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    rich.add_column("method")  # the one column that may break its lines: half a number is worse than none
    rich.add_column("n", justify="right", no_wrap=True)
    for column in table.columns:
        rich.add_column(column.label.replace(" ", "\n"), justify="right", no_wrap=True, vertical="top")
    for row, last in _with_ends(table.rows):
        paper = [_paper_number(row, column) for column in table.columns]
        cells = (_rich_cell(row, column) for column in table.columns)
        rich.add_row(row.name, str(len(row.runs)), *cells, end_section=last and not any(paper))
        if any(paper):
            rich.add_row("  paper", "", *paper, style="dim", end_section=last)
    return rich


def _rich_cell(row: Row, column: Column) -> Text:
    cell = row.cells.get(column.metric)
    if cell is None:
        return Text("")
    style = {1: "bold", 2: "underline"}.get(cell.rank or 0, "")
    deviation = "" if cell.deviation is None else f"\n±{number(cell.deviation, column.digits)}"
    return Text.assemble((number(cell.mean, column.digits), style), (deviation, "dim"))


def _paper_number(row: Row, column: Column) -> str:
    """The paper's value with the digits that it is printed with, or nothing."""
    cell = row.cells.get(column.metric)
    return "" if cell is None or cell.paper is None else number(cell.paper, column.digits - 1)


def to_markdown(table: Table) -> str:
    """A pipe table with its title; groups follow each other."""
    lines = [
        f"### {table.title}",
        "",
        "| method | n | " + " | ".join(column.label for column in table.columns) + " |",
        "|:--|--:|" + "--:|" * len(table.columns),
    ]
    for row in table.rows:
        cells = [_markdown_cell(row, column) for column in table.columns]
        lines.append(f"| {row.name.replace('|', chr(92) + '|')} | {len(row.runs)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _markdown_cell(row: Row, column: Column) -> str:
    cell = row.cells.get(column.metric)
    if cell is None:
        return ""
    form = {1: "**{}**", 2: "<u>{}</u>"}.get(cell.rank or 0, "{}")
    paper = _paper_number(row, column)
    return form.format(own_text(cell, column)) + (f" ({paper})" if paper else "")


def to_csv(tables: Iterable[Table]) -> str:
    """All scores of all rows in full precision, one per line, shown in a table or not."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_HEADER)
    written: set[tuple[str, ...]] = set()
    for row in (row for table in tables for row in table.rows):
        run = row.runs[0]
        key = (run.data, run.split, row.name, *row.group, run.forecaster)
        if key in written:  # every table of a data set shows the same rows
            continue
        written.add(key)
        seeds = " ".join(map(str, row.seeds))
        same = (run.data, run.split, row.name, run.backbone, run.forecaster, run.goal, run.budget, seeds)
        for metric, cell in row.cells.items():
            deviation = "" if cell.deviation is None else repr(cell.deviation)
            writer.writerow((*same, metric, repr(cell.mean), deviation, "" if cell.paper is None else cell.paper))
    return text.getvalue()


def _with_ends(rows: tuple[Row, ...]) -> Iterable[tuple[Row, bool]]:
    """Every row, and whether it is the last of its group."""
    following = [*(row.group for row in rows[1:]), None]
    return ((row, row.group != after) for row, after in zip(rows, following, strict=True))
