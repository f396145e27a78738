"""Runs that tables are made from: which are collected, damaged files, splits, other recordings and folds."""

from __future__ import annotations

import io
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from epo_lightning.files import write_json
from epo_lightning.identity import identity, row_identity
from epo_lightning.registry import ConfigError
from epo_lightning.report.folds import named_by_fold
from epo_lightning.report.notes import of_different_code, untaught
from epo_lightning.report.rows import Row
from epo_lightning.report.runs import collect, find_runs
from epo_lightning.report.statistics import build_comparisons
from epo_lightning.report.tables import build_tables, distinct, over_folds
from epo_lightning.report.write import Report, write_report
from epo_lightning.run_folder import RunFolder
from report.table_rows import rows_of

from .run_folders import make_run, scores


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
    first = (
        rf"epo train resume={begun.path} continues an unfinished run, and then epo evaluate run={begun.path} does it"
    )
    with pytest.raises(ConfigError, match=rf"none of the 2 runs of this report is evaluated: {first}"):
        collect([waiting, begun])


def test_collect_names_missing_scores_and_the_command_for_them(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no folder .*nowhere.*epo train"):
        collect(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"no run in or below .*epo train"):
        collect(tmp_path)
    (tmp_path / "mine").mkdir()
    with pytest.raises(ConfigError, match=rf"no folder .*/mien to report on: did you mean {tmp_path}/mine\?$"):
        collect(tmp_path / "mien")
    make_run(tmp_path / "a", "V-LSTM", "marginal", None)
    with pytest.raises(
        ConfigError, match=rf"the only run in or below .* is not evaluated: .*epo evaluate runs={tmp_path}"
    ):
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
            "title: x\nseed: true",
            f"config.yaml is damaged: its entry seed must be a whole number, not True.*{COPY}",
        ),
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
    constant = make_run(tmp_path / "constant", "refined", "epo", scores(1.0), seed=1)  # all its weights are equal
    content = json.loads((constant.path / "metrics.json").read_text())
    write_json(constant.path / "metrics.json", {**content, "truth": {"pair_error": 0.9}})
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


def test_the_order_of_the_groups_of_a_test_split_makes_no_other_split(tmp_path: Path) -> None:
    for title, test in (("SC", ["a", "b"]), ("EPO", ["b", "a"])):
        make_run(tmp_path / title, title, "epo", scores(0.1), data="square", settings={"data.test": test})
    assert [named.data for named in named_by_fold(collect(tmp_path))] == ["square", "square"]


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


def test_a_baseline_that_learned_nothing_is_not_said_to_have_other_code(tmp_path: Path) -> None:
    for name, forecaster, code in (("SC", "scene_consistent", "one"), ("CV", "constant_velocity", "two")):
        make_run(tmp_path / name, name, forecaster, scores(0.1)).update(versions={"code": code})
    rows = list(rows_of(tmp_path).values())
    assert {run.code for row in rows for run in row.runs} == {"one", "two"}
    assert of_different_code(rows) == []
