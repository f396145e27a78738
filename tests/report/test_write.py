"""The written report: Markdown, CSV and the terminal."""

from __future__ import annotations

import csv
import io
import math
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from rich.console import Console

from epo_lightning.files import write_json
from epo_lightning.metrics.functional.interaction import SUBSETS
from epo_lightning.registry import ConfigError
from epo_lightning.report.columns import INTERACTIVE
from epo_lightning.report.write import Report, write_report

from .page_runs import over_runtime, over_steps, rows_with_seeds, timed
from .run_folders import make_run, scores


def three_rows(folder: Path) -> None:
    make_run(folder / "m", "V-LSTM", "marginal", scores(0.3, 0.006))
    make_run(folder / "sc", "V-LSTM + SC", "scene_consistent", scores(0.1, 0.0012))
    make_run(folder / "e0", "V-LSTM + EPO", "epo", scores(0.02))
    make_run(folder / "e1", "V-LSTM + EPO", "epo", scores(0.04), seed=1)


def report(runs: Path, out: Path, **options: object) -> tuple[str, str]:
    console = Console(file=io.StringIO(), width=160)
    markdown = write_report(Report.of_folder(runs), out, console=console, **options)  # type: ignore[arg-type]
    return markdown, console.file.getvalue()  # type: ignore[attr-defined]


def test_markdown_equals_a_hand_written_table(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    markdown, _ = report(tmp_path / "runs", tmp_path / "out", preface="A reduced budget.")
    assert (tmp_path / "out" / "results.md").read_text() == markdown
    lines = markdown.splitlines()
    assert "| method | n | ADE | FDE | SADE | SFDE | OR (JFP) | OR (authors) |" in lines
    assert (
        "| V-LSTM | 1 | 0.300 (0.12, +0.180) | 0.300 (0.20, +0.100) | 0.300 (0.13, +0.170) | 0.300 (0.23, +0.070) | "
        "0.0060 (0.006, 0.0000) | 0.0060 |" in lines
    )
    assert (
        "| V-LSTM + EPO | 2 | **0.030 ± 0.014** (0.03, 0.000) | **0.030 ± 0.014** (0.08, -0.050) | "
        "**0.030 ± 0.014** (0.03, 0.000) | **0.030 ± 0.014** (0.08, -0.050) | **0.0000 ± 0.0000** (0.000, 0.0000) | "
        "**0.0000 ± 0.0000** |" in lines
    )
    assert "<u>0.100</u> (0.04, +0.060)" in markdown
    assert lines.index("A reduced budget.") < lines.index("## rpi, test split")
    assert "| V-LSTM + EPO | rpi, test split | reduced | 0, 1 | 0123456789 | abc | 1234 | 2 |" in lines
    assert f"- `{tmp_path}/runs/e1`: `epo train experiment=None seed=1`" in lines
    assert f"Written by `epo report runs={tmp_path}/runs`." in lines


def test_terminal_shows_whole_numbers_in_80_columns(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    subsets = {f"{part}/{name}": x for part in ("executed", "alternative") for name, x in scores(0.25).items()}
    for seed in (0, 1):
        make_run(
            tmp_path / f"runs/g{seed}", "V-LSTM + EPO, goal known", "epo", scores(0.5) | subsets, seed=seed, goal="all"
        )
    console = Console(file=io.StringIO(), width=80)
    write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=console)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "…" not in printed
    lines = [line.split() for line in printed.splitlines()]
    row = lines.index(["V-LSTM", "+", "EPO", "2", "0.030", "0.030", "0.030", "0.030", "0.0000", "0.0000"])
    assert lines[row + 1] == ["±0.014"] * 4 + ["±0.0000"] * 2
    assert lines[row + 2] == ["paper", "0.03", "0.08", "0.03", "0.08", "0.000"]
    assert lines[row + 3] == ["ours", "-", "paper", "0.000", "-0.050", "0.000", "-0.050", "0.0000"]


def test_csv_holds_every_score_once_in_full_precision(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    extra = scores(1 / 3) | {"executed/minSADE": 0.25, "executed/minSFDE": 0.5, "executed/overlap_jfp": 0.0}
    make_run(tmp_path / "runs" / "other", "Other", "marginal", extra)
    report(tmp_path / "runs", tmp_path / "out")
    records = list(csv.DictReader((tmp_path / "out" / "results.csv").open()))
    assert len(records) == 4 * 6 + 3
    by_key = {(record["method"], record["metric"]): record for record in records}
    assert len(by_key) == len(records)
    assert float(by_key["Other", "minADE"]["mean"]) == 1 / 3
    assert by_key["Other", "executed/minSADE"]["mean"] == "0.25"
    assert by_key["V-LSTM + EPO", "minSADE"]["seeds"] == "0 1"
    assert by_key["V-LSTM + EPO", "minSADE"]["paper"] == "0.03"


def test_figures_are_linked_from_the_report(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    picture = tmp_path / "out" / "figures" / "joint.png"
    picture.parent.mkdir(parents=True)
    Image.new("RGB", (30, 20)).save(picture)
    markdown, _ = report(tmp_path / "runs", tmp_path / "out", figures=[picture])
    assert "![joint](figures/joint.png)" in markdown


def test_the_legend_and_captions_explain_only_shown_content(tmp_path: Path) -> None:
    three_rows(tmp_path / "ours")
    make_run(tmp_path / "other" / "m", "V-LSTM", "marginal", scores(0.3), data="highway_sim")
    whole = report(tmp_path / "ours", tmp_path / "out")[0], (tmp_path / "out" / "results.tex").read_text()
    short = report(tmp_path / "other", tmp_path / "out")[0], (tmp_path / "out" / "results.tex").read_text()
    for text, other in zip(whole, short, strict=True):
        for words in ("the paper's value and ours minus the paper's", "ample standard deviation", "the second best"):
            assert words in text
            assert words not in other
        assert "OR (authors) counts overlapping pairs" in other
    assert "seeds; in brackets, the paper's" in whole[0]
    assert "$n$ seeds; below, the paper's" in whole[1]


def test_captions_carry_the_caveat_of_the_preface(tmp_path: Path) -> None:
    rows_with_seeds(tmp_path / "runs")
    for preface, count in (("**Budget: reduced.**", 4), ("", 0)):
        report(tmp_path / "runs", tmp_path / "out", preface=preface)
        captions = [
            line for line in (tmp_path / "out/results.tex").read_text().splitlines() if line.startswith("\\caption")
        ]
        assert len(captions) == 4
        assert sum("\\textbf{Budget: reduced, " in line and "does not reproduce" in line for line in captions) == count


def test_the_terminal_ends_with_what_is_left_out(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    assert "left out" not in report(tmp_path / "runs", tmp_path / "out")[1]
    whole = Report.of_folder(tmp_path / "runs")
    left_out = (("a", "failed: ValueError: it: broke"), ("b", "failed"), ("c", "not evaluated yet: epo evaluate run=c"))
    for count, words in ((3, "3 runs left out: 2 failed, 1 not evaluated yet"), (1, "1 run left out: 1 failed")):
        console = Console(file=io.StringIO(), width=80)
        write_report(replace(whole, left_out=left_out[:count]), tmp_path / "out", console=console)
        printed = console.file.getvalue().rstrip()  # type: ignore[attr-defined]
        assert printed.splitlines()[-1] == f"{words} (see How this was made in results.md)"


def test_latex_and_comparisons_are_written_to_files(tmp_path: Path) -> None:
    rows_with_seeds(tmp_path / "runs")
    report(tmp_path / "runs", tmp_path / "out")
    latex = (tmp_path / "out" / "results.tex").read_text()
    assert latex.count("\\begin{tabular}") == 4  # all rows, initial and solved, costs, comparisons
    compared = list(csv.DictReader((tmp_path / "out" / "comparisons.csv").open()))
    assert {(line["method"], line["other"], line["n"]) for line in compared} == {("V-LSTM + EPO", "V-LSTM + SC", "3")}


def test_a_search_shows_its_best_setting_or_the_reason_for_none(tmp_path: Path) -> None:
    for lr, value in ((0.001, 0.05), (0.0003, 0.04)):
        for seed in range(2):
            options: dict[str, Any] = {"seed": seed, "split": "val", "settings": {"optimizer.lr": lr}}
            make_run(tmp_path / "runs" / f"{lr}-s{seed}", "V-LSTM + EPO", "epo", scores(value), **options)
    assert "optimizer.lr=0.0003 | 0.040" in report(tmp_path / "runs", tmp_path / "out")[0]
    for run in (tmp_path / "runs").glob("*-s1"):
        metrics = scores(math.nan)
        write_json(run / "metrics-val.json", {"data_digest": "abc", "split": "val", "metrics": metrics})
    markdown, _ = report(tmp_path / "runs", tmp_path / "out")
    assert "No setting was chosen: no setting of 'V-LSTM + EPO' has finite scores" in markdown


def test_a_sweep_over_steps_has_no_best_setting(tmp_path: Path) -> None:
    over_steps(tmp_path / "runs")
    assert "Best settings" not in report(tmp_path / "runs", tmp_path / "out")[0]


def test_runs_with_times_alone_can_be_reported(tmp_path: Path) -> None:
    over_runtime(tmp_path / "runs")
    markdown, _ = report(tmp_path / "runs", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["figures", "index.html", "results.md"]
    assert "![runtime](figures/runtime.png)" in markdown
    folder = tmp_path / "runs" / "N12-S8-M4"
    assert f"- `{folder}`: `epo train experiment=None seed=0`" in markdown


def test_left_out_runs_and_changed_code_are_reported(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    assert "Left out" not in report(tmp_path / "runs", tmp_path / "out")[0]
    late = make_run(tmp_path / "runs" / "late", "Late", "epo", None)
    make_run(tmp_path / "runs" / "m", "V-LSTM", "marginal", scores(0.3)).update(git_commit="0123456789abcdef+")
    markdown, _ = report(tmp_path / "runs", tmp_path / "out")
    assert f"- `{late.path}`: interrupted" in markdown
    late.update(status="finished")
    assert (
        f"- `{late.path}`: not evaluated yet: epo evaluate run={late.path}"
        in report(tmp_path / "runs", tmp_path / "out")[0]
    )
    assert "| V-LSTM | rpi, test split | reduced | 0 | 0123456789+ | abc | 1234 | 1 |" in markdown


def test_a_failed_report_overwrites_nothing(tmp_path: Path) -> None:
    three_rows(tmp_path / "runs")
    before, _ = report(tmp_path / "runs", tmp_path / "out")
    make_run(tmp_path / "runs" / "odd", "Odd", "epo", scores(0.1), budget="paper")
    with pytest.raises(ConfigError, match="budget"):
        report(tmp_path / "runs", tmp_path / "out")
    assert (tmp_path / "out" / "results.md").read_text() == before
    with pytest.raises(ConfigError, match="no run"):
        report(tmp_path / "out", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_full_disk_leaves_no_partial_file(tmp_path: Path) -> None:
    rows_with_seeds(tmp_path / "runs")
    report(tmp_path / "runs", tmp_path / "before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    largest = (tmp_path / "before" / "index.html").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest - 1000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            report(tmp_path / "runs", tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    left = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert tmp_path / "out" / "index.html" not in left
    for path in left:
        assert path.read_bytes() == (tmp_path / "before" / path.relative_to(tmp_path / "out")).read_bytes()


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    rows_with_seeds(tmp_path / "runs")
    for name in ("one", "two"):
        report(tmp_path / "runs", tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file())
    assert len(files) == 6
    for path in files:
        assert (tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes()


def test_the_subset_with_a_table_of_its_own_is_one_of_the_metrics() -> None:
    assert INTERACTIVE in SUBSETS


def test_a_run_that_was_only_timed_hides_no_scores_of_others(tmp_path: Path) -> None:
    timed(tmp_path, 4, 2, 5, 0.001)
    assert Report.of_folder(tmp_path).evaluated == (), "times alone are worth a report"
    make_run(tmp_path / "scored", "V-LSTM", "marginal", scores(0.3))
    assert [run.metrics["minSADE"] for run in Report.of_folder(tmp_path).evaluated] == [0.3]
