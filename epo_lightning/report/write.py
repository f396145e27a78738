"""The report: tables, how they were made, and figures, in one folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from epo_lightning.report.render import LEGEND, to_csv, to_markdown, to_rich
from epo_lightning.report.runs import EvaluatedRun, collect, not_evaluated
from epo_lightning.report.tables import Table, build_tables
from epo_lightning.run_folder import write_text


def write_report(
    runs: str | Path,
    out: str | Path,
    figures: Sequence[str | Path] = (),
    preface: str = "",
    console: Console | None = None,
) -> str:
    """Report on all evaluated runs in and below a folder: print the tables, write ``results.md`` and ``results.csv``.

    Nothing is written unless everything could be read.

    Args:
        runs: folder of run folders.
        out: folder of the report.
        figures: pictures that results.md shows; links are relative to ``out``.
        preface: Markdown that stands before the tables, for what a reader has to know first.
        console: where to print; the terminal by default.

    Returns:
        The text of results.md.

    Raises:
        ConfigError: as :func:`~epo_lightning.report.collect` and :func:`~epo_lightning.report.build_tables`.
    """
    runs, out = Path(runs).expanduser(), Path(out).expanduser()
    tables = build_tables(collect(runs))
    markdown = "\n".join(
        part
        for part in (
            "# Results\n",
            preface.strip() + "\n" if preface.strip() else "",
            *(to_markdown(table) for table in tables),
            LEGEND + "\n",
            how_made(tables, runs),
            *(f"![{Path(figure).stem}]({os.path.relpath(figure, out)})\n" for figure in figures),
        )
        if part
    )
    write_text(out / "results.md", markdown)
    write_text(out / "results.csv", to_csv(tables))
    console = console or Console()
    for table in tables:
        console.print(to_rich(table))
    return markdown


def how_made(tables: Sequence[Table], folder: Path) -> str:
    """What somebody needs to judge the tables, and to make them again."""
    lines = [
        "### How this was made",
        "",
        "| method | data | split | budget | seeds | parameters | commit | data digest |",
        "|:--|:--|:--|:--|:--|--:|:--|:--|",
    ]
    shown = dict.fromkeys(
        (row.name, first.data, first.split, *_conditions(row.runs), first.data_digest)
        for table in tables
        for row in table.rows
        for first in row.runs[:1]
    )
    lines += ["| " + " | ".join(entry) + " |" for entry in shown]
    lines += ["", f"Made of the runs in `{folder}` by `epo report runs={folder}`."]
    if missing := not_evaluated(folder):
        lines.append(f"Left out, not evaluated yet: {', '.join(f'`{path}`' for path in missing)}.")
    return "\n".join([*lines, ""])


def _short(commit: str) -> str:
    """Enough of a commit to find it; ``+`` says that files had been changed since."""
    return commit[:10] + ("+" if commit.endswith("+") else "")


def _conditions(runs: Sequence[EvaluatedRun]) -> tuple[str, str, str, str]:
    """Budget, seeds, parameters and commits of a row; what learns nothing has no budget."""
    parameters = ", ".join(sorted({"-" if run.parameters is None else str(run.parameters) for run in runs}))
    commits = ", ".join(sorted({_short(run.git_commit) for run in runs}))
    budget = runs[0].budget if runs[0].learned else "-"
    return budget, ", ".join(str(seed) for seed in sorted(run.seed for run in runs)), parameters, commits
