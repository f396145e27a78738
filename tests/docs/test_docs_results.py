"""The committed results files are whole and small, and the numbers on the pages are theirs."""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from statistics import fmean, stdev

import pytest
from scipy.stats import t as student

from epo_lightning.experiment.config.settings import ReportSettings
from epo_lightning.experiment.report import report
from epo_lightning.report import build_tables
from epo_lightning.report.results import read_results
from epo_lightning.report.runs import EvaluatedRun, read_other, read_parts
from epo_lightning.report.tables import distinct

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "results").glob("*.json"))
PAGE = (ROOT / "docs" / "game.md").read_text(encoding="utf-8")


def numbers(line: str) -> list[str]:
    """The cells of a table's line without the first one, in plain text."""
    return [cell.strip().replace("*", "") for cell in line.split("|")[2:-1]]


def interval(values: list[float], digits: int = 3) -> str:
    """A mean with its 95 % interval (Student's t), as the pages print it."""
    half = student.ppf(0.975, len(values) - 1) * stdev(values) / sqrt(len(values))
    mean = fmean(values)
    low, middle, high = (f"{v:+.{digits}f}".replace("0.", ".", 1) for v in (mean - half, mean, mean + half))
    return f"{middle} ({low} to {high})"


def line_of(start: str, place: int = 0) -> list[str]:
    return numbers([line for line in PAGE.splitlines() if line.startswith(start)][place])


def short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("0.", ".", 1) if value < 1 else f"{value:.{digits}f}"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_committed_results_file_is_whole_small_and_without_folders_of_a_machine(file: Path) -> None:
    report = read_results(file)
    assert report.runs
    assert file.stat().st_size < 1_000_000
    assert str(file.relative_to(ROOT)) in (ROOT / "docs" / "tables" / "index.md").read_text(encoding="utf-8")
    text = file.read_text(encoding="utf-8")
    assert not any(f"/{folder}/" in text for folder in ("tmp", "home", "root", "work"))
    for run in report.runs:
        assert run.record["command"].startswith("epo train ")
        assert len(run.record["git_commit"]) == 40
        assert run.record["data_digest"]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_tables_and_figures_are_rebuilt_from_a_results_file_byte_for_byte(file: Path, tmp_path: Path) -> None:
    committed = ROOT / "docs" / "tables" / file.stem
    report(ReportSettings(results=str(file), out=str(tmp_path)))
    shown = {path.relative_to(committed) for path in committed.rglob("*.*")}
    assert shown == {path.relative_to(tmp_path) for path in (tmp_path / "results.md", *tmp_path.glob("figures/*"))}
    for path in shown:
        assert (committed / path).read_bytes() == (tmp_path / path).read_bytes(), f"{path}: make tables writes it again"


def test_the_page_has_the_scores_of_the_inferred_game() -> None:
    rows = {row.title: row for row in distinct(build_tables(read_results(ROOT / "results" / "game.json").evaluated))}
    for title, start, digits in (
        ("V-LSTM + EPO, game", "| V-LSTM + EPO, game |", 5),
        ("V-LSTM + EPO, game, S = 2", "| the same energy, refined: S = 2", 4),
        ("V-LSTM + SC, relaxed", "| V-LSTM + SC, relaxed |", 4),
    ):
        cells = [rows[title].cells[metric] for metric in ("minSADE", "minSFDE")]
        shown = [f"{short(cell.mean, digits)} ± {short(cell.deviation or 0, digits)}" for cell in cells]
        assert line_of(start)[:2] == shown, title


def test_the_page_has_the_scores_of_the_refined_game() -> None:
    report = read_results(ROOT / "results" / "game_refined.json")
    rows = {row.title: row for row in distinct(build_tables(report.evaluated))}
    for title, start, place in (
        ("V-LSTM + EPO, game, refined by S = 2", "| V-LSTM + EPO, game, refined by S = 2 |", 0),
        ("V-LSTM + EPO, game, refined by S = 2, no pair", "| the same without its pair term, trained so |", 1),
    ):
        cells = [rows[title].cells[metric] for metric in ("minSADE", "minSFDE")]
        shown = [f"{short(cell.mean, 4)} ± {short(cell.deviation or 0, 4)}" for cell in cells]
        assert line_of(start, place)[:2] == shown, title


def of_dense_highways() -> dict[str, dict[int, dict[str, float]]]:
    """The scores on a tenth of the test split by row and seed."""
    found: dict[str, dict[int, dict[str, float]]] = {}
    for run in read_results(ROOT / "results" / "highway_sim_dense_equilibrium.json").runs:
        for one, _ in read_other(run):
            found.setdefault(one.experiment.removeprefix("highway/"), {})[one.seed] = dict(one.metrics)
    return found


ROWS = {"EPO, solved": "epo_equilibrium", "EPO, solved, without pair term": "epo_equilibrium_no_pair", "SC": "sc"}


@pytest.mark.parametrize(("backbone", "name"), [("v_lstm", "V-LSTM"), ("vibes", "VIBES"), ("hivt_m", "HiVT-M")])
@pytest.mark.parametrize("row", ROWS)
def test_the_page_has_the_scores_of_solved_games_on_highways(backbone: str, name: str, row: str) -> None:
    runs = of_dense_highways()[f"{backbone}_{ROWS[row]}"]
    assert sorted(runs) == [0, 1, 2]
    for place, subset in enumerate(("interactive/", "")):
        shown = line_of(f"| {name} + {row} |", place)
        for cell, (metric, digits, unit) in zip(
            shown, (("minSADE", 3, 1), ("minSFDE", 2, 1), ("overlap_jfp", 1, 100), ("minSADE_1", 2, 1)), strict=False
        ):
            values = [unit * metrics[subset + metric] for metrics in runs.values()]
            assert cell == f"{short(fmean(values), digits)} ± {short(stdev(values), digits)}", (row, metric)


@pytest.mark.parametrize(
    ("words", "other"), [("its twin without pair term", "epo_equilibrium_no_pair"), ("+ SC", "sc")]
)
def test_the_page_has_the_paired_differences_over_all_backbones(words: str, other: str) -> None:
    scores = of_dense_highways()
    shown = line_of(f"| all nine: solved - {words} |")
    for cell, (metric, digits) in zip(shown, (("interactive/minSADE", 3), ("interactive/minSFDE", 2)), strict=False):
        found = [
            scores[f"{backbone}_epo_equilibrium"][seed][metric] - scores[f"{backbone}_{other}"][seed][metric]
            for backbone in ("v_lstm", "vibes", "hivt_m")
            for seed in range(3)
        ]
        assert cell == interval(found, digits)


def test_the_page_of_feedback_players_has_the_scores_of_its_file() -> None:
    page = (ROOT / "docs" / "rpi.md").read_text(encoding="utf-8")
    for row in distinct(build_tables(read_results(ROOT / "results" / "rpi_feedback.json").evaluated)):
        line = next(line for line in page.splitlines() if line.startswith(f"| {row.title} |"))
        cells = [row.cells[metric] for metric in ("minSADE", "minSFDE")]
        assert numbers(line)[:2] == [f"{short(c.mean, 4)} ± {short(c.deviation or 0, 4)}" for c in cells], row.title


SIDES = ("executed/minSADE", "alternative/minSADE")


@pytest.mark.parametrize(
    ("file", "heading", "metrics"),
    [
        ("table1_rpi", "RPI, hard split", ("minSADE", "minSFDE", "minSADE_1", *SIDES, "overlap_jfp")),
        ("table1_highway", "simulated highways", ("minSADE", "minSFDE", "minSADE_1", "overlap_jfp")),
    ],
)
def test_the_page_of_the_family_has_the_scores_of_its_rows(file: str, heading: str, metrics: tuple[str, ...]) -> None:
    page = (ROOT / "docs" / "family.md").read_text(encoding="utf-8")
    lines = page.partition(f"| {heading} |")[2].splitlines()
    saved = read_results(ROOT / "results" / f"{file}.json")
    runs = [*saved.evaluated, *(part for run in saved.runs for part in read_parts(run))]
    for row in distinct(build_tables(runs)):
        line = next(line for line in lines if line.startswith(f"| {row.title.partition(',')[0]} |"))
        cells = [row.cells[metric] for metric in metrics]
        shown = [f"{short(cell.mean, 3)} ± {short(cell.deviation or 0, 3)}" for cell in cells]
        assert numbers(line)[: 1 + len(metrics)] == [str(cells[0].n), *shown], row.title


URBAN = (ROOT / "docs" / "urban.md").read_text(encoding="utf-8")
BACKBONES = ("V-LSTM", "VIBES", "HiVT-M")


def lines_of_roads() -> list[str]:
    """The lines of the section with results on urban roads."""
    return URBAN.partition("\n## Results\n")[2].partition("\n## ")[0].splitlines()


def on_roads(file: str) -> dict[str, dict[int, EvaluatedRun]]:
    """The runs of a file by title and seed, with their scores on the test split or on a part of it."""
    saved = read_results(ROOT / "results" / f"{file}.json")
    found: dict[str, dict[int, EvaluatedRun]] = {}
    for run in [*saved.evaluated, *(part for one in saved.runs for part in read_parts(one))]:
        found.setdefault(run.name, {})[run.seed] = run
    return found


def test_the_page_of_urban_scenes_has_the_scores_of_its_file() -> None:
    for title, runs in on_roads("urban").items():
        assert sorted(runs) == [0, 1, 2]
        line = next(line for line in lines_of_roads() if line.startswith(f"| {title} |"))
        metrics = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp", "minSADE_1")
        found = [[run.metrics[metric] for run in runs.values()] for metric in metrics]
        assert numbers(line)[:7] == ["3", *(f"{short(fmean(v), 3)} ± {short(stdev(v), 3)}" for v in found)], title


@pytest.mark.parametrize("unit", ["all nine pairs", "three seeds, each the mean of its backbones"])
def test_the_page_of_urban_scenes_has_the_differences_of_its_file(unit: str) -> None:
    found = on_roads("urban")
    line = next(line for line in lines_of_roads() if line.startswith(f"| +EPO - +SC, {unit} |"))
    for cell, metric in zip(numbers(line), ("minSADE", "minSFDE", "overlap_jfp"), strict=False):
        pairs = [
            [found[f"{b} + EPO"][seed].metrics[metric] - found[f"{b} + SC"][seed].metrics[metric] for b in BACKBONES]
            for seed in range(3)
        ]
        values = [fmean(pair) for pair in pairs] if unit.startswith("three") else [v for pair in pairs for v in pair]
        assert cell == interval(values)


def test_the_page_of_games_has_the_scores_of_games_of_another_class() -> None:
    rows = distinct(build_tables(read_results(ROOT / "results" / "rpi_wrong_game.json").evaluated))
    for start, label in (
        ("a margin that is not told", "clearance=null, game_horizon=82"),
        ("no final heading", "clearance=0.5, own without heading, game_horizon=82"),
        ("a margin of 0.6 m", "clearance=0.6, game_horizon=82"),
        ("a margin of 0.25 m", "clearance=0.25, game_horizon=82"),
        ("a game that ends with the forecast", "clearance=0.5, game_horizon=40"),
    ):
        row = next(row for row in rows if row.name == f"V-LSTM + EPO, game, {label}")
        cells = [row.cells[metric] for metric in ("minSADE", *SIDES)]
        assert [cell.n for cell in cells] == [3] * 3
        shown = [f"{short(cell.mean, 4)} ± {short(cell.deviation or 0, 4)}" for cell in cells]
        assert line_of(f"| {start}")[:3] == shown, start
