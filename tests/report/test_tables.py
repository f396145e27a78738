"""Tables of run folders: means, ranks, the paper's values, and refusal of runs that are not comparable."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from epo_lightning.identity import identity, row_identity
from epo_lightning.registry import ConfigError
from epo_lightning.report import Report, write_report
from epo_lightning.report.paper import papers_name
from epo_lightning.report.render import legend
from epo_lightning.report.rows import Cell, Row, of_different_batches, of_different_code, untaught
from epo_lightning.report.runs import collect, data_name, find_runs
from epo_lightning.report.statistics import build_comparisons
from epo_lightning.report.tables import build_tables, distinct, over_folds
from epo_lightning.run_folder import RunFolder, write_json

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


def test_mean_deviation_and_order_equal_hand_computed_values(tmp_path: Path) -> None:
    paper_table(tmp_path)
    rows = rows_of(tmp_path)
    assert list(rows) == ["V-LSTM", "V-LSTM + SC", "V-LSTM + EPO", "Constant velocity"]
    cell = rows["V-LSTM + EPO"].cells["minSADE"]
    assert cell.mean == pytest.approx(0.05)
    assert cell.deviation == pytest.approx(0.02 / math.sqrt(2))
    assert rows["V-LSTM + EPO"].seeds == [0, 1]
    assert rows["V-LSTM"].cells["minSADE"].deviation is None


def test_players_of_another_kind_are_another_data_set_beside_the_same_values_of_the_paper(tmp_path: Path) -> None:
    for number, players in enumerate(("potential", "feedback")):
        make_run(
            tmp_path / players, "V-LSTM", "marginal", scores(0.3), settings={"data.solver": players}, digest=str(number)
        )
    tables = {table.data: table for table in build_tables(collect(tmp_path))}
    assert set(tables) == {"rpi", "rpi, feedback players"}
    assert [table.rows[0].cells["overlap_jfp"].paper for table in tables.values()] == [0.006, 0.006]
    assert data_name({"name": "rpi", "solver": None, "split": "hard"}) == "rpi_hard"
    second = data_name({"name": "rpi", "solver": "feedback", "recipe": 2})
    assert second == "rpi, recipe 2, feedback players"
    assert papers_name(second) == papers_name("rpi, recipe 2") == papers_name("rpi, feedback players") == "rpi"
    assert data_name({"name": "rpi", "recipe": 1}) == papers_name("rpi") == "rpi"


def test_rows_that_the_paper_does_not_have_follow_in_the_order_of_the_runs(tmp_path: Path) -> None:
    rows = [
        *(("Zeta", "epo", "own_net"), ("V-LSTM + EPO", "epo", "v_lstm"), ("Mine", "epo", "v_lstm")),
        *(("Later", "marginal", "v_lstm"), ("HiVT", "marginal", "hivt_m"), ("VIBES", "marginal", "vibes")),
        ("Alpha", "marginal", "another_net"),
    ]
    runs = [make_run(tmp_path / title, title, name, scores(0.1), backbone=net) for title, name, net in rows]
    (table,) = build_tables(collect(runs))
    assert [row.name for row in table.rows] == ["Later", "V-LSTM + EPO", "Mine", "VIBES", "HiVT", "Zeta", "Alpha"]


def test_rows_of_one_loss_stand_together_in_the_order_of_the_runs(tmp_path: Path) -> None:
    rows = [
        *(("SC, relaxed", "scene_consistent", 0.1, "forecaster"), ("EPO, relaxed", "epo", 0.1, "objective")),
        *(("EPO", "epo", 0.0, "objective"), ("SC", "scene_consistent", 0.0, "forecaster")),
    ]
    runs = [
        make_run(tmp_path / title, title, name, scores(0.1), settings={f"{section}.relaxation": share})
        for title, name, share, section in rows
    ]
    (table,) = build_tables(collect(runs))
    assert [row.name for row in table.rows] == ["SC, relaxed", "EPO, relaxed", "SC", "EPO"]


def test_methods_that_learn_nothing_have_no_deviation_if_runs_agree(tmp_path: Path) -> None:
    for seed in range(3):
        make_run(tmp_path / f"cv{seed}", "Constant velocity", "constant_velocity", scores(0.5, 0.1 * seed), seed=seed)
        make_run(tmp_path / f"m{seed}", "V-LSTM", "marginal", scores(0.5), seed=seed)
    rows = rows_of(tmp_path)
    assert rows["Constant velocity"].cells["minSADE"] == Cell(0.5, None, None, None, 3)
    assert rows["Constant velocity"].cells["overlap_jfp"].deviation == pytest.approx(0.1)
    assert rows["V-LSTM"].cells["minSADE"].deviation == 0
    assert (rows["Constant velocity"].budget, rows["V-LSTM"].budget) == ("none", "reduced")


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


def test_the_paper_has_no_values_of_games_without_pair_terms_or_with_other_parts(tmp_path: Path) -> None:
    changes = {"paper": {}, "no pair": {"energy.pair": []}, "another": {"solver.name": "gradient_descent"}}
    for title, given_settings in changes.items():
        make_run(tmp_path / title, title, "epo", scores(0.1), settings=given_settings)
    known = {name: row.cells["minSADE"].paper is not None for name, row in rows_of(tmp_path).items()}
    assert known == {"paper": True, "no pair": False, "another": False}


def test_equal_printed_values_have_equal_ranks(tmp_path: Path) -> None:
    for name, value in (("a", 0.10001), ("b", 0.10002), ("c", 0.2), ("d", math.nan)):
        make_run(tmp_path / name, name, "epo", scores(value))
    ranks = {name: row.cells["minADE"].rank for name, row in rows_of(tmp_path).items()}
    assert ranks == {"a": 1, "b": 1, "c": 2, "d": None}


def test_rows_with_given_goals_are_ranked_separately_without_paper_values(tmp_path: Path) -> None:
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
    assert {solved.rows[0].cells[column.metric].rank for column in solved.columns} == {None}  # alone there
    assert main.rows[1].cells["minSADE"].rank == 1
    assert main.rows[1].cells["initial/minSADE"].rank is None


def test_probabilities_and_missed_alternatives_have_a_table_of_the_rows_that_were_scored(tmp_path: Path) -> None:
    apart = {f"{name}/{metric}": 0.2 for name in ("executed", "alternative", "calm") for metric in scores(0.2)}
    new = {"minSADE_1": 0.4, "minSADE_2": 0.1, "brier_minSADE": 0.35, "ECE": 0.05}
    new |= {"executed/missed": 0.0, "alternative/missed": 0.125, "executed/minSADE_1": 0.2, "calm/missed": 0.9}
    make_run(tmp_path / "old", "V-LSTM", "marginal", scores(0.3) | apart | {"minSADE_1": 0.5, "minSADE_2": 0.3})
    make_run(tmp_path / "new", "V-LSTM + EPO", "epo", scores(0.1) | apart | new)
    tables = {table.title.partition(": ")[2]: table for table in build_tables(collect(tmp_path))}
    table = tables["probabilities of the modes"]
    assert [row.name for row in table.rows] == ["V-LSTM + EPO"]
    assert {column.label: table.rows[0].cells[column.metric].mean for column in table.columns} == {
        **{"SADE, k=1": 0.4, "brier-SADE": 0.35, "ECE": 0.05},
        **{"executed SADE, k=1": 0.2, "executed missed": 0.0, "alternative missed": 0.125},
    }
    text = legend([table])
    assert "(1 - p)^2" in text
    assert "0.25 m" in text
    assert "(1 - p)^2" not in legend([tables["executed and alternative and calm apart"]])


def test_the_most_likely_mode_alone_has_no_table(tmp_path: Path) -> None:
    """It would repeat the main table: only forecasts of several modes have scores of the k most likely ones."""
    make_run(tmp_path / "one", "V-LSTM", "marginal", scores(0.3) | {"minSADE_1": 0.3})
    assert not [table for table in build_tables(collect(tmp_path)) if "most likely" in table.title]
    make_run(tmp_path / "two", "V-LSTM + EPO", "epo", scores(0.3) | {"minSADE_1": 0.4, "minSADE_2": 0.3})
    (table,) = (table for table in build_tables(collect(tmp_path)) if "most likely" in table.title)
    assert [column.metric for column in table.columns] == ["minSADE_1", "minSADE_2"]


def test_interactive_scenes_have_a_table_with_all_columns(tmp_path: Path) -> None:
    calm, interactive = (
        {f"{name}/{metric}": score for metric, score in scores(*values).items()}
        for name, values in (("calm", (0.2, 0.0)), ("interactive", (0.4, 0.1)))
    )
    make_run(tmp_path / "m", "V-LSTM", "marginal", scores(0.3) | calm | interactive)
    make_run(tmp_path / "old", "older", "marginal", scores(0.3))  # evaluated before there were subsets
    main, apart, table = build_tables(collect(tmp_path))
    assert apart.title == "rpi, test split: calm and interactive apart"
    assert table.title == "rpi, test split: interactive scenes"
    assert [column.label for column in table.columns] == [column.label for column in main.columns]
    (row,) = table.rows
    assert [row.cells[column.metric].mean for column in table.columns] == [0.4, 0.4, 0.4, 0.4, 0.1, 0.1]


def test_the_effect_of_pair_terms_is_shown_and_not_ranked(tmp_path: Path) -> None:
    for title, effect in (("game", 0.1), ("other game", 0.3)):
        values = {"pair_effect": effect, "calm/pair_effect": effect / 2, "interactive/pair_effect": 2 * effect}
        make_run(tmp_path / title, title, "epo", scores(0.1) | values)
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.3))
    (table,) = [table for table in build_tables(collect(tmp_path)) if "other agents" in table.title]
    assert table.title == "rpi, test split: effect of the other agents"
    assert [column.label for column in table.columns] == ["all scenes", "calm", "interactive"]
    assert [[row.cells[column.metric].mean for column in table.columns] for row in table.rows] == [
        [0.1, 0.05, 0.2],
        [0.3, 0.15, 0.6],
    ]
    assert {row.cells[column.metric].rank for row in table.rows for column in table.columns} == {None}
    assert "same start without its pair terms" in legend([table])
    assert "lower is better" not in legend([table])


def test_modes_that_violate_hard_constraints_are_a_table_of_the_rows_that_have_any(tmp_path: Path) -> None:
    make_run(tmp_path / "hard", "hard", "epo", scores(0.1) | {"stopped": 0.25, "calm/stopped": 0.0})
    make_run(tmp_path / "soft", "soft", "epo", scores(0.1))
    (table,) = [table for table in build_tables(collect(tmp_path)) if "hard constraints" in table.title]
    assert [column.label for column in table.columns] == ["all scenes", "calm"]
    assert [[row.cells[column.metric].mean for column in table.columns] for row in table.rows] == [[0.25, 0.0]]


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
        ({"settings": {"data.share": 0.5}}, r"data\.share \(0\.5: V-LSTM \+ EPO; null: V-LSTM\)"),
        ({"settings": {"trainer.max_epochs": 20}}, r"trainer\.max_epochs \(10: V-LSTM; 20: V-LSTM \+ EPO\)"),
        ({"settings": {"trainer.max_steps": 9}}, r"trainer\.max_steps \(9: V-LSTM \+ EPO; null: V-LSTM\)"),
        ({"settings": {"trainer.precision": "bf16"}}, r"trainer\.precision \(32-true: V-LSTM; bf16: V-LSTM \+ EPO\)"),
        ({"settings": {"callbacks.patience": 5}}, r"callbacks\.patience \(5: V-LSTM \+ EPO; null: V-LSTM\)"),
    ],
)
def test_runs_that_are_not_comparable_are_refused(tmp_path: Path, differing: dict[str, Any], message: str) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    make_run(tmp_path / "b", "V-LSTM + EPO", "epo", scores(0.1), **differing)
    with pytest.raises(ConfigError, match=message) as refused:
        build_tables(collect(tmp_path))
    assert str(tmp_path / "a") in str(refused.value)
    assert str(tmp_path / "b") in str(refused.value)


def test_parts_that_tables_compare_may_differ(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3), settings={"optimizer.lr": 0.01})
    differing = {"solver.steps": 8, "backbone.width": 64, "trainer.threads": 4, "data.root": "/elsewhere"}
    run = make_run(tmp_path / "b", "VIBES + EPO", "epo", scores(0.1), backbone="vibes", goal="all", settings=differing)
    run.update(git_commit="fedcba9876543210")
    for seed in (1, 2):
        make_run(tmp_path / f"a{seed}", "V-LSTM", "marginal", scores(0.3), seed=seed, settings={"optimizer.lr": 0.01})
    rows = rows_of(tmp_path)
    assert {name: (row.cells["minADE"].n, row.commits) for name, row in rows.items()} == {
        "V-LSTM": (3, ["0123456789abcdef"]),
        "VIBES + EPO": (1, ["fedcba9876543210"]),
    }


def test_batch_sizes_are_compared_and_noted(tmp_path: Path) -> None:
    for size in (32, 128):
        make_run(tmp_path / f"a{size}", "V-LSTM", "marginal", scores(0.3), settings={"data.batch_size": size})
    make_run(tmp_path / "b", "V-LSTM + EPO", "epo", scores(0.1))
    make_run(tmp_path / "c", "CV", "constant_velocity", scores(0.4), settings={"data.batch_size": 8})
    rows = rows_of(tmp_path)
    assert {*rows} == {"V-LSTM, batch_size=32", "V-LSTM, batch_size=128", "V-LSTM + EPO", "CV"}
    (note,) = of_different_batches([*rows.values()])
    assert "different batch sizes (32: V-LSTM, batch_size=32, V-LSTM + EPO; 128: V-LSTM, batch_size=128): after" in note
    assert of_different_batches([rows["V-LSTM, batch_size=32"], rows["V-LSTM + EPO"], rows["CV"]]) == []


def test_scores_of_different_checkpoints_are_not_compared(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    last = make_run(tmp_path / "b", "V-LSTM + EPO", "epo", None)
    write_json(last.metrics_file(), {"data_digest": "abc", "checkpoint": "last", "metrics": scores(0.1)})
    with pytest.raises(ConfigError, match=r"checkpoint \(best: V-LSTM; last: V-LSTM \+ EPO\)"):
        build_tables(collect(tmp_path))


def test_constant_velocity_has_no_budget_but_the_same_test_data(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    make_run(tmp_path / "b", "CV", "constant_velocity", scores(0.3), budget="paper", trained_digest="xyz")
    assert len(rows_of(tmp_path)) == 2
    make_run(tmp_path / "b", "CV", "constant_velocity", scores(0.3), digest="xyz")
    with pytest.raises(ConfigError, match="evaluated on"):
        rows_of(tmp_path)


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3), seed=4)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    with pytest.raises(ConfigError, match=r"'V-LSTM' has seed 4 twice, .*a and .*b are the same run"):
        build_tables(collect(tmp_path))


def test_rows_of_one_title_are_distinguished_by_their_settings(tmp_path: Path) -> None:
    for steps in (1, 12, 2):
        for seed in (0, 1):
            options: dict[str, Any] = {"seed": seed, "settings": {"solver.steps": steps}}
            make_run(tmp_path / f"{steps}-{seed}", "V-LSTM + EPO", "epo", scores(1 / steps), **options)
    make_run(tmp_path / "sc", "V-LSTM + SC", "scene_consistent", scores(0.3), settings={"optimizer.lr": 0.1})
    rows = rows_of(tmp_path)
    epo = [f"V-LSTM + EPO, steps={steps}" for steps in (1, 2, 12)]
    assert list(rows) == ["V-LSTM + SC", *epo]
    assert [rows[name].settings for name in epo] == [{"solver.steps": steps} for steps in (1, 2, 12)]
    assert {rows[name].title for name in epo} == {"V-LSTM + EPO"}
    assert [rows[name].cells["minADE"].n for name in epo] == [2, 2, 2]
    # Table 2 is of two steps.
    assert [rows[name].cells["minSADE"].paper for name in epo] == [None, 0.03, None]


def test_the_same_runs_under_two_titles_are_one_row(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    make_run(tmp_path / "b", "V-LSTM", "marginal", scores(0.3), seed=1)
    config = (tmp_path / "b" / "config.yaml").read_text().replace("title: V-LSTM", "title: Other")
    (tmp_path / "b" / "config.yaml").write_text(config)
    (row,) = rows_of(tmp_path).values()
    assert row.seeds == [0, 1]


def test_the_figure_over_steps_has_the_papers_validation_values(tmp_path: Path) -> None:
    initial = {"initial/minSADE": 0.06, "initial/minSFDE": 0.1}
    for steps in (4, 5):
        folder = tmp_path / str(steps)
        make_run(folder, "V-LSTM + EPO", "epo", scores(0.04) | initial, split="val", settings={"solver.steps": steps})
    rows = rows_of(tmp_path)
    four, five = rows["V-LSTM + EPO, steps=4"].cells, rows["V-LSTM + EPO, steps=5"].cells
    assert (four["minSADE"].paper, four["initial/minSADE"].paper, four["minADE"].paper) == (0.038, 0.065, None)
    assert four["minSADE"].difference == pytest.approx(0.04 - 0.038)
    assert (five["minSADE"].paper, five["minSADE"].difference) == (None, None)


def test_runs_of_one_row_must_have_the_same_metrics(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3) | {"minXYZ": 1.0})
    make_run(tmp_path / "b", "V-LSTM", "marginal", scores(0.3), seed=1)
    with pytest.raises(ConfigError, match=r"a was scored by minXYZ and .*b was not: epo evaluate run=.*b split=test"):
        build_tables(collect(tmp_path))


def test_runs_of_a_row_are_in_the_order_of_their_seeds_and_may_lack_metrics_of_the_game(tmp_path: Path) -> None:
    for path, seed in (("a", 2), ("b", 0), ("c", 1)):
        gap = {"nash_gap": 0.5} if seed else {}
        make_run(tmp_path / path, "V-LSTM + EPO", "epo", scores(0.1 * seed) | gap, seed=seed)
    row = rows_of(tmp_path)["V-LSTM + EPO"]
    assert [run.seed for run in row.runs] == [0, 1, 2]
    assert [run.metrics["minSADE"] for run in row.runs] == pytest.approx([0.0, 0.1, 0.2])
    assert math.isnan(row.cells["nash_gap"].mean), "not the mean of the runs that have it"
    assert row.cells["nash_gap"].deviation is None


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(0, 1e3), min_size=1, max_size=5))
def test_means_and_deviations_equal_those_of_numpy(tmp_path: Path, values: list[float]) -> None:
    folder = tmp_path / "runs"
    shutil.rmtree(folder, ignore_errors=True)
    for seed, value in enumerate(values):
        make_run(folder / str(seed), "V-LSTM", "marginal", scores(value), seed=seed)
    cell = rows_of(folder)["V-LSTM"].cells["minSADE"]
    assert cell.n == len(values)
    assert cell.mean == pytest.approx(np.mean(values))
    assert cell.difference == pytest.approx(np.mean(values) - 0.13)
    if len(values) == 1:
        assert cell.deviation is None
    else:
        assert cell.deviation == pytest.approx(np.std(values, ddof=1), abs=1e-9)


def test_every_number_has_its_command_commit_data_and_identity(tmp_path: Path) -> None:
    run = make_run(tmp_path, "V-LSTM", "marginal", scores(0.3), seed=3, experiment="rpi/v_lstm", trained_digest="t")
    (found,) = collect(tmp_path)
    assert (found.command, found.git_commit) == ("epo train experiment=rpi/v_lstm seed=3", "0123456789abcdef")
    assert (found.data_digest, found.trained_digest) == ("abc", "t")
    assert found.config == run.config()
    assert (found.identity, found.row) == (identity(run.config(), "t"), row_identity(run.config(), "t"))
    run.update(git_commit=None, versions={"epo_lightning": "0.1.0"}, row="forged")
    (found,) = collect(tmp_path)
    assert found.git_commit == "version 0.1.0"
    assert found.row == row_identity(run.config(), "t")


def test_a_configuration_that_was_changed_after_the_training_is_refused(tmp_path: Path) -> None:
    run = make_run(tmp_path, "V-LSTM", "marginal", scores(0.3))
    run.update(identity=identity(run.config(), run.record["data_digest"]))
    assert len(collect(tmp_path)) == 1
    text = run.config_file.read_text().replace("seed: 0", "seed: 1")
    run.config_file.write_text(text)
    with pytest.raises(ConfigError, match=r"config.yaml or run.json beside it was changed.*Restore the edited file"):
        collect(tmp_path)


def test_a_run_is_in_the_table_of_every_split_with_scores(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.2), split="val")
    make_run(tmp_path / "b", "V-LSTM + SC", "scene_consistent", scores(0.1), split="val")
    tables = build_tables(collect(tmp_path))
    assert [(table.split, [row.cells["minADE"].mean for row in table.rows]) for table in tables] == [
        ("test", [0.3]),
        ("val", [0.2, 0.1]),
    ]
    assert len(distinct([*tables, *tables])) == 3


def test_a_report_may_contain_chosen_runs_only(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name, name, "epo", scores(0.1)) for name in ("a", "b", "c")]
    waiting = RunFolder(tmp_path / "waiting")
    begun = make_run(tmp_path / "begun", "begun", "epo", None)
    chosen = [runs[2], waiting, begun, runs[0]]
    assert [run.name for run in collect(chosen)] == ["c", "a"]
    assert [run.path.name for run in find_runs(tmp_path)] == ["a", "b", "begun", "c"]
    with pytest.raises(ConfigError, match=r"no run of this report: .*epo train"):
        collect([])
    first = rf"epo evaluate run={begun.path} does it; before it, epo train resume={begun.path} "
    with pytest.raises(ConfigError, match=rf"none of the 2 runs of this report is evaluated: {first}"):
        collect([waiting, begun])


def test_collect_names_missing_scores_and_the_command_for_them(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no folder .*nowhere.*epo train"):
        collect(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"no run in or below .*epo train"):
        collect(tmp_path)
    make_run(tmp_path / "a", "V-LSTM", "marginal", None)
    with pytest.raises(ConfigError, match=rf"none of the 1 runs.*epo evaluate runs={tmp_path}"):
        collect(tmp_path)
    make_run(tmp_path / "b", "V-LSTM", "marginal", scores(0.3))
    assert [run.path.name for run in collect(tmp_path)] == ["b"]


AGAIN = r"epo evaluate run=.*a split=test writes it again"
COPY = r"copy the run folder again"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("metrics.json", '{"metrics": {', f"metrics.json is not JSON.*{AGAIN}"),
        ("metrics.json", "", f"metrics.json is not JSON.*{AGAIN}"),
        ("metrics.json", '{"metrics": {"minADE": 1.0}}', f"metrics.json has no entry data_digest.*{AGAIN}"),
        ("metrics.json", '{"data_digest": "a", "metrics": {"minADE": "x"}}', f"metrics must be numbers.*{AGAIN}"),
        ("metrics.json", '{"data_digest": "a", "split": "val", "metrics": {}}', f"scores of the val split.*{AGAIN}"),
        ("config.yaml", "a: [", f"config.yaml is not YAML.*{COPY}"),
        ("config.yaml", "title: x", f"config.yaml has no entry seed.*{COPY}"),
        (
            "config.yaml",
            "title: x\nseed: one",
            f"config.yaml is damaged: its entry seed must be a whole number, not 'one'.*{COPY}",
        ),
        ("config.yaml", b"title: \xff", f"config.yaml is not YAML.*{COPY}"),
        (
            "config.yaml",
            "title: x\nenergy: 5",
            f"config.yaml is damaged: its entry energy must be an object with a text `name`, .*{COPY}",
        ),
        ("run.json", '{"versions": 5}', f"run.json is damaged: its entry versions must be texts by name, .*{COPY}"),
        ("run.json", "{", f"run.json is not JSON.*{COPY}"),
        ("run.json", "{}", f"run.json has no entry data_digest.*{COPY}"),
        ("run.json", '{"data_digest": "abc"}', f"run.json has no entry command.*{COPY}"),
        ("run.json", None, f"a has no run.json.*{COPY}"),
        ("config.yaml", None, f"a has no config.yaml.*{COPY}"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, file: str, content: str | bytes | None, message: str) -> None:
    make_run(tmp_path / "b", "V-LSTM + SC", "scene_consistent", scores(0.3))
    run = make_run(tmp_path / "a", "V-LSTM", "marginal", scores(0.3))
    if content is None:
        (run.path / file).unlink()
    else:
        (run.path / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    for runs in (tmp_path, [run]):
        with pytest.raises(ConfigError) as refused:
            collect(runs)
        assert re.search(message, str(refused.value), re.DOTALL)


def test_a_run_killed_before_its_start_is_not_reported_as_damaged(tmp_path: Path) -> None:
    make_run(tmp_path / "b", "V-LSTM + SC", "scene_consistent", scores(0.3))
    (make_run(tmp_path / "a", "V-LSTM", "marginal", None).path / "run.json").unlink()
    assert [run.path.name for run in collect(tmp_path)] == ["b"]


def test_tables_and_captions_name_the_hard_split(tmp_path: Path) -> None:
    """The split is read from a run's configuration, so older runs are named as well."""
    for folder, split in (("paper", "paper"), ("hard", "hard")):
        make_run(
            tmp_path / folder, "V-LSTM", "marginal", scores(0.3), digest=split, settings={"data.split": split}
        ).update(steps=10, seconds=1.0)
    tables = build_tables(collect(tmp_path))
    assert [table.title for table in tables] == ["rpi, test split", "rpi_hard, test split"]
    paper, hard = (table.rows[0].cells["minSADE"].paper for table in tables)
    assert paper is not None
    assert hard is None, "the paper reports on its own split"
    write_report(Report.of_folder(tmp_path), tmp_path / "out", console=Console(file=io.StringIO()))
    for name in ("results.md", "results.tex", "index.html"):
        text = (tmp_path / "out" / name).read_text()
        assert "rpi_hard, test split" in text or r"rpi\_hard, test split" in text, name
    assert "Cost: rpi_hard" in (tmp_path / "out" / "results.md").read_text()


def test_errors_of_inferred_costs_are_a_table_without_ranks(tmp_path: Path) -> None:
    for name, rank in (("solved", 0.99), ("refined", 0.1)):
        run = make_run(tmp_path / name, name, "epo", scores(1.0))
        content = json.loads((run.path / "metrics.json").read_text())
        write_json(run.path / "metrics.json", {**content, "truth": {"pair_rank": rank, "pair_error": 1 - rank}})
    make_run(tmp_path / "sc", "SC", "scene_consistent", scores(1.0))
    tables = build_tables(collect(tmp_path))
    found = next(table for table in tables if table.title == "rpi, test split: inferred against true costs")
    assert [row.name for row in found.rows] == ["refined", "solved"]
    assert [column.label for column in found.columns] == ["w: rank correlation", "w: median error"]
    assert [cell.mean for cell in (row.cells["true_pair_rank"] for row in found.rows)] == [0.1, 0.99]
    assert not any(row.cells[column.metric].rank for row in found.rows for column in found.columns)


@pytest.mark.parametrize("truth", [None, [], 3, {"pair_rank": None}, {"pair_rank": "high"}])
def test_damaged_errors_of_costs_are_one_message(tmp_path: Path, truth: Any) -> None:
    run = make_run(tmp_path / "sc", "SC", "scene_consistent", scores(1.0))
    content = json.loads((run.path / "metrics.json").read_text())
    write_json(run.path / "metrics.json", {**content, "truth": truth})
    with pytest.raises(
        ConfigError, match=r"metrics.json is damaged: its entry truth must be numbers by name, not .*; epo evaluate"
    ):
        collect(tmp_path)


def test_runs_that_were_tested_on_other_recordings_are_in_tables_of_their_own(tmp_path: Path) -> None:
    for fold, test in enumerate((["a", "b"], ["c"])):
        for title, forecaster in (("V-LSTM + SC", "scene_consistent"), ("V-LSTM + EPO", "epo")):
            path = tmp_path / f"{forecaster}{fold}"
            settings = {"data.test": test}
            found = scores(0.1 if forecaster == "epo" else (0.11, 0.13)[fold])
            make_run(path, title, forecaster, found, data="square", settings=settings, digest=str(fold))
    tables = build_tables(collect(tmp_path))
    names = {table.data: [row.name for row in table.rows] for table in tables}
    both = ["V-LSTM + SC", "V-LSTM + EPO"]
    assert names == {"square, test a, b": both, "square, test c": both}
    by_fold, *_ = build_comparisons(tables)
    assert by_fold.title == "square, 2 test splits: +EPO against +SC, split by split (mean of its seeds)"
    assert [pair.differences["minSADE"].mean for pair in by_fold.pairs] == pytest.approx([-0.02])
    shutil.rmtree(tmp_path / "epo1")
    shutil.rmtree(tmp_path / "scene_consistent1")
    assert {table.data for table in build_tables(collect(tmp_path))} == {"square"}, "one test split needs no name"


def test_over_folds_rows_are_those_of_equal_settings(tmp_path: Path) -> None:
    def run(name: str, test: list[str], steps: int, value: float, split: str = "test") -> None:
        settings = {"data.test": test, "solver.steps": steps}
        digest = " ".join(sorted(test))
        make_run(tmp_path / name, "EPO", "epo", scores(value), data="s", settings=settings, digest=digest, split=split)

    run("a2", ["a"], 2, 0.1)
    run("b8", ["b", "c"], 8, 0.2)
    (table,) = over_folds(build_tables(collect(tmp_path)))
    assert {row.name: row.seeds for row in table.rows} == {"EPO, steps=2": [0], "EPO, steps=8": [1]}, "not one row"
    run("a8", ["a"], 8, 0.3)
    (table,) = over_folds(build_tables(collect(tmp_path)))
    found = {row.name: [run.metrics["minSADE"] for run in row.runs] for row in table.rows}
    assert found == {"EPO, steps=2": [0.1], "EPO, steps=8": [0.3, 0.2]}
    assert (table.data, table.title) == ("s", "s, 2 test splits")
    run("a2", ["a"], 2, 0.7, split="val")
    (table,) = over_folds(build_tables(collect(tmp_path)))
    same = {row.name: [run.metrics["minSADE"] for run in row.runs] for row in table.rows}
    assert same == found, "validation splits, which may be the same in several folds, do not count"
    run("ab", ["a", "b"], 8, 0.3)
    assert not over_folds(build_tables(collect(tmp_path))), "folds with a group in common are no cross-validation"


def test_a_test_split_beside_a_drawn_one_is_no_cross_validation(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "EPO", "epo", scores(0.1), data="s", settings={"data.test": ["a"]}, digest="a")
    make_run(tmp_path / "drawn", "EPO", "epo", scores(0.1), data="s", settings={"data.test": None}, digest="d")
    tables = build_tables(collect(tmp_path))
    assert {table.data for table in tables} == {"s", "s, test a"}
    assert not over_folds(tables)


def test_runs_whose_modes_miss_a_side_are_named(tmp_path: Path) -> None:
    for seed, share in enumerate((0.45, 0.05, 0.6)):
        metrics = {**scores(0.1), "executed/missed": 0.0, "alternative/missed": share}
        make_run(tmp_path / f"one-{seed}", "V-LSTM + EPO", "epo", metrics, seed=seed)
        taught = {**metrics, "alternative/missed": 0.1}
        make_run(tmp_path / f"other-{seed}", "V-LSTM + SC", "scene_consistent", taught, seed=seed)
        alone = {"energy.pair": [], "energy.name": "features"}
        make_run(tmp_path / f"alone-{seed}", "no pair", "epo", metrics, seed=seed, settings=alone)
        solved = {"forecaster.one_game": True}
        make_run(tmp_path / f"game-{seed}", "game", "epo", metrics, seed=seed, settings=solved)
        elsewhere = {**scores(0.1), "interactive/missed": 0.9}
        make_run(tmp_path / f"road-{seed}", "VIBES", "epo", elsewhere, seed=seed)
        make_run(tmp_path / f"cv-{seed}", "CV", "constant_velocity", metrics, seed=seed).update(parameters=0)
    rows = rows_of(tmp_path)
    assert rows["V-LSTM + EPO"].missing == [0, 2]
    (note,) = untaught(list(rows.values()))
    assert "(score `missed`): V-LSTM + EPO (rpi; 2 of 3 runs). A mode may be" in note
    assert untaught([row for name, row in rows.items() if name != "V-LSTM + EPO"]) == []


def test_runs_whose_code_was_not_recorded_are_told_apart_by_their_commits() -> None:
    def row(name: str, *runs: tuple[int, str, str]) -> Row:
        made = [SimpleNamespace(seed=s, code=c, git_commit=g, data="rpi", learned=True) for s, c, g in runs]
        return Row(name, ("", ""), tuple(made), {})  # type: ignore[arg-type]

    assert of_different_code([row("A", (0, "x", "1" * 40), (1, "x", "2" * 40)), row("B", (0, "x", "3" * 40))]) == []
    (note,) = of_different_code([row("A", (0, "", "1" * 40), (1, "x", "2" * 40)), row("B", (0, "x", "2" * 40))])
    assert "A (seed 0) at commit 1111111, whose code was not recorded; A (seed 1), B (seed 0). To train" in note
