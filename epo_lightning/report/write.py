"""The report as a folder: tables, their provenance, figures, and the page with all of them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from epo_lightning.files import write_file
from epo_lightning.registry import ConfigError
from epo_lightning.report.choices import choices_to_yaml
from epo_lightning.report.costs import cost_sheets, timings_of
from epo_lightning.report.labels import word
from epo_lightning.report.latex import comparisons_to_latex, sheet_to_latex, to_latex
from epo_lightning.report.made import Made, how_made
from epo_lightning.report.notes import of_different_batches, of_different_code, untaught
from epo_lightning.report.paper import has_values
from epo_lightning.report.records import TIME, Records
from epo_lightning.report.render import (
    COMPARISON_LEGEND,
    Sheet,
    code,
    comparison_sheet,
    comparisons_to_csv,
    least_width,
    legend,
    settings_sheet,
    to_csv,
    to_markdown,
    to_rich,
    without_html,
)
from epo_lightning.report.runs import EvaluatedRun, collect, find_runs, read_parts, scored, scored_elsewhere
from epo_lightning.report.selection import BestSetting, at_edge, best_settings
from epo_lightning.report.statistics import Comparisons, build_comparisons
from epo_lightning.report.tables import Table, build_tables, distinct
from epo_lightning.report.timings import places, read_timings, timing_sheet
from epo_lightning.report.transfer import Line, transfer_sheets, transfers, transfers_to_csv
from epo_lightning.report.worth import LEGEND as WORTH_LEGEND
from epo_lightning.report.worth import build_worth
from epo_lightning.run_folder import RunFolder

if TYPE_CHECKING:
    from epo_lightning.report.charts import Chart


@dataclass(frozen=True)
class Report:
    """Runs and titles of a report.

    Attributes:
        title: title of the report.
        command: command that writes the report.
        runs: records of all runs that have scores, on their own or on other data, or were timed.
        evaluated: scores of these runs.
        left_out: the other run folders, each with the reason.
        sweep: command that began the sweep; empty for a report of other runs.
    """

    title: str
    command: str
    runs: tuple[Records, ...]
    evaluated: tuple[EvaluatedRun, ...]
    left_out: tuple[tuple[str, str], ...] = ()
    sweep: str = ""

    @classmethod
    def of_folder(cls, folder: str | Path) -> Report:
        """Report on all runs in and below a folder.

        Raises:
            ConfigError: as :func:`~epo_lightning.report.runs.collect`.
        """
        known = find_runs(folder)
        runs = [run for run in known if is_measured(run)]
        # Runs that were only timed, or scored on other data, are worth a report; without any, collect says what is missing.
        only_timed = runs and not any(map(scored, runs))
        return cls(
            title=Path(folder).expanduser().resolve().name,
            command=f"epo report {word('runs', str(folder))}",
            runs=tuple(runs),
            evaluated=() if only_timed else tuple(collect(folder)),
            left_out=tuple((str(run.path), why_left_out(run)) for run in known if run not in runs),
        )


def is_timed(run: Records) -> bool:
    """Whether the time of the run's forecasts was measured."""
    return TIME in run.names()


def is_measured(run: Records) -> bool:
    """Whether a run has anything to report: scores on its own or on other data, or the time of its forecasts."""
    return bool(scored(run) or scored_elsewhere(run) or is_timed(run))


def why_left_out(run: RunFolder) -> str:
    """The state of a run that has no scores."""
    return f"not evaluated yet: epo evaluate run={run.path}" if run.state == "finished" else run.state


def write_report(
    report: Report,
    out: str | Path,
    figures: Sequence[str | Path] = (),
    preface: str = "",
    notes: Sequence[str] = (),
    console: Console | None = None,
) -> str:
    """Print the tables; write ``results.md``, ``.csv`` and ``.tex``, ``index.html`` and the figures of many runs.

    Nothing is written unless everything could be read, and every file is written as a whole.

    Args:
        report: subject of the report.
        out: folder of the report.
        figures: existing pictures.
        preface: Markdown before the tables, for caveats.
        notes: notes on what could not be drawn.
        console: output console; the terminal by default.

    Returns:
        The text of results.md.

    Raises:
        ConfigError: as :func:`~epo_lightning.report.tables.build_tables`.
    """
    from epo_lightning.report.style import save

    out = Path(out).expanduser()
    found = _gather(report, notes)
    links = [f"figures/{chart.name}.png" for chart in found.charts] + [os.path.relpath(file, out) for file in figures]
    texts = _texts(found, report, preface, [Path(figure) for figure in figures], links)
    for chart in found.charts:
        save(chart.draw(chart.wide, True), out / "figures" / f"{chart.name}.png")
    for name, text in texts.items():
        write_file(out / name, text)
    _print(console or Console(), found, report.left_out)
    return texts["results.md"]


@dataclass(frozen=True)
class _Found:
    """Contents of a report, as they were found in the records of its runs.

    Attributes:
        tables: rows and their scores.
        transfers: scores on other data.
        of_game, comparisons: paired differences that show the worth of the game, and all others.
        best: the best settings of searches.
        costs, timed: times beside scores, and the other times.
        made: provenance of every row.
        charts: figures of many runs.
        notes: notes on what the reader should know of the runs, or on what could not be shown.
    """

    tables: list[Table]
    transfers: list[Line]
    of_game: list[Comparisons]
    comparisons: list[Comparisons]
    best: list[BestSetting]
    costs: list[Sheet]
    timed: list[Sheet]
    made: list[Made]
    charts: list[Chart]
    notes: list[str]

    @property
    def settings(self) -> list[Sheet]:
        return [settings_sheet(self.best)] if self.best else []

    @property
    def worth(self) -> list[Sheet]:
        return [comparison_sheet(entry) for entry in self.of_game]

    @property
    def compared(self) -> list[Sheet]:
        return [comparison_sheet(entry) for entry in self.comparisons]

    @property
    def elsewhere(self) -> list[Sheet]:
        return transfer_sheets(self.transfers)


def _gather(report: Report, notes: Sequence[str]) -> _Found:
    """Everything that the files of a report show; ``notes`` stand among those on the runs."""
    from epo_lightning.report.charts import charts_of

    tables = build_tables([*report.evaluated, *(part for run in report.runs for part in read_parts(run))])
    timings, damaged = read_timings(report.runs)
    best, hint = _best(report.evaluated)
    rows = distinct(tables)
    others = [timing for timing in timings if timing not in timings_of(tables, timings)]  # a cost is said once
    return _Found(
        tables=tables,
        transfers=transfers(report.runs),
        of_game=build_worth(tables),
        comparisons=build_comparisons(tables),
        best=best,
        costs=cost_sheets(tables, timings),
        timed=[timing_sheet(where, same) for where, same in places(others).items()],
        made=how_made(tables, timings),
        charts=charts_of(tables, timings),
        notes=[
            *of_different_code(rows),
            *of_different_batches(rows),
            *untaught(rows),
            *notes,
            *damaged,
            *([hint] if hint else []),
            *(note for setting in best for note in at_edge(setting)),
        ],
    )


def _texts(
    found: _Found, report: Report, preface: str, figures: Sequence[Path], links: Sequence[str]
) -> dict[str, str]:
    """The report's text files by their names."""
    texts = {
        "results.md": _markdown(found, report, preface, links),
        "index.html": _page(found, report, preface, figures),
    }
    if choices := choices_to_yaml(found.best, report.command):
        texts["choices.yaml"] = choices
    if found.transfers:
        texts["transfer.csv"] = transfers_to_csv(found.transfers)
    if found.tables:
        texts["results.csv"] = to_csv(found.tables)
        caveat = _caveat(found.tables) if preface.strip() else ""
        latex = [to_latex(table, caveat=caveat) for table in found.tables]
        latex += [sheet_to_latex(sheet, caveat=caveat) for sheet in (*found.elsewhere, *found.costs)]
        latex += [comparisons_to_latex(entry, caveat=caveat) for entry in (*found.of_game, *found.comparisons)]
        latex += [sheet_to_latex(sheet, caveat=caveat) for sheet in found.settings]
        texts["results.tex"] = "\n".join(latex)
    if found.of_game or found.comparisons:
        texts["comparisons.csv"] = comparisons_to_csv([*found.of_game, *found.comparisons])
    return texts


def _markdown(found: _Found, report: Report, preface: str, links: Sequence[str]) -> str:
    """The text of results.md."""
    parts = (
        f"# Results: {without_html(report.title)}\n",
        f"{code(report.sweep)}\n" if report.sweep else "",
        preface.strip() + "\n" if preface.strip() else "",
        *(without_html(note) + "\n" for note in found.notes),
        *map(to_markdown, found.tables),
        legend(found.tables) + "\n" if found.tables else "",
        *map(to_markdown, (*found.elsewhere, *found.costs)),
        *map(to_markdown, (*found.settings, *found.worth, *found.compared, *found.timed)),
        WORTH_LEGEND + "\n" if found.of_game else "",
        COMPARISON_LEGEND + "\n" if found.of_game or found.comparisons else "",
        _how_made(found.made, report),
        *(f"![{Path(link).stem}]({link})\n" for link in links),
    )
    return "\n".join(part for part in parts if part)


def _page(found: _Found, report: Report, preface: str, figures: Sequence[Path]) -> str:
    """The HTML of the report."""
    from epo_lightning.report.page import Content, page

    content = Content(
        title=report.title,
        command=report.command,
        preface=preface,
        legend=legend(found.tables, "below"),
        tables=found.tables,
        transfer=found.elsewhere,
        costs=found.costs,
        worth=found.worth,
        comparisons=found.compared,
        settings=found.settings,
        charts=found.charts,
        pictures=figures,
        made=found.made,
        left_out=report.left_out,
        notes=found.notes,
        sweep=report.sweep,
    )
    return page(content)


def _print(console: Console, found: _Found, left_out: Sequence[tuple[str, str]]) -> None:
    """Print the tables between the notes and a summary of the runs that were left out."""
    tables: list[Table | Sheet] = [*found.tables, *found.elsewhere, *found.costs]
    tables += [*found.settings, *found.worth, *found.compared, *found.timed]
    for note in found.notes:
        console.print(note, style="yellow", markup=False, highlight=False, soft_wrap=True)
    terminal = console.width
    for rich in map(to_rich, tables):
        console.width = max(terminal, least_width(rich))  # a long line is better than a row without its name
        console.print(rich)
    console.width = terminal
    if left_out:
        console.print(_summary(left_out), style="yellow", markup=False, highlight=False, soft_wrap=True)


def _caveat(tables: Sequence[Table]) -> str:
    """The preface in a sentence, for captions: tables are copied without the text around them."""
    budgets = sorted({run.budget for table in tables for row in table.rows for run in row.runs} - {"paper"})
    names = ", ".join(budgets or ["paper"])
    others = ", other data or steps than the paper's: does not reproduce its table"
    return f"Budget: {names}{others if any(has_values(table.data) for table in tables) else ''}."


def _summary(left_out: Sequence[tuple[str, str]]) -> str:
    """Summary of runs left out: ``3 runs left out: 1 waiting, 2 failed``; the files give the full reasons."""
    states = Counter(why.partition(":")[0] for _, why in left_out)
    named = ", ".join(f"{count} {state}" for state, count in states.items())
    runs = "run" if len(left_out) == 1 else "runs"
    return f"{len(left_out)} {runs} left out: {named} (see How this was made in results.md)"


def _best(runs: Sequence[EvaluatedRun]) -> tuple[list[BestSetting], str]:
    """The best settings of searches, and notes on searches without a selection."""
    validated = [run for run in runs if run.split == "val"]
    try:
        return (best_settings(validated), "") if validated else ([], "")
    except ConfigError as error:  # a search that is not finished yet
        return [], f"No setting was chosen: {error}"


def _how_made(rows: Sequence[Made], report: Report) -> str:
    """The section on how the runs of the tables were made, as Markdown."""
    header = ("method", "of", "budget", "seeds", "commit", "data digest", "parameters", "n")
    entries = tuple(
        (row.name, row.what, row.budget, row.seeds, row.commits, row.digests, row.parameters, str(len(row.runs)))
        for row in rows
    )
    lines = [to_markdown(Sheet("How this was made", header, entries, left=6))]
    commands = {run.folder: f"- {code(run.folder)}: {code(run.command)}" for row in rows for run in row.runs}
    lines += [*commands.values(), "", f"Written by {code(report.command)}."]
    if report.left_out:
        lines += [
            "",
            "Left out:",
            "",
            *(f"- {code(folder)}: {without_html(state)}" for folder, state in report.left_out),
        ]
    return "\n".join([*lines, ""])
