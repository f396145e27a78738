"""The best setting of a search: by validation scores over all seeds, with the overrides that train with it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from epo_lightning.registry import ConfigError
from epo_lightning.report.render import settings_sheet, to_markdown
from epo_lightning.report.runs import collect
from epo_lightning.report.selection import BestSetting, at_edge, best_settings

from .run_folders import make_run, scores


def search(
    folder: Path, values: dict[tuple[float, int], list[float]], title: str = "V-LSTM", split: str = "val"
) -> None:
    """Runs of learning rate x width, a score per seed."""
    experiment = f"rpi/{title.lower().replace('-', '_').replace(' + ', '_')}"
    forecaster = "scene_consistent" if "SC" in title else "marginal"
    for (lr, width), of_seeds in values.items():
        for seed, value in enumerate(of_seeds):
            make_run(
                folder / f"{title}-{lr}-{width}-{seed}",
                title,
                forecaster,
                scores(value),
                seed=seed,
                split=split,
                experiment=experiment,
                settings={"optimizer.lr": lr, "backbone.width": width},
            )


def best(folder: Path) -> list[BestSetting]:
    return best_settings(collect(folder))


def test_the_lowest_mean_over_seeds_wins(tmp_path: Path) -> None:
    # Means 0.25, 0.20, 0.21: the best single seed (0.10) is not that of the best mean.
    search(tmp_path, {(0.001, 64): [0.10, 0.40], (0.0005, 64): [0.19, 0.21], (0.0005, 128): [0.20, 0.22]})
    search(tmp_path, {(0.001, 64): [0.5, 0.5], (0.001, 128): [0.3, 0.3]}, title="V-LSTM + SC")
    plain, sc = best(tmp_path)
    assert plain.words == "experiment=rpi/v_lstm backbone.width=64 optimizer.lr=0.0005"
    assert plain.overrides == ("backbone.width=64", "optimizer.lr=0.0005")
    assert plain.row.cells["minSADE"].mean == pytest.approx(0.20)
    assert (plain.row.cells["minSADE"].n, plain.candidates, plain.left_out) == (2, 3, ())
    assert sc.words == "experiment=rpi/v_lstm_sc backbone.width=128"
    table = to_markdown(settings_sheet([plain, sc]))
    assert f"| V-LSTM | {plain.words} | 0.200 ± 0.014 | 2 | 3 |" in table


def test_the_command_names_a_data_set_as_it_is_chosen_and_not_as_tables_call_it(tmp_path: Path) -> None:
    """Tables call it ``rpi_hard, recipe 2``, which is no option of ``data=``."""
    for lr, value in ((0.1, 0.3), (0.01, 0.2)):
        of_data = {"data.split": "hard", "data.recipe": 2}
        settings = {"optimizer.lr": lr, **of_data}
        make_run(
            tmp_path / str(lr),
            "V-LSTM",
            "marginal",
            scores(value),
            split="val",
            experiment="rpi/v_lstm",
            settings=settings,
        )
    (found,) = best(tmp_path)
    assert found.row.runs[0].data == "rpi_hard, recipe 2"
    assert found.words == "experiment=rpi/v_lstm data=rpi_hard optimizer.lr=0.01"


def test_words_about_the_data_of_a_search_belong_to_the_best_setting(tmp_path: Path) -> None:
    """A part of a data set has the settings of the whole one, and cannot be told from it by the configuration."""
    searched(
        tmp_path, "experiment=rpi/v_lstm data=rpi_hard_reduced +data.share=0.5 budget=short", **{"data.split": "hard"}
    )
    (found,) = best(tmp_path)
    assert found.words == "experiment=rpi/v_lstm data=rpi_hard_reduced +data.share=0.5 optimizer.lr=0.002"


def test_a_best_value_at_the_edge_of_those_tried_is_noted(tmp_path: Path) -> None:
    search(tmp_path / "edge", {(lr, 64): [error] for lr, error in ((0.001, 0.3), (0.002, 0.2), (0.004, 0.1))})
    (note,) = at_edge(*best(tmp_path / "edge"))
    assert note == (
        "Best setting of V-LSTM: optimizer.lr=0.004 is the largest of 3 values that were tried; larger ones may be better."
    )
    search(tmp_path / "inside", {(lr, 64): [error] for lr, error in ((0.001, 0.3), (0.002, 0.1), (0.004, 0.2))})
    search(tmp_path / "two", {(0.001, 64): [0.2], (0.002, 64): [0.1]})
    search(tmp_path / "zero", {(lr, 64): [0.1 + lr] for lr in (0.0, 0.1, 0.2)})
    diverged = {(lr, 64): [error] for lr, error in ((0.001, 0.3), (0.002, 0.2), (0.004, 0.1), (0.008, math.nan))}
    search(tmp_path / "diverged", diverged)
    assert [at_edge(*best(tmp_path / name)) for name in ("inside", "two", "zero", "diverged")] == [[], [], [], []]


def test_words_about_a_machine_are_no_part_of_the_best_setting(tmp_path: Path) -> None:
    words = "--config-dir data=x experiment=rpi/v_lstm data.root=/cache data.workers=4 data.share=0.1 data.share=0.5"
    searched(tmp_path, words, **{"data.split": "hard"})
    (found,) = best(tmp_path)
    assert found.words == "experiment=rpi/v_lstm data=rpi_hard data.share=0.5 optimizer.lr=0.002"


def test_the_test_split_never_chooses(tmp_path: Path) -> None:
    search(tmp_path, {(0.001, 64): [0.1], (0.0005, 64): [0.2]}, split="test")
    with pytest.raises(ConfigError, match=r"no run was scored on the validation split.*split=val"):
        best(tmp_path)


def test_test_scores_are_ignored(tmp_path: Path) -> None:
    search(tmp_path, {(0.001, 64): [0.1], (0.0005, 64): [0.9]}, split="test")
    search(tmp_path, {(0.001, 64): [0.4], (0.0005, 64): [0.3]})
    (found,) = best(tmp_path)
    assert found.overrides == ("optimizer.lr=0.0005",)


def test_a_lucky_seed_and_a_failed_training_do_not_win(tmp_path: Path) -> None:
    search(tmp_path, {(0.001, 64): [0.3, 0.3], (0.01, 64): [0.1], (0.1, 64): [math.nan, 0.1]})
    (found,) = best(tmp_path)
    assert found.words == "experiment=rpi/v_lstm optimizer.lr=0.001"
    assert (found.candidates, [row.name for row in found.left_out]) == (1, ["V-LSTM, lr=0.01", "V-LSTM, lr=0.1"])


def test_an_unfinished_search_chooses_nothing(tmp_path: Path) -> None:
    search(tmp_path, {(0.1, 64): [0.3], (0.01, 64): [math.nan]})
    make_run(
        tmp_path / "late", "V-LSTM", "marginal", scores(1), seed=7, split="val", experiment="rpi/v_lstm",
        settings={"optimizer.lr": 1.0, "backbone.width": 64},
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"no setting of 'V-LSTM' has finite scores for all seeds \[0, 7\]"):
        best(tmp_path)


def test_a_metric_that_was_not_scored_is_named(tmp_path: Path) -> None:
    search(tmp_path, {(0.1, 64): [0.3], (0.01, 64): [0.2]})
    with pytest.raises(ConfigError, match=r"has no score minXYZ.*minADE"):
        best_settings(collect(tmp_path), metric="minXYZ")


def test_settings_of_other_budgets_are_not_compared(tmp_path: Path) -> None:
    search(tmp_path, {(0.1, 64): [0.3, 0.3]})
    make_run(tmp_path / "long", "V-LSTM", "marginal", scores(0.1), split="val", budget="long", experiment="rpi/v_lstm")
    with pytest.raises(ConfigError, match=r"differ in budget \(long: V-LSTM; reduced: V-LSTM\)") as refused:
        best(tmp_path)
    assert f"`epo report runs={tmp_path / 'long'}`" in str(refused.value), "this folder has runs of one budget alone"
    assert f"`epo report runs={tmp_path}`" not in str(refused.value)


def test_experiments_without_a_choice_are_left_out(tmp_path: Path) -> None:
    search(tmp_path, {(0.1, 64): [0.3, 0.2]})
    assert best(tmp_path) == []


def test_overrides_without_an_experiment_name_the_parts(tmp_path: Path) -> None:
    for number, lr in enumerate((0.1, 0.2)):
        settings = {"solver.steps": 2 + number, "optimizer.lr": lr}
        make_run(tmp_path / str(lr), "own", "epo", scores(number), split="val", settings=settings)
    (found,) = best(tmp_path)
    assert found.words == "data=rpi backbone=v_lstm forecaster=epo optimizer.lr=0.1 solver.steps=2"


def test_a_batch_size_can_be_searched(tmp_path: Path) -> None:
    for size, value in ((16, 0.2), (32, 0.3)):
        settings = {"data.batch_size": size}
        make_run(tmp_path / str(size), "V-LSTM", "marginal", scores(value), split="val", settings=settings)
    (found,) = best(tmp_path)
    assert found.words == "data=rpi backbone=v_lstm forecaster=marginal data.batch_size=16"


@pytest.mark.parametrize("key", ["solver.steps", "forecaster.modes"])
def test_settings_varied_for_comparison_are_not_selected(tmp_path: Path, key: str) -> None:
    for value in (1, 2):
        make_run(tmp_path / str(value), "own", "epo", scores(value), split="val", settings={key: value})
    assert best(tmp_path) == []


def test_settings_that_a_search_fixes_belong_to_the_best_setting(tmp_path: Path) -> None:
    fixed = (
        "backbone.width=64 data.batch_size=16 ++optimizer.clip=0.5 data.placements=8 solver.steps=4 forecaster.modes=3"
    )
    for lr, value in ((0.001, 0.3), (0.002, 0.2)):
        make_run(
            tmp_path / str(lr), "V-LSTM", "marginal", scores(value), split="val", experiment="rpi/v_lstm",
            settings={"optimizer.lr": lr, "backbone.width": 64, "data.batch_size": 16, "optimizer.clip": 0.5},
            command=f"epo train experiment=rpi/v_lstm optimizer.lr={lr} {fixed} budget=short seed=0",
        )  # fmt: skip
    (found,) = best(tmp_path)
    chosen = "backbone.width=64 data.batch_size=16 ++optimizer.clip=0.5 optimizer.lr=0.002"
    assert found.words == f"experiment=rpi/v_lstm data=rpi data.placements=8 {chosen}"
    assert found.overrides == tuple(chosen.split())


def searched(folder: Path, words: str, experiment: str | None = "rpi/v_lstm", **settings: object) -> None:
    """Two runs of a search over the learning rate, whose command has further words."""
    for lr, value in ((0.001, 0.3), (0.002, 0.2)):
        make_run(
            folder / str(lr), "V-LSTM", "marginal", scores(value), split="val", experiment=experiment,
            settings={"optimizer.lr": lr, **settings}, command=f"epo train {words} optimizer.lr={lr}",
        )  # fmt: skip


def test_other_parts_that_a_search_fixes_belong_to_the_best_setting(tmp_path: Path) -> None:
    searched(tmp_path, "experiment=rpi/v_lstm backbone=wide +forecaster.annealing=0.5", **{"forecaster.annealing": 0.5})
    (found,) = best(tmp_path)
    assert found.words == "experiment=rpi/v_lstm backbone=wide +forecaster.annealing=0.5 optimizer.lr=0.002"


def test_parts_without_an_experiment_are_named_once(tmp_path: Path) -> None:
    searched(tmp_path, "backbone=wide forecaster=marginal", None)
    (found,) = best(tmp_path)
    assert found.words == "data=rpi backbone=wide forecaster=marginal optimizer.lr=0.002"


def test_the_frozen_run_of_one_seed_belongs_to_no_setting(tmp_path: Path) -> None:
    searched(tmp_path, "experiment=rpi/v_lstm forecaster.frozen=runs/s0", **{"forecaster.frozen": "runs/s0"})
    (found,) = best(tmp_path)
    assert found.words == "experiment=rpi/v_lstm optimizer.lr=0.002"


def test_a_damaged_command_is_named_with_its_file(tmp_path: Path) -> None:
    searched(tmp_path, "experiment=rpi/v_lstm 'title=x")
    with pytest.raises(ConfigError, match=r"0\.002/run\.json: command cannot be read \(No closing quotation\)"):
        best(tmp_path)


def test_of_settings_with_equal_scores_the_smallest_number_wins(tmp_path: Path) -> None:
    for size in (16, 8, 128):
        settings = {"data.batch_size": size}
        make_run(tmp_path / str(size), "V-LSTM", "marginal", scores(0.2), split="val", settings=settings)
    (found,) = best(tmp_path)
    assert found.overrides == ("data.batch_size=8",)
