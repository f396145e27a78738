"""What the game is worth: rows and their twins without pair terms, found by their configurations."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from epo_lightning.identity import differences
from epo_lightning.report.rows import Row, plain_rows
from epo_lightning.report.runs import collect, read_run
from epo_lightning.report.tables import build_tables
from epo_lightning.report.worth import LEGEND, build_worth, twins
from epo_lightning.report.write import Report, write_report
from epo_lightning.run_folder import RunFolder

from .run_folders import make_run, scores


def game_run(
    path: Path, title: str, pair: Sequence[str] | None, metrics: Mapping[str, float], seed: int = 0, **changes: Any
) -> RunFolder:
    """A run of a forecaster with an inferred game; runs with another pair term differ in nothing else, titles included."""
    own = {"energy.name": "features", "energy.own": ["goal"], "forecaster.note": "", "forecaster.name": "epo"}
    return make_run(path, title, "epo", metrics, seed=seed, settings=own | {"energy.pair": pair} | changes)


def slow_twins(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Twins by their definition: every two rows whose list of differences has the one key ``energy.pair``."""
    found = []
    for one in rows:
        for other in rows:
            changed = {key for key, _, _ in differences(one.runs[0].config, other.runs[0].config)} - {"seed"}
            terms = [row.runs[0].config.get("energy", {}).get("pair") for row in (one, other)]
            if changed == {"energy.pair"} and None not in terms and {*terms[1]} < {*terms[0]}:
                found.append((one.identity, other.identity))
    return found


def test_a_row_is_compared_with_its_twin_seed_by_seed(tmp_path: Path) -> None:
    without = {0: 0.20, 1: 0.40, 2: 0.60, 9: 5.0}
    for seed, value in without.items():
        game_run(tmp_path / f"no{seed}", "V-LSTM + EPO, no pair", [], scores(value, value / 10), seed)
    for seed, value in {2: 0.57, 0: 0.19, 1: 0.38}.items():
        subset = {"interactive/minSADE": value, "interactive/minSFDE": 2 * value, "interactive/overlap_jfp": 0.0}
        game_run(tmp_path / f"yes{seed}", "V-LSTM + EPO", ["proximity"], scores(value) | subset, seed)
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.1))
    (found,) = build_worth(build_tables(collect(tmp_path)))
    assert found.title == "rpi, test split: what the game is worth, seed by seed"
    (pair,) = found.pairs
    assert (pair.one.name, pair.other.name, pair.seeds) == ("V-LSTM + EPO", "V-LSTM + EPO, no pair", [0, 1, 2])
    # Differences -0.01, -0.02, -0.03: mean -0.02, standard error 0.01 / sqrt(3), and t = 4.30265 for two degrees of freedom.
    sade = pair.differences["minSADE"]
    assert (sade.n, sade.mean) == (3, pytest.approx(-0.02))
    assert (sade.low, sade.high) == (pytest.approx(-0.02 - 0.0248414, abs=1e-6), pytest.approx(0.0048414, abs=1e-6))
    assert pair.differences["overlap_jfp"].mean == pytest.approx(-0.04)
    assert [*pair.differences] == ["minSADE", "minSFDE", "overlap_jfp"]  # the twin has no scores of a subset


def test_subsets_are_compared_as_well(tmp_path: Path) -> None:
    for terms, value in ((["proximity"], 0.1), ([], 0.3)):
        for seed in (0, 1):
            subset = {f"interactive/{name}": score for name, score in scores(value * (2 + seed), 0.5 * value).items()}
            game_run(tmp_path / f"{len(terms)}-{seed}", "row", terms, scores(value) | subset, seed)
    (found,) = build_worth(build_tables(collect(tmp_path)))
    (pair,) = found.pairs
    assert [column.label for column in found.columns][3:] == [
        *("interactive SADE", "interactive SFDE", "interactive OR (JFP)"),
    ]
    assert pair.differences["interactive/minSADE"].mean == pytest.approx(((0.2 - 0.6) + (0.3 - 0.9)) / 2)
    assert pair.one.name == "row, pair=[proximity]"  # the same title: names say which is which


def test_the_twin_has_no_values_of_the_paper(tmp_path: Path) -> None:
    for pair in (["proximity"], []):
        game_run(tmp_path / str(len(pair)), "V-LSTM + EPO", pair, scores(0.1))
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.3), settings={"energy.pair": []})
    (table, *_) = build_tables(collect(tmp_path))
    paper = {row.name: row.cells["minSADE"].paper for row in table.rows}
    assert paper == {"V-LSTM + EPO, pair=[proximity]": 0.03, "V-LSTM + EPO, pair=[]": None, "V-LSTM + SC": 0.04}


def test_names_do_not_make_twins(tmp_path: Path) -> None:
    game_run(tmp_path / "a", "V-LSTM + EPO", ["proximity"], scores(0.1))
    game_run(tmp_path / "b", "V-LSTM + EPO, no pair", [], scores(0.2), 0, **{"solver.steps": 8})
    game_run(tmp_path / "c", "circles", ["circles"], scores(0.2), 0, **{"optimizer.lr": 0.1})
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.3), settings={"energy.pair": []})
    assert build_worth(build_tables(collect(tmp_path))) == []


def test_the_files_and_the_terminal_show_it(tmp_path: Path) -> None:
    for seed in range(3):
        game_run(tmp_path / f"runs/a{seed}", "game", ["proximity"], scores(0.1 + 0.01 * seed), seed)
        game_run(tmp_path / f"runs/b{seed}", "no game", [], scores(0.2 + 0.03 * seed), seed)
    console = Console(file=io.StringIO(), width=120)
    markdown = write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=console)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    line = "| game - no game | SADE | -0.120 | -0.170 to -0.070 | 0.009 | 3 |"
    assert line in markdown.splitlines()
    assert LEGEND in markdown
    assert "what the game is worth" in printed
    assert "-0.170 to -0.070" in printed
    page = (tmp_path / "out" / "index.html").read_text()
    assert 'id="what-the-game-is-worth"' in page
    assert "<td>-0.170 to -0.070</td>" in page
    assert "what the game is worth" in (tmp_path / "out" / "results.tex").read_text()
    rows = list(csv.DictReader((tmp_path / "out" / "comparisons.csv").open()))
    assert {(row["method"], row["other"]) for row in rows} == {("game", "no game")}
    assert {row["metric"] for row in rows} == {"minSADE", "minSFDE", "overlap_jfp"}


def test_a_report_without_twins_does_not_mention_it(tmp_path: Path) -> None:
    game_run(tmp_path / "runs/a", "game", ["proximity"], scores(0.1))
    markdown = write_report(Report.of_folder(tmp_path / "runs"), tmp_path / "out", console=Console(file=io.StringIO()))
    assert "worth" not in markdown
    assert "game is worth" not in (tmp_path / "out" / "index.html").read_text()


CHANGES = ("solver.steps", "energy.pair_stride", "")
"""A setting other than the pair terms that a row may have."""
pairs = st.sampled_from(
    [None, [], ["proximity"], ["clearance"], ["clearance", "proximity"], ["proximity", "clearance"]]
)
rows_of = st.lists(
    st.tuples(pairs, st.sampled_from(CHANGES), st.sampled_from(["epo", "scene_consistent"]), st.integers(0, 2)),
    max_size=9,
    unique_by=lambda entry: (tuple(entry[0]) if entry[0] is not None else None, *entry[1:]),
)


@given(rows_of)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_twins_equal_those_of_the_definition(
    tmp_path_factory: pytest.TempPathFactory, drawn: list[tuple[list[str] | None, str, str, int]]
) -> None:
    folder = tmp_path_factory.mktemp("runs")
    runs = []
    for number, (pair, change, forecaster, seed) in enumerate(drawn):
        other: dict[str, Any] = {"forecaster.name": forecaster, **({change: 4} if change else {})}
        runs.append(game_run(folder / str(number), "row", pair, scores(0.1), seed, **other))
    rows = plain_rows(evaluated for run in runs for evaluated in read_run(run))
    games = [row for row in rows if row.forecaster == "epo"]
    found = [(one.identity, other.identity) for one, other in twins(rows)]
    assert sorted(found) == sorted(slow_twins(games))
    order = [row.identity for row in rows]
    assert found == sorted(found, key=lambda pair: tuple(map(order.index, pair)))
