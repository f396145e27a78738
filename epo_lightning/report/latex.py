r"""Tables as LaTeX with booktabs; comments above each table give the provenance of its numbers.

Documents need ``\usepackage{booktabs,graphicx}``; graphicx shrinks tables that are wider than their column.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

from epo_lightning.report.columns import MISSING, Column
from epo_lightning.report.render import (
    Sheet,
    comparison_sheet,
    difference_text,
    legend,
    paper_text,
    seeds_text,
    with_ends,
)
from epo_lightning.report.rows import Row
from epo_lightning.report.statistics import Comparisons
from epo_lightning.report.tables import Table

SPECIAL = {
    **{letter: rf"\{letter}" for letter in "&%$#_{}"},
    **{letter: f"{{{letter}}}" for letter in "[]*"},  # at the start of a row, LaTeX reads them as an argument of \\
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", '"': "''"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "±": r"$\pm$", "…": r"\dots{}"},
    **{"\N{MULTIPLICATION SIGN}": r"$\times$", "\N{MINUS SIGN}": "$-$", "\N{EN DASH}": "--"},
}

COMPARISON_CAPTION = (
    "First row minus second row, paired by seed: negative is better for the first; $n$ pairs; two-sided paired t-test, "
    "not corrected for the number of comparisons. With three seeds it has little power."
)


def latex_text(text: str) -> str:
    """Text with LaTeX's special characters escaped; characters unknown to pdflatex are written as code points."""
    return "".join(SPECIAL.get(letter) or _letter(letter) for letter in " ".join(text.split()))


def _letter(letter: str) -> str:
    base = unicodedata.normalize("NFD", letter)[0]  # pdflatex knows an accented letter if it knows the base
    known = (letter.isascii() and letter.isprintable()) or (ord(letter) < 256 and base.isascii() and base.isalpha())
    return letter if known or letter in "ßæøÆØ" else f"{{[}}U+{ord(letter):04X}{{]}}"


def to_latex(table: Table, caveat: str = "") -> str:
    """A table of rows and metrics as LaTeX, with rules between the groups of rows.

    Args:
        caveat: plain text, printed in bold before the legend.
    """
    lines = []
    for row, last in with_ends(table.rows):
        cells = [_cell(row, column) for column in table.columns]
        lines.append(_line([latex_text(row.name), str(len(row.runs)), *cells]))
        paper = [_paper(row, column) for column in table.columns]
        if any(paper):
            lines.append(_line([r"\quad{\scriptsize paper}", "", *paper]))
        if last and row is not table.rows[-1]:
            lines.append(r"\midrule")
    header = ["Method", "$n$", *(latex_text(column.label) for column in table.columns)]
    columns = "lr" + "r" * len(table.columns)
    caption = _caption(table.title, caveat, _legend(table))
    return _float(behind(table.rows), header, columns, lines, caption, slug(table.title))


def _caption(title: str, caveat: str, legend: str) -> str:
    warning = rf"\textbf{{{latex_text(caveat)}}}" if caveat else ""
    return " ".join(part for part in (f"{latex_text(title)}.", warning, legend) if part)


def _legend(table: Table) -> str:
    """LaTeX form of a table's legend (:func:`~epo_lightning.report.render.legend`)."""
    text = legend([table], "below", r"\textbf{Bold}", r"\underline{underlined}")
    return text.replace("±", r"$\pm$").replace("n seeds", "$n$ seeds")


def sheet_to_latex(sheet: Sheet, rows: Sequence[Row] = (), caption: str = "", caveat: str = "") -> str:
    """A sheet of plain text as a LaTeX table.

    Args:
        rows: rows whose provenance goes into the comments.
        caption: LaTeX text after the title; by default the sheet's note.
        caveat: as in :func:`to_latex`.
    """
    lines = []
    for index, line in enumerate(sheet.lines):
        numbers = (_minus(latex_text(text)) for text in line[sheet.left :])
        lines.append(_line([*map(latex_text, line[: sheet.left]), *numbers]))
        if index in sheet.ends and index + 1 < len(sheet.lines):
            lines.append(r"\midrule")
    columns = "l" * sheet.left + "r" * (len(sheet.header) - sheet.left)
    caption = _caption(sheet.title, caveat, caption or latex_text(sheet.note))
    header = [latex_text(text) for text in sheet.header]
    return _float(behind(rows), header, columns, lines, caption, slug(sheet.title))


def comparisons_to_latex(comparisons: Comparisons, caveat: str = "") -> str:
    """The paired comparisons of a table as LaTeX; the caveat is as in :func:`to_latex`."""
    rows = {row.identity: row for pair in comparisons.pairs for row in (pair.one, pair.other)}
    return sheet_to_latex(comparison_sheet(comparisons), list(rows.values()), COMPARISON_CAPTION, caveat)


def behind(rows: Sequence[Row]) -> list[str]:
    """Provenance of the numbers of rows, one text per line: n, seeds, data, commits and commands."""
    lines = []
    for row in rows:
        seeds = " ".join(map(str, row.seeds))
        lines.append(
            f"{row.name}: n = {len(row.runs)} (seeds {seeds}), budget {row.budget}, data {row.data_digest}, "
            f"commit {' '.join(row.commits)}, row {row.identity}"
        )
        lines += [f"  {command}" for command in row.commands]
    return [" ".join(line.splitlines()) for line in lines]


def slug(title: str) -> str:
    """Name of a table for ``\\ref``: ``tab:`` and the letters and digits of its title."""
    return "tab:" + "-".join(re.findall(r"[a-z0-9]+", title.lower()))


def _cell(row: Row, column: Column) -> str:
    cell = row.cells.get(column.metric)
    if cell is None:
        return MISSING
    form = {1: r"\textbf{%s}", 2: r"\underline{%s}"}.get(cell.rank or 0, "%s")
    deviation = ""
    if cell.deviation is not None:
        deviation = rf"\,{{\scriptsize$\pm$\,{_minus(column.deviation(cell.deviation, cell.mean))}}}"
    seeds = seeds_text(row, cell)
    return form % _minus(column.text(cell.mean)) + deviation + (rf" \scriptsize({seeds})" if seeds else "")


def _minus(text: str) -> str:
    """Text with the minus signs of its numbers in mathematics mode."""
    return re.sub(r"(?<![^\We])-(?=\d)", "$-$", text)


def _paper(row: Row, column: Column) -> str:
    paper = paper_text(row, column)
    difference = difference_text(row, column).replace("-", "$-$").replace("+", "$+$")
    return rf"{{\scriptsize {paper} ({difference})}}" if paper else ""


def _line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _float(
    comments: Sequence[str],
    header: Sequence[str],
    columns: str,
    lines: Sequence[str],
    caption: str,
    label: str,
) -> str:
    return "\n".join(
        [
            *(f"% {comment}" for comment in comments),
            r"\begin{table}[tbp]",
            r"\centering",
            rf"\caption{{{caption}}}",
            rf"\label{{{label}}}",
            r"\smallskip\footnotesize\setlength{\tabcolsep}{3pt}",
            rf"\sbox0{{\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            _line(header),
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}}",
            r"\ifdim\wd0>\linewidth\resizebox{\linewidth}{!}{\usebox0}\else\usebox0\fi",
            r"\end{table}",
            "",
        ]
    )
