"""From run folders to rows: means, ranks, the paper's values, and what must not stand in one table."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from epo_lightning.registry import ConfigError
from epo_lightning.report.runs import collect
from epo_lightning.report.tables import Cell, Row, build_tables

from .run_folders import make_run, scores


def rows_of(folder: Path) -> dict[str, Row]:
    return {row.name: row for row in build_tables(collect(folder))[0].rows}


def paper_table(folder: Path) -> None:
    """Four rows, two seeds for the last."""
    make_run(folder / "cv", "Constant velocity", "constant_velocity", scores(0.5, 0.1))
    make_run(folder / "m", "V-LSTM", "marginal", scores(0.3, 0.006))
    make_run(folder / "sc", "V-LSTM + SC", "scene_consistent", scores(0.1, 0.001))
    make_run(folder / "epo" / "s0", "V-LSTM + EPO", "epo", scores(0.04))
    make_run(folder / "epo" / "s1", "V-LSTM + EPO", "epo", scores(0.06), seed=1)


def test_mean_deviation_and_order_by_hand(tmp_path: Path) -> None:
    paper_table(tmp_path)
    rows = rows_of(tmp_path)
    assert list(rows) == ["V-LSTM", "V-LSTM + SC", "V-LSTM + EPO", "Constant velocity"]
    cell = rows["V-LSTM + EPO"].cells["minSADE"]
    assert cell.mean == pytest.approx(0.05)
    assert cell.deviation == pytest.approx(0.02 / math.sqrt(2))
    assert rows["V-LSTM + EPO"].seeds == [0, 1]
    assert rows["V-LSTM"].cells["minSADE"].deviation is None


def test_best_and_second_of_the_group_and_the_papers_values(tmp_path: Path) -> None:
    paper_table(tmp_path)
    rows = rows_of(tmp_path)
    best = rows["V-LSTM + EPO"].cells["minSFDE"]
    assert (best.rank, best.paper) == (1, 0.08)
    assert rows["V-LSTM + SC"].cells["minSFDE"] == Cell(0.1, None, 2, 0.11)
    assert rows["V-LSTM"].cells["minADE"] == Cell(0.3, None, None, 0.12)
    assert rows["V-LSTM"].cells["overlap_jfp"].paper == 0.006
    assert rows["V-LSTM"].cells["overlap_authors"].paper is None
    assert rows["Constant velocity"].cells["minSADE"] == Cell(0.5, None, None, None)


def test_what_prints_the_same_ranks_the_same(tmp_path: Path) -> None:
    for name, value in (("a", 0.10001), ("b", 0.10002), ("c", 0.2), ("d", math.nan)):
        make_run(tmp_path / name, name, "epo", scores(value))
    ranks = {name: row.cells["minADE"].rank for name, row in rows_of(tmp_path).items()}
    assert ranks == {"a": 1, "b": 1, "c": 2, "d": None}


def test_rows_that_know_more_are_ranked_apart_and_have_no_paper_value(tmp_path: Path) -> None:
    paper_table(tmp_path)
    make_run(tmp_path / "g1", "V-LSTM + SC, goal known", "scene_consistent", scores(0.03), goal="all")
    make_run(tmp_path / "g2", "V-LSTM + EPO, goal known", "epo", scores(0.02), goal="all")
    rows = rows_of(tmp_path)
    assert rows["V-LSTM + EPO"].cells["minSADE"].rank == 1
    assert rows["V-LSTM + EPO, goal known"].cells["minSADE"] == Cell(0.02, None, 1, None)
    assert list(rows)[3:] == ["V-LSTM + SC, goal known", "V-LSTM + EPO, goal known", "Constant velocity"]


def test_subsets_and_initial_strategies_have_tables_of_their_own(tmp_path: Path) -> None:
    subsets = {
        f"{name}/{metric}": value for name in ("executed", "alternative") for metric, value in scores(0.2).items()
    }
    make_run(tmp_path / "m", "V-LSTM", "marginal", scores(0.3) | subsets)
    initial = {"initial/minSADE": 0.7, "initial/minSFDE": 0.9}
    make_run(tmp_path / "e", "V-LSTM + EPO", "epo", scores(0.1) | subsets | initial)
    main, apart, solved = build_tables(collect(tmp_path))
    assert [column.label for column in apart.columns] == [
        *("executed SADE", "executed SFDE"),
        *("alternative SADE", "alternative SFDE"),
    ]
    assert len(main.rows) == len(apart.rows) == 2
    assert [row.name for row in solved.rows] == ["V-LSTM + EPO"]
    assert [solved.rows[0].cells[column.metric].mean for column in solved.columns] == [0.7, 0.1, 0.9, 0.1]


def test_splits_are_tables_apart(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3), digest="abc")
    make_run(tmp_path / "b", "V-LSTM", "marginal", scores(0.2), digest="xyz", split="val")
    assert [(table.title, len(table.rows)) for table in build_tables(collect(tmp_path))] == [
        ("rpi, test split", 1),
        ("rpi, val split", 1),
    ]


@pytest.mark.parametrize(
    ("differing", "message"),
    [
        ({"digest": "xyz"}, r"data_digest \(evaluated on\) \(abc: V-LSTM; xyz: V-LSTM \+ EPO\)"),
        ({"trained_digest": "xyz"}, r"data_digest \(trained on\) \(abc: V-LSTM; xyz: V-LSTM \+ EPO\)"),
        ({"budget": "paper"}, r"budget \(paper: V-LSTM \+ EPO; reduced: V-LSTM\)"),
    ],
)
def test_what_cannot_be_compared_is_refused(tmp_path: Path, differing: dict[str, str], message: str) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    make_run(tmp_path / "b", "V-LSTM + EPO", "epo", scores(0.1), **differing)
    with pytest.raises(ConfigError, match=message):
        build_tables(collect(tmp_path))


def test_constant_velocity_has_no_budget_but_the_same_test_data(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    make_run(tmp_path / "b", "CV", "constant_velocity", scores(0.3), budget="paper", trained_digest="xyz")
    assert len(rows_of(tmp_path)) == 2
    make_run(tmp_path / "b", "CV", "constant_velocity", scores(0.3), digest="xyz")
    with pytest.raises(ConfigError, match="evaluated on"):
        rows_of(tmp_path)


def test_a_seed_counts_once(tmp_path: Path) -> None:
    for name in ("a", "b"):
        make_run(tmp_path / name, "V-LSTM", "marginal", scores(0.3), seed=4)
    with pytest.raises(ConfigError, match=r"'V-LSTM' has seed 4 twice, .*a and .*b"):
        build_tables(collect(tmp_path))


def test_collect_says_what_is_missing_and_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no folder .*nowhere.*epo train"):
        collect(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"no run in or below .*epo train"):
        collect(tmp_path)
    make_run(tmp_path / "a", "V-LSTM", "marginal", None)
    with pytest.raises(ConfigError, match=rf"none of the 1 runs.*epo evaluate runs={tmp_path}"):
        collect(tmp_path)
    make_run(tmp_path / "b", "V-LSTM", "marginal", scores(0.3))
    assert [run.path.name for run in collect(tmp_path)] == ["b"]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("metrics.json", '{"metrics": {', "metrics.json is not JSON"),
        ("metrics.json", '{"metrics": {"minADE": 1.0}}', "metrics.json has no entry data_digest"),
        ("metrics.json", '{"data_digest": "a", "metrics": {"minADE": "x"}}', "metrics must be numbers"),
        ("config.yaml", "a: [", "config.yaml is not YAML"),
        ("config.yaml", "title: x", "config.yaml has no entry seed"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, file: str, content: str, message: str) -> None:
    run = make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    (run.path / file).write_text(content)
    with pytest.raises(ConfigError, match=message):
        collect(tmp_path)
