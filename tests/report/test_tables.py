"""Tables of run folders: means, ranks, the paper's values, and refusal of runs that are not comparable."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from epo_lightning.files import write_json
from epo_lightning.registry import ConfigError
from epo_lightning.report.notes import of_different_batches
from epo_lightning.report.paper import papers_name
from epo_lightning.report.render import legend
from epo_lightning.report.rows import Cell
from epo_lightning.report.runs import collect, data_name
from epo_lightning.report.tables import build_tables
from report.table_rows import rows_of

from .run_folders import make_run, scores


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


def test_an_ablation_has_the_papers_values_of_its_own_and_not_those_of_the_main_row(tmp_path: Path) -> None:
    for experiment in ("exid/v_lstm_epo", "exid/v_lstm_epo_no_init"):
        make_run(tmp_path / experiment, experiment, "epo", scores(0.9), data="exid", experiment=experiment)
    papers = {name: row.cells["minADE"].paper for name, row in rows_of(tmp_path).items()}
    assert papers == {"exid/v_lstm_epo": 0.80, "exid/v_lstm_epo_no_init": 0.89}


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
