"""Tables in the terminal (rich), in Markdown and as CSV; :mod:`epo_lightning.report.latex` writes LaTeX.

The tables of comparisons and of best settings have no ranks and no second lines: they become a *sheet*, plain text in
columns, which every format can show.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from epo_lightning.report.columns import GAME, MISSING, OF_MODES, TRUE, Column, decimals, is_own, number
from epo_lightning.report.rows import Cell, Row
from epo_lightning.report.selection import BestSetting
from epo_lightning.report.statistics import Comparisons, Difference
from epo_lightning.report.tables import Table, distinct

COMPARISON_LEGEND = (
    "Differences of the scores of two rows, paired by seed: the first row minus the second, so that negative is better for "
    "the first; n is the number of pairs. The interval covers the mean difference with 95 % confidence; p is that of the "
    "two-sided paired t-test, not corrected for the number of comparisons. With three seeds such a test has little power: "
    "a large p does not say that two rows are equally good."
)

GAMES = (
    "Energies are those of the most likely joint mode: at the initial strategies (with candidates: each agent's cheapest "
    "by itself), as forecast (solved), and at a tightly solved optimum near the forecast. The Nash gap is the most "
    "that an agent could gain by changing its strategy alone, by local search: a lower bound; for methods that choose "
    "among candidates, by taking another of its own candidates, where choosing the best joint one leaves nothing to "
    "gain. Relative: as a share of its own objective, where that has a natural zero. Energies of different methods, "
    "their gradients and gaps are in different units; relative gaps compare, and lower is better."
)

CHANCES = (
    "Brier-SADE is the SADE plus (1 - p)^2 of the closest mode with probability p. ECE is the calibration error: how far "
    "the probabilities of modes are from the shares of scenes in which these modes are the closest."
)

MISSED = (
    "Missed is the share of the scenes of that alternative whose future is more than 0.25 m (SADE) from every mode."
)

FEWER = "A cell with n=... is of those seeds alone that have the score."
TRUE_COSTS = (
    "Inferred costs of the most likely mode in units of the true cost of controls, against those of the games that made "
    "the data. w is the weight of the pair term; its rank correlation is best at 1. Errors are relative: medians of scenes."
)

EFFECT = (
    "Effect of the other agents: mean displacement in m between the most likely joint mode and the solution of the same "
    "game from the same start without its pair terms. The start was decoded with knowledge of all agents, so this is the "
    "part of the game alone; a large effect is not better than a small one."
)

NAMES = 16
"""Least width of the column of names in a terminal."""
CSV_HEADER = (
    *("data", "split", "method", "backbone", "forecaster", "goal", "budget", "seeds", "n"),
    *("metric", "mean", "std", "paper", "difference"),
    *("row", "data_digest", "commits", "commands"),
)
COMPARISON_HEADER = (
    *("data", "split", "method", "other", "metric", "difference", "low", "high", "p", "n", "seeds", "reason"),
    *("row", "other_row", "data_digest"),
)


@dataclass(frozen=True)
class Sheet:
    """A table of plain text.

    Attributes:
        title: title above the table.
        header: names of the columns.
        lines: rows, with one text per column.
        left: number of leftmost columns with text; the others contain numbers.
        ends: indices of the last lines of groups.
        note: explanation below the table.
    """

    title: str
    header: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    left: int = 1
    ends: frozenset[int] = field(default_factory=frozenset)
    note: str = ""


def signed(value: float, digits: int) -> str:
    """A difference as tables print it: with its sign, unless it rounds to zero."""
    if math.isnan(value):
        return number(value, digits)
    digits = decimals(value, digits)
    rounded = round(value, digits)
    return f"{rounded:+.{digits}f}" if rounded else number(0.0, digits)


def own_text(cell: Cell, column: Column) -> str:
    """Mean and deviation of a cell as text."""
    mean = column.text(cell.mean)
    return mean if cell.deviation is None else f"{mean} ± {column.deviation(cell.deviation, cell.mean)}"


def seeds_text(row: Row, cell: Cell) -> str:
    """The number of seeds of a cell, where some runs of its row lack the score; else empty."""
    return "" if cell.n == len(row.runs) else f"n={cell.n}"


def paper_text(row: Row, column: Column) -> str:
    """The paper's value with the digits of the paper; empty if there is none."""
    cell = row.cells.get(column.metric)
    if cell is None or cell.paper is None:
        return ""
    printed = len(f"{cell.paper!r}".partition(".")[2])
    return number(cell.paper, max(printed, column.digits - 1))


def difference_text(row: Row, column: Column) -> str:
    """Difference of our value and the paper's as text; empty if the paper has none."""
    cell = row.cells.get(column.metric)
    return "" if cell is None or cell.difference is None else signed(cell.difference, column.digits)


def legend(
    tables: Sequence[Table], where: str = "in brackets", bold: str = "**Bold**", second: str = "<u>underlined</u>"
) -> str:
    """Legend of tables, which explains only what they contain.

    Args:
        where: position of the paper's values, such as ``below``.
        bold, second: names of the markup of the best and second best values, themselves marked up.
    """
    shown = [
        (row, row.cells[column.metric])
        for table in tables
        for row in table.rows
        for column in table.columns
        if column.metric in row.cells
    ]
    metrics = {column.metric for table in tables for column in table.columns}
    overlaps = any("overlap" in metric for metric in metrics)
    rates = "; overlap rates (OR) of the most likely joint mode" if overlaps else ""
    few = "; with k, over the k most likely" if any(map(OF_MODES.fullmatch, metrics)) else ""
    errors = any(
        not (metric in GAME or Column(metric, "").is_effect or metric.startswith(TRUE))
        and not ("overlap" in metric or is_own(metric))
        for metric in metrics
    )
    fewer = any(seeds_text(row, cell) for row, cell in shown)
    mean = (
        "Mean ± sample standard deviation over n seeds" if any(cell.deviation is not None for _, cell in shown) else ""
    )
    paper = (
        f"{where}, the paper's value and ours minus the paper's"
        if any(cell.paper is not None for _, cell in shown)
        else ""
    )
    numbers = "; ".join(part for part in (mean, paper) if part)
    ranked = (
        f"{bold} is the best and {second} the second best of the rows with the same backbone that know equally much."
    )
    rules = (
        "OR (JFP) is the share of scenes with an overlap, as the paper defines its OR; OR (authors) counts overlapping "
        "pairs divided by agents, as the authors' code does."
    )
    parts = (
        f"Displacements in m, minimum over the modes{few}{rates}; lower is better." if errors else "",
        f"{numbers[0].upper()}{numbers[1:]}." if numbers else "",
        FEWER if fewer else "",
        ranked if any(cell.rank for _, cell in shown) else "",
        rules if overlaps else "",
        EFFECT if any(Column(metric, "").is_effect for metric in metrics) else "",
        GAMES if metrics & {*GAME} else "",
        CHANCES if "ECE" in metrics else "",
        TRUE_COSTS if any(metric.startswith(TRUE) for metric in metrics) else "",
        MISSED if any(metric.endswith("/missed") for metric in metrics) else "",
    )
    return " ".join(part for part in parts if part)


def comparison_sheet(comparisons: Comparisons) -> Sheet:
    """One line per pair of rows and metric; a single line for a pair without two common seeds."""
    lines: list[tuple[str, ...]] = []
    ends = set()
    for pair in comparisons.pairs:
        name = f"{pair.one.name} - {pair.other.name}"
        if len(pair.seeds) < 2:  # what cannot be tested, the table itself shows as well
            reason = next((found.reason for found in pair.differences.values()), "no common metric")
            lines.append((name, "all", "", reason, "", str(len(pair.seeds))))
        else:
            columns = [column for column in comparisons.columns if column.metric in pair.differences]
            texts = [(column.label, *_difference_texts(pair.differences[column.metric], column)) for column in columns]
            names = [name, *("" for _ in texts[1:])]
            lines += [(first, *line) for first, line in zip(names, texts, strict=True)]
        ends.add(len(lines) - 1)
    header = ("rows", "metric", "difference", "95 % interval", "p", "n")
    return Sheet(comparisons.title, header, tuple(lines), 2, frozenset(ends))


def _difference_texts(found: Difference, column: Column) -> tuple[str, str, str, str]:
    """Texts of mean, interval (or the reason for none), p-value and number of pairs."""
    mean = "" if found.mean is None else signed(found.mean, column.digits)
    if found.low is None or found.high is None or found.p is None:
        return mean, found.reason, "", str(found.n)
    interval = f"{signed(found.low, column.digits)} to {signed(found.high, column.digits)}"
    return mean, interval, p_text(found.p), str(found.n)


def p_text(p: float) -> str:
    """A p-value as text, ``< 0.001`` for smaller ones."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def settings_sheet(best: Sequence[BestSetting]) -> Sheet:
    """Sheet with one line per experiment: its best score, number of settings, and the overrides that train with it."""
    lines = tuple(
        (
            entry.title,
            entry.words,
            own_text(entry.row.cells[entry.metric], Column(entry.metric, "")),
            str(entry.row.cells[entry.metric].n),
            str(entry.candidates),
        )
        for entry in best
    )
    metric = best[0].metric if best else "score"
    return Sheet("Best settings, chosen on the validation split", ("row", "setting", metric, "n", "of"), lines, 2)


def to_rich(table: Table | Sheet) -> RichTable:
    """Table for a terminal of 80 columns: deviations below their means, the paper's values below each row."""
    rich = RichTable(
        title=Text(table.title), title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    if isinstance(table, Sheet):
        rich.caption, rich.caption_justify = Text(table.note, style="dim") if table.note else None, "left"
        for place, name in enumerate(table.header):
            is_text = place < table.left
            rich.add_column(Text(name), justify="left" if is_text else "right", no_wrap=False, overflow="fold")
        for index, line in enumerate(table.lines):
            rich.add_row(*map(Text, line), end_section=index in table.ends)
        return rich
    rich.add_column("method")  # the one column that may break its lines: half a number is worse than none
    rich.add_column("n", justify="right", no_wrap=True)
    for column in table.columns:
        rich.add_column(Text(column.label.replace(" ", "\n")), justify="right", no_wrap=True, vertical="top")
    for row, last in with_ends(table.rows):
        paper = [paper_text(row, column) for column in table.columns]
        cells = (_rich_cell(row, column) for column in table.columns)
        rich.add_row(Text(row.name), str(len(row.runs)), *cells, end_section=last and not any(paper))
        if any(paper):
            rich.add_row("  paper", "", *paper, style="dim")
            differences = (difference_text(row, column) for column in table.columns)
            rich.add_row("  ours - paper", "", *differences, style="dim", end_section=last)
    return rich


def least_width(table: RichTable) -> int:
    """Width at which every number of a terminal's table is shown, and at least :data:`NAMES` characters of the names."""
    wide = Console(width=10_000)
    natural = wide.measure(table, options=wide.options).maximum
    names = max((len(line) for cell in table.columns[0].cells for line in str(cell).splitlines()), default=0)
    return natural - max(0, names - NAMES)


def _rich_cell(row: Row, column: Column) -> Text:
    cell = row.cells.get(column.metric)
    if cell is None:
        return Text(MISSING)
    style = {1: "bold", 2: "underline"}.get(cell.rank or 0, "")
    deviation = "" if cell.deviation is None else f"\n±{column.deviation(cell.deviation, cell.mean)}"
    seeds = seeds_text(row, cell)
    return Text.assemble((column.text(cell.mean), style), (deviation, "dim"), (f"\n{seeds}" if seeds else "", "dim"))


def to_markdown(table: Table | Sheet) -> str:
    """Markdown table with its title; groups follow each other."""
    if isinstance(table, Sheet):
        header, left, lines = table.header, table.left, [[_plain(text) for text in line] for line in table.lines]
    else:
        header, left = ("method", "n", *(column.label for column in table.columns)), 1
        lines = [
            [_plain(row.name), str(len(row.runs)), *(_markdown_cell(row, column) for column in table.columns)]
            for row in table.rows
        ]
    note = ["", _plain(table.note)] if isinstance(table, Sheet) and table.note else []
    return "\n".join([f"## {_plain(table.title)}", "", markdown(header, lines, left), *note]) + "\n"


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]], left: int = 1) -> str:
    """A Markdown table whose cells may have links and emphasis."""
    rule = "|" + ":--|" * left + "--:|" * (len(header) - left)
    first, *rest = ("| " + " | ".join(line) + " |" for line in (header, *lines))
    return "\n".join([first, rule, *rest])


def _plain(text: str) -> str:
    """Text with Markdown's special characters escaped."""
    text = " ".join(text.split())
    for special in "\\|*`[]":
        text = text.replace(special, "\\" + special)
    return without_html(text)


def without_html(text: str) -> str:
    """Markdown with HTML escaped."""
    return text.replace("&", "&amp;").replace("<", "&lt;")


def code(text: str) -> str:
    """Text as Markdown code, delimited by more backticks than it contains."""
    fence = "`" * (max(map(len, re.findall("`+", text)), default=0) + 1)
    space = " " if text.startswith("`") or text.endswith("`") else ""
    return f"{fence}{space}{text}{space}{fence}"


def _markdown_cell(row: Row, column: Column) -> str:
    cell = row.cells.get(column.metric)
    if cell is None:
        return MISSING
    form = {1: "**{}**", 2: "<u>{}</u>"}.get(cell.rank or 0, "{}")
    paper, seeds = paper_text(row, column), seeds_text(row, cell)
    behind = [*([f"{paper}, {difference_text(row, column)}"] if paper else []), *([seeds] if seeds else [])]
    return " ".join([form.format(own_text(cell, column)), *(f"({text})" for text in behind)])


def to_csv(tables: Iterable[Table]) -> str:
    """CSV of all scores of all rows in full precision, one per line, including scores that no table shows."""
    lines: list[tuple[object, ...]] = []
    for row in distinct(tables):
        run = row.runs[0]
        seeds = " ".join(map(str, row.seeds))
        same = (run.data, run.split, row.name, run.backbone, run.forecaster, run.goal, row.budget, seeds)
        behind = (row.identity, row.data_digest, " ".join(row.commits), "; ".join(row.commands))
        for metric, cell in row.cells.items():
            values = (cell.mean, cell.deviation, cell.paper, cell.difference)
            lines.append((*same, cell.n, metric, *map(_full, values), *behind))
    return csv_text(CSV_HEADER, lines)


def comparisons_to_csv(comparisons: Iterable[Comparisons]) -> str:
    """CSV of all comparisons in full precision, one metric per line."""
    lines: list[tuple[object, ...]] = []
    for pair in (pair for entry in comparisons for pair in entry.pairs):
        run, seeds = pair.one.runs[0], " ".join(map(str, pair.seeds))
        behind = (pair.one.identity, pair.other.identity, pair.one.data_digest)
        for metric, found in pair.differences.items():
            values = map(_full, (found.mean, found.low, found.high, found.p))
            names = (run.data, run.split, pair.one.name, pair.other.name, metric)
            lines.append((*names, *values, found.n, seeds, found.reason, *behind))
    return csv_text(COMPARISON_HEADER, lines)


def _full(value: float | None) -> str:
    return "" if value is None else repr(value)


def csv_text(header: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """CSV with a header, without cells that spreadsheets would read as formulas."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_no_formula(cell) for cell in line] for line in lines)
    return text.getvalue()


def _no_formula(cell: object) -> object:
    """A CSV cell that no spreadsheet reads as a formula: text that looks like one gets an apostrophe, numbers do not."""
    if not isinstance(cell, str) or not cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell


def with_ends(rows: tuple[Row, ...]) -> Iterable[tuple[Row, bool]]:
    """Rows, each with whether it is the last of its group."""
    following = [*(row.group for row in rows[1:]), None]
    return ((row, row.group != after) for row, after in zip(rows, following, strict=True))
