"""Titles, commands and errors are escaped in pictures, pages, tables and spreadsheets."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from rich.console import Console

from epo_lightning.report.render import code
from epo_lightning.report.style import save
from epo_lightning.report.write import Report, write_report

from .page_runs import write_log
from .run_folders import make_run, scores

TITLES = (r"$\frac{$", "<img src=x onerror=alert(1)>", "=HYPERLINK(1)", "+1-2", "-x", "@SUM(1)", "`code` & **bold**")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    for place, title in enumerate(TITLES):
        run = make_run(tmp_path / "runs" / str(place), title, "epo", scores(-0.05 * place))
        write_log(run, [0.5, 0.4])
        run.update(command=f"epo train title='{title}' x='`<b>`'")
    make_run(tmp_path / "runs" / "left", "=left", "epo", None).update(status="failed", error="<b>broken</b>")
    write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=Console(file=io.StringIO()))
    return tmp_path / "out"


def test_dollar_signs_in_titles_are_drawn_literally(out: Path) -> None:
    assert (out / "figures" / "learning_curves.png").stat().st_size > 10_000
    assert r"$\frac{$" in (out / "index.html").read_text()


def test_html_is_escaped_in_markdown(out: Path) -> None:
    written = (out / "results.md").read_text()
    outside = "".join(part for part in written.splitlines(keepends=True) if not part.startswith("- `"))
    assert "<img" not in outside
    assert "&lt;img src=x" in outside
    assert "<b>broken" not in written
    assert "``epo train title='-x' x='`<b>`'``" in written, "a backtick in a command does not end the code"


def test_csv_cells_are_never_formulas_and_numbers_stay_numbers(out: Path) -> None:
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"].lstrip("'") for row in rows} == set(TITLES)
    for row in rows:
        for name, cell in row.items():
            assert not cell.startswith(("=", "+", "-", "@")) or name in ("mean", "std", "paper", "difference")
    means = {float(row["mean"]) for row in rows if row["method"] == "'-x"}
    assert means == {-0.2, 0.0}


def test_markdown_code_with_backticks_has_longer_delimiters() -> None:
    assert [code(text) for text in ("a", "`", "a``b")] == ["`a`", "`` ` ``", "```a``b```"]


def test_powers_of_ten_are_written_without_mathematics(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    from epo_lightning.report.weights import _power

    assert [_power(value, None) for value in (1e-3, 1.0, 1e12)] == ["10⁻³", "10⁰", "10¹²"]
    figure = Figure()
    figure.text(0, 0, "10⁻¹² w²")
    save(figure, tmp_path / "glyphs.png")  # a missing glyph is a warning, and so an error


def test_brackets_in_names_are_no_markup_of_the_terminal(tmp_path: Path) -> None:
    make_run(tmp_path / "runs", "[bold]x", "epo", {**scores(0.0), "own/jerk [/m/s3]": 1.0})
    terminal = io.StringIO()
    write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=Console(file=terminal))
    assert "[/m/s3]" in terminal.getvalue()
    assert "[bold]x" in terminal.getvalue()
