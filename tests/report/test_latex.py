"""LaTeX tables: they compile where pdflatex is installed, with any characters in titles."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from epo_lightning.report.latex import comparisons_to_latex, latex_text, sheet_to_latex, slug, to_latex
from epo_lightning.report.render import Sheet
from epo_lightning.report.runs import collect
from epo_lightning.report.statistics import build_comparisons
from epo_lightning.report.tables import Table, build_tables

from .run_folders import make_run, scores

needs_latex = pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
NASTY = (
    r"50% & more_of #1 $x^2$ {a} ~b \input{c} <d> |e| \"f\" ± … [g] *h*",
    "3 \N{MULTIPLICATION SIGN} 4 \N{MINUS SIGN} 5 \N{EN DASH} 6",
    "[first] in brackets",
    "* a star",
    "é ü ß æ å ø ñ ç Å þ ð µ ª λ 中 😀 \N{NO-BREAK SPACE}§",
    "".join(map(chr, range(32, 127))),
)


def two_groups(folder: Path) -> list[Table]:
    subsets = {"initial/minSADE": 0.7, "initial/minSFDE": 0.9}
    for seed in range(3):
        make_run(folder / f"m{seed}", "V-LSTM", "marginal", scores(0.3 + seed / 100, 0.006), seed=seed)
        make_run(folder / f"sc{seed}", "V-LSTM + SC", "scene_consistent", scores(0.1 + seed / 100), seed=seed)
        make_run(folder / f"e{seed}", "V-LSTM + EPO", "epo", scores(0.04 - seed / 300) | subsets, seed=seed)
    make_run(folder / "g", "VIBES, 100 %", "marginal", scores(0.2), backbone="vibes", experiment="rpi/a_b")
    return build_tables(collect(folder))


def compiled(folder: Path, *parts: str) -> str:
    """Log of a successful pdflatex run; an error of pdflatex fails the test."""
    body = "\n".join(parts)
    document = (
        "\\documentclass{article}\n\\usepackage{booktabs,graphicx}\n\\begin{document}\n" + body + "\n\\end{document}\n"
    )
    (folder / "report.tex").write_text(document, encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "report.tex"]
    for _ in range(2):  # the second run knows the labels
        done = subprocess.run(command, cwd=folder, capture_output=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout.decode(errors="replace")[-2000:]
    return (folder / "report.log").read_text(errors="replace")


@needs_latex
def test_all_tables_compile_and_fit_the_page(tmp_path: Path) -> None:
    tables = two_groups(tmp_path / "runs")
    (comparisons,) = build_comparisons(tables)
    references = "".join(f"\\ref{{{slug(table.title)}}} " for table in tables)
    long = Sheet("Long", ("setting", "n"), (("word " * 50, "3"),))
    parts = [*map(to_latex, tables), comparisons_to_latex(comparisons), sheet_to_latex(long)]
    log = compiled(tmp_path, references, *parts)
    assert "Overfull" not in log
    assert "undefined" not in log
    assert "multiply defined" not in log
    assert (tmp_path / "report.pdf").stat().st_size > 10_000


@needs_latex
def test_tables_with_any_characters_in_titles_compile(tmp_path: Path) -> None:
    for index, title in enumerate(NASTY):
        make_run(tmp_path / "runs" / str(index), title, "marginal", scores(0.1 * index))
    (table,) = build_tables(collect(tmp_path / "runs"))
    sheet = Sheet(NASTY[0], NASTY, (NASTY, NASTY), left=5, ends=frozenset({0}))
    log = compiled(tmp_path, to_latex(table), sheet_to_latex(sheet))
    assert "Missing character" not in log


def test_special_characters_are_escaped() -> None:
    assert latex_text("a_b & 5% #1") == r"a\_b \& 5\% \#1"
    assert latex_text("\\{$") == r"\textbackslash{}\{\$"
    assert latex_text("0.1 ± 0.2\nµé") == r"0.1 $\pm$ 0.2 {[}U+00B5{]}é"
    assert slug("rpi, test split: +EPO") == "tab:rpi-test-split-epo"


def test_ranks_paper_values_and_rules_equal_hand_written_latex(tmp_path: Path) -> None:
    lines = to_latex(two_groups(tmp_path)[0]).splitlines()
    sc = next(line for line in lines if line.startswith("V-LSTM + SC &"))
    cells = [cell.strip() for cell in sc.removesuffix(r"\\").split("&")]
    # mean of 0.10, 0.11, 0.12; sample deviation sqrt((0.01^2 + 0 + 0.01^2) / 2) = 0.01
    assert cells[:3] == ["V-LSTM + SC", "3", r"\underline{0.110}\,{\scriptsize$\pm$\,0.010}"]
    # 0.11 - 0.04 = 0.07 and 0.11 - 0.11 = 0
    paper = lines[lines.index(sc) + 1]
    assert r"{\scriptsize 0.04 ($+$0.070)} & {\scriptsize 0.11 (0.000)}" in paper
    # mean of 0.04, 0.0367, 0.0333 = 0.0367; 0.0367 - 0.08 = -0.0433
    epo = next(line for line in lines if line.startswith("V-LSTM + EPO &"))
    assert r"\textbf{0.037}" in epo
    assert r"{\scriptsize 0.08 ($-$0.043)}" in lines[lines.index(epo) + 1]
    assert lines[lines.index(epo) + 2] == r"\midrule"
    assert sum(line == r"\midrule" for line in lines) == 2
    assert r"VIBES, 100 \% & 1" in "\n".join(lines)


def test_comments_give_the_provenance_of_the_numbers(tmp_path: Path) -> None:
    tables = two_groups(tmp_path)
    (comparisons,) = build_comparisons(tables)
    for text in (to_latex(tables[0]), comparisons_to_latex(comparisons)):
        comments = [line for line in text.splitlines() if line.startswith("%")]
        head = next(line for line in comments if line.startswith("% V-LSTM + EPO: n = 3 (seeds 0 1 2)"))
        assert "budget reduced, data abc, commit 0123456789abcdef, row " in head
        place = comments.index(head)
        assert comments[place + 1 : place + 4] == [f"%   epo train experiment=None seed={seed}" for seed in range(3)]


def test_a_command_of_several_lines_stays_a_comment(tmp_path: Path) -> None:
    make_run(tmp_path, "a", "epo", scores(0.1)).update(command="epo train\n\\end{document}")
    (table,) = build_tables(collect(tmp_path))
    assert all(re.match("%|\\\\begin", line) for line in to_latex(table).split("\\begin{table}")[0].splitlines())
    assert "\n\\end{document}" not in to_latex(table)
