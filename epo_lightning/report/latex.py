r"""Tables -> LaTeX with booktabs, with what is behind the numbers as comments above.

A document needs ``\usepackage{booktabs,graphicx}``: a table that is wider than its column is made smaller.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

from epo_lightning.report.render import (
    Sheet,
    comparison_sheet,
    difference_text,
    legend,
    paper_text,
    with_ends,
)
from epo_lightning.report.statistics import Comparisons
from epo_lightning.report.tables import MISSING, Column, Row, Table

SPECIAL = {
    **{letter: rf"\{letter}" for letter in "&%$#_{}"},
    **{letter: f"{{{letter}}}" for letter in "[]*"},  # at the beginning of a line they would belong to the line before
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", '"': "''"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "±": r"$\pm$", "…": r"\dots{}"},
    **{"\N{MULTIPLICATION SIGN}": r"$\times$", "\N{MINUS SIGN}": "$-$", "\N{EN DASH}": "--"},
}

COMPARISON_CAPTION = (
    "First row minus second row, paired by seed: negative is better for the first; $n$ pairs; two-sided paired t-test, "
    "not corrected for the number of comparisons. With three seeds it has little power."
)


def latex_text(text: str) -> str:
    """Text in which nothing is a command; letters that pdflatex does not know are given by their number."""
    return "".join(SPECIAL.get(letter) or _letter(letter) for letter in " ".join(text.split()))


def _letter(letter: str) -> str:
    base = unicodedata.normalize("NFD", letter)[0]  # a letter with an accent is known where the letter is
    known = (letter.isascii() and letter.isprintable()) or (ord(letter) < 256 and base.isascii() and base.isalpha())
    return letter if known or letter in "ßæøÆØ" else f"{{[}}U+{ord(letter):04X}{{]}}"


def to_latex(table: Table, label: str | None = None, caveat: str = "") -> str:
    """The main kind of table: rows x metrics, rules between the groups.

    Args:
        label: what ``\\ref`` calls it; made of the title if not given.
        caveat: text without markup that has to be known before the numbers are used.
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
    return _float(behind(table.rows), header, columns, lines, caption, label or slug(table.title))


def _caption(title: str, caveat: str, legend: str) -> str:
    warning = rf"\textbf{{{latex_text(caveat)}}}" if caveat else ""
    return " ".join(part for part in (f"{latex_text(title)}.", warning, legend) if part)


def _legend(table: Table) -> str:
    """Legend of a table's numbers, as :func:`~epo_lightning.report.render.legend` says it."""
    text = legend([table], "below", r"\textbf{Bold}", r"\underline{underlined}")
    return text.replace("±", r"$\pm$").replace("n seeds", "$n$ seeds")


def sheet_to_latex(
    sheet: Sheet, rows: Sequence[Row] = (), caption: str = "", label: str | None = None, caveat: str = ""
) -> str:
    """A table of plain text.

    Args:
        rows: those that are behind its numbers, named in the comments.
        caption: LaTeX that follows the title; the sheet's note if not given.
        label, caveat: as in :func:`to_latex`.
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
    return _float(behind(rows), header, columns, lines, caption, label or slug(sheet.title))


def comparisons_to_latex(comparisons: Comparisons, label: str | None = None, caveat: str = "") -> str:
    """The paired comparisons of a table; label and caveat as in :func:`to_latex`."""
    rows = {row.identity: row for pair in comparisons.pairs for row in (pair.one, pair.other)}
    return sheet_to_latex(comparison_sheet(comparisons), list(rows.values()), COMPARISON_CAPTION, label, caveat)


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
    """``tab:`` and the letters and digits of a title."""
    return "tab:" + "-".join(re.findall(r"[a-z0-9]+", title.lower()))


def _cell(row: Row, column: Column) -> str:
    cell = row.cells.get(column.metric)
    if cell is None:
        return MISSING
    form = {1: r"\textbf{%s}", 2: r"\underline{%s}"}.get(cell.rank or 0, "%s")
    deviation = "" if cell.deviation is None else rf"\,{{\scriptsize$\pm$\,{_minus(column.text(cell.deviation))}}}"
    return form % _minus(column.text(cell.mean)) + deviation


def _minus(text: str) -> str:
    """Text in which the sign of a number is one."""
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
