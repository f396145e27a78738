"""Tables, comparisons and best settings in the terminal, in Markdown and as CSV."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table as RichTable

from epo_lightning.report.columns import Column
from epo_lightning.report.latex import to_latex
from epo_lightning.report.render import (
    Sheet,
    comparison_sheet,
    comparisons_to_csv,
    least_width,
    legend,
    own_text,
    p_text,
    settings_sheet,
    signed,
    to_csv,
    to_markdown,
    to_rich,
)
from epo_lightning.report.rows import Cell
from epo_lightning.report.runs import collect
from epo_lightning.report.selection import best_settings
from epo_lightning.report.statistics import build_comparisons
from epo_lightning.report.tables import Table, build_tables

from .run_folders import make_run, scores


def pairs(folder: Path) -> None:
    """Three seeds of both rows; EPO is better by 1, 2 and 3."""
    for seed in range(3):
        make_run(folder / f"sc{seed}", "V-LSTM + SC", "scene_consistent", scores(2.0 + 2 * seed), seed=seed)
        make_run(folder / f"e{seed}", "V-LSTM + EPO", "epo", scores(1.0 + seed), seed=seed, experiment="rpi/v_lstm_epo")


def printed(table: Table | Sheet, width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(to_rich(table))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_comparison_is_rendered_in_every_format(tmp_path: Path) -> None:
    pairs(tmp_path)
    (comparisons,) = build_comparisons(build_tables(collect(tmp_path)))
    sheet = comparison_sheet(comparisons)
    # The numbers of test_three_pairs_by_hand.
    assert sheet.lines[0] == ("V-LSTM + EPO - V-LSTM + SC", "ADE", "-2.000", "-4.484 to +0.484", "0.074", "3")
    assert sheet.lines[1][:2] == ("", "FDE")
    assert sheet.lines[4] == ("", "OR (JFP)", "0.0000", "equal for every seed", "", "3")
    lines = to_markdown(sheet).splitlines()
    assert lines[0] == "## rpi, test split: +EPO against +SC, seed by seed"
    assert lines[2:4] == ["| rows | metric | difference | 95 % interval | p | n |", "|:--|:--|--:|--:|--:|--:|"]
    assert lines[4] == "| V-LSTM + EPO - V-LSTM + SC | ADE | -2.000 | -4.484 to +0.484 | 0.074 | 3 |"
    first, *_, last = csv.DictReader(io.StringIO(comparisons_to_csv([comparisons])))
    assert (first["method"], first["other"], first["metric"]) == ("V-LSTM + EPO", "V-LSTM + SC", "minADE")
    assert float(first["difference"]) == -2.0
    assert float(first["p"]) == pytest.approx(0.07418, abs=1e-5)
    assert (first["n"], first["seeds"], first["reason"]) == ("3", "0 1 2", "")
    assert (last["p"], last["reason"]) == ("", "equal for every seed")


def test_a_pair_without_two_common_seeds_has_one_line(tmp_path: Path) -> None:
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.2))
    make_run(tmp_path / "a", "V-LSTM + EPO", "epo", scores(0.1))
    make_run(tmp_path / "b", "V-LSTM + EPO, no init", "epo", scores(0.1), seed=1)
    (comparisons,) = build_comparisons(build_tables(collect(tmp_path)))
    assert comparison_sheet(comparisons).lines == (
        ("V-LSTM + EPO - V-LSTM + SC", "all", "", "one common seed, two are needed", "", "1"),
        ("V-LSTM + EPO, no init - V-LSTM + SC", "all", "", "no common seed", "", "0"),
    )


def test_the_terminal_shows_a_comparison_in_80_columns(tmp_path: Path) -> None:
    pairs(tmp_path)
    (comparisons,) = build_comparisons(build_tables(collect(tmp_path)))
    text = printed(comparison_sheet(comparisons))
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
    words = text.split()
    for expected in ("-2.000", "-4.484", "+0.484", "0.074"):
        assert expected in words


def test_best_settings_are_shown_with_their_overrides(tmp_path: Path) -> None:
    for lr, value in ((0.1, 0.4), (0.01, 0.3)):
        make_run(
            tmp_path / str(lr), "V-LSTM", "marginal", scores(value), split="val", experiment="rpi/v_lstm",
            settings={"optimizer.lr": lr},
        )  # fmt: skip
    sheet = settings_sheet(best_settings(collect(tmp_path)))
    assert sheet.header == ("row", "setting", "minSADE", "n", "of")
    assert sheet.lines == (("V-LSTM", "experiment=rpi/v_lstm optimizer.lr=0.01", "0.300", "1", "2"),)
    assert "optimizer.lr=0.01" in printed(sheet)
    assert settings_sheet([]).lines == ()


def test_csv_has_the_provenance_of_every_number(tmp_path: Path) -> None:
    pairs(tmp_path)
    records = list(csv.DictReader(io.StringIO(to_csv(build_tables(collect(tmp_path))))))
    assert len(records) == 2 * 6
    epo = next(r for r in records if r["method"] == "V-LSTM + EPO" and r["metric"] == "minSADE")
    assert (epo["n"], float(epo["mean"]), float(epo["std"]), float(epo["paper"])) == ("3", 2.0, 1.0, 0.03)
    assert float(epo["difference"]) == 2.0 - 0.03
    assert (epo["data_digest"], epo["commits"]) == ("abc", "0123456789abcdef")
    assert epo["commands"].split("; ") == [f"epo train experiment=rpi/v_lstm_epo seed={seed}" for seed in range(3)]
    assert len({record["row"] for record in records}) == 2
    single = next(r for r in records if r["metric"] == "overlap_authors")
    assert (single["paper"], single["difference"]) == ("", "")


def test_a_score_of_fewer_seeds_than_the_row_says_their_number(tmp_path: Path) -> None:
    for seed, own in enumerate(({"own/near": 0.2}, {"own/near": 0.4}, {})):
        make_run(tmp_path / str(seed), "V-LSTM + EPO", "epo", scores(0.1) | own, seed=seed)
    main, further = build_tables(collect(tmp_path))
    assert to_markdown(further).splitlines()[-1] == "| V-LSTM + EPO | 3 | 0.300 ± 0.141 (n=2) |"
    assert "(n=2)" in to_latex(further)
    assert "n=2" in printed(further)
    assert legend([further]).endswith("over n seeds. A cell with n=... is of those seeds alone that have the score.")
    assert "n=" not in to_markdown(main)
    assert "of those seeds alone" not in legend([main])


def test_the_legend_of_one_seed_of_several_begins_with_a_sentence(tmp_path: Path) -> None:
    for seed, own in enumerate(({"own/near": 0.2}, {})):
        make_run(tmp_path / str(seed), "V-LSTM + EPO", "epo", scores(0.1) | own, seed=seed)
    _, further = build_tables(collect(tmp_path))
    assert legend([further]) == "A cell with n=... is of those seeds alone that have the score."


def test_markdown_titles_are_escaped(tmp_path: Path) -> None:
    make_run(tmp_path, "a|b *c* <u> `d` [e]", "epo", scores(0.1))
    row = to_markdown(build_tables(collect(tmp_path))[0]).splitlines()[4]
    assert row.startswith(r"| a\|b \*c\* &lt;u> \`d\` \[e\] | 1 |")


def test_titles_are_escaped_for_the_terminal(tmp_path: Path) -> None:
    make_run(tmp_path, "[red]x[/] [/nothing]", "epo", scores(0.1))
    (table,) = build_tables(collect(tmp_path))
    console = Console(file=io.StringIO(), width=160)
    console.print(to_rich(table))
    assert "[red]x[/] [/nothing]" in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((0.0, "0.000"), (-0.0004, "-0.00040"), (0.00042, "+0.00042"), (-9e-7, "0.000")),
        *((-0.25, "-0.250"), (0.25, "+0.250"), (math.nan, "-")),
    ],
)
def test_differences_have_a_sign_unless_they_are_zero(value: float, text: str) -> None:
    assert signed(value, 3) == text


@pytest.mark.parametrize(
    ("mean", "deviation", "text"),
    [
        (0.171, 2.5e-6, "0.171 ± 0.000"),
        (0.0002, 6.1e-5, "0.00020 ± 0.00006"),
        (0.0, 0.0, "0.000 ± 0.000"),
        (math.nan, math.nan, "- ± -"),
    ],
)
def test_small_means_have_two_digits_and_deviations_as_many_decimals(mean: float, deviation: float, text: str) -> None:
    assert own_text(Cell(mean, deviation), Column("minSADE", "SADE")) == text


def test_no_table_of_a_terminal_loses_the_names_of_its_rows() -> None:
    columns = [Column(f"m{place}", f"metric {place}") for place in range(12)]
    table = RichTable()
    for name in ("method", *(column.label for column in columns)):
        table.add_column(name, no_wrap=name != "method")
    table.add_row("a very long name of a method", *("0.123" for _ in columns))
    console = Console(file=io.StringIO(), width=least_width(table))
    assert console.width > 80
    console.print(table)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "a very long name" in printed
    assert printed.count("0.123") == len(columns)


@given(st.floats(-1e6, 1e6))
def test_signed_numbers_are_read_back(value: float) -> None:
    assert float(signed(value, 4)) == pytest.approx(value, abs=0.5001e-4)


def test_small_p_values_are_not_printed_as_zero() -> None:
    assert [p_text(p) for p in (0.5, 0.0712, 0.001, 0.00099, 0.0)] == ["0.500", "0.071", "0.001", "< 0.001", "< 0.001"]


def test_rows_are_ranked_by_the_relative_gap_and_by_no_number_in_units_of_their_own() -> None:
    ranked = ("minSADE", "overlap_jfp", "nash_gap_relative")
    own = ("nash_gap", "gradient_norm", "energy_solved", "pair_effect", "executed/pair_effect", "true_pair_rank")
    assert [Column(metric, "").ranked for metric in (*ranked, *own)] == [True] * 3 + [False] * 6
