"""Transfer tables: which scores stand in which cell, and damaged files."""

from __future__ import annotations

import csv
import io
import statistics
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from epo_lightning.files import read_json, write_json
from epo_lightning.registry import ConfigError
from epo_lightning.report.runs import read_parts
from epo_lightning.report.transfer import labels_of, transfer_sheets, transfers, transfers_to_csv
from epo_lightning.report.write import Report, write_report
from epo_lightning.run_folder import RunFolder

from .run_folders import make_run, scores


def on(run: RunFolder, data: str, value: float, name: str = "", **changes: Any) -> None:
    """Write scores of a run on other data."""
    content = {
        "data": data,
        "split": "all",
        "data_digest": f"digest-{data}",
        "test": f"test-{data}",
        "checkpoint": "best",
        "scenes": 12,
        "recordings": 3,
        "agents": {"car": 3, "pedestrian": 1},
        "notes": ["no map"],
        "metrics": scores(value),
        **changes,
    }
    write_json(run.path / f"scores-on-{data}-all-1-2{name}.json", content)


def three_runs(home: Path) -> list[RunFolder]:
    """Two seeds of a row that was trained on a, and one that learned nothing."""
    runs = [
        make_run(home / f"sc{seed}", "SC", "scene_consistent", scores(1.0 + seed), seed=seed, data="a")
        for seed in (0, 1)
    ]
    runs.append(make_run(home / "cv", "Const. Vel.", "constant_velocity", scores(9.0), data="a"))
    for place, run in enumerate(runs):
        on(run, "b", 4.0 + place)
    on(runs[0], "c", 7.0)
    return runs


def test_cells_are_means_over_seeds_by_training_and_test(tmp_path: Path) -> None:
    lines = transfers(three_runs(tmp_path))
    sade, sfde, overlap, tests = transfer_sheets(lines)
    assert (sade.title, sfde.title, overlap.title) == ("Transfer: SADE", "Transfer: SFDE", "Transfer: OR (JFP)")
    assert sade.header == ("trained on", "method", "n", "a, test", "b, all", "c, all")
    deviation = statistics.stdev([1.0, 2.0])
    assert sade.lines == (
        ("-", "Const. Vel.", "1", "9.000", "6.000", "-"),
        ("a", "SC", "2", f"1.500 ± {deviation:.3f}", f"4.500 ± {deviation:.3f}", "7.000"),
    )
    assert sade.ends == {0, 1}
    assert tests.lines[1] == ("b, all", "car 75%, pedestrian 25%", "no map", "12", "3")
    assert tests.lines[0] == ("a, test", "-", "-", "-", "-")


def test_validation_scores_have_no_column(tmp_path: Path) -> None:
    runs = three_runs(tmp_path)
    for run in runs:
        content = read_json(run.metrics_file())
        write_json(run.metrics_file("val"), {**content, "split": "val", "metrics": scores(0.1)})
    sheet = transfer_sheets(transfers(runs))[0]
    assert sheet.header[3:] == ("a, test", "b, all", "c, all")
    assert all("0.100" not in line for line in sheet.lines)


def test_the_csv_has_every_score(tmp_path: Path) -> None:
    rows = list(csv.DictReader(transfers_to_csv(transfers(three_runs(tmp_path))).splitlines()))
    found = {(row["trained_on"], row["method"], row["test_on"], row["split"], row["metric"]): row for row in rows}
    assert len(found) == len(rows) == 5 * 6
    row = found["a", "SC", "b", "all", "minSFDE"]
    assert (float(row["mean"]), row["n"], row["seeds"], row["scenes"]) == (4.5, "2", "0 1", "12")
    assert row["data_digest"] == "digest-b"


def test_runs_without_scores_elsewhere_give_no_table(tmp_path: Path) -> None:
    run = make_run(tmp_path / "sc", "SC", "scene_consistent", scores(1.0), data="a")
    assert transfers([run]) == []
    assert transfer_sheets([]) == []


def test_scores_on_a_part_of_the_own_data_are_tables_of_their_own(tmp_path: Path) -> None:
    """The share of the training is all scenes unless it is set, so scores on a share of a half are no other data."""
    for seed, half in ((0, 3.0), (1, 5.0)):
        run = make_run(tmp_path / f"sc{seed}", "SC", "scene_consistent", None, seed=seed, data="a", digest="A")
        on(run, "a", 9.0, split="test", data_digest="A", settings={"share": 0.5}, name="-0")  # written first
        on(run, "a", half, split="test", data_digest="A", settings={"share": 0.5}, name="-00")
        on(run, "b", 7.0, split="test", data_digest="B", settings={"share": 0.5})
    report = Report.of_folder(tmp_path)
    write_report(report, tmp_path / "report", console=Console(file=io.StringIO()))
    text = (tmp_path / "report" / "results.md").read_text()
    table = text.partition("## a, 50% of the scenes, test split\n")[2].partition("##")[0]
    assert "| SC | 2 | 4.000 ± 1.414 |" in table
    assert "| SC | a, 50% of the scenes, test split | reduced | 0, 1 |" in text.partition("## How this was made")[2]
    assert transfer_sheets(transfers(report.runs))[0].header[3:] == ("b, test",)


def test_a_metric_that_the_first_seed_lacks_is_in_the_csv(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / f"{seed}", "SC", "scene_consistent", scores(1.0), seed=seed) for seed in (0, 1)]
    on(runs[0], "b", 2.0)
    on(runs[1], "b", 4.0, metrics=scores(4.0) | {"own/near": 0.5})
    rows = csv.DictReader(transfers_to_csv(transfers(runs)).splitlines())
    assert [(row["mean"], row["n"]) for row in rows if row["metric"] == "own/near"] == [("0.5", "1")]


def test_parts_are_told_apart_by_split_share_and_checkpoint(tmp_path: Path) -> None:
    run = make_run(tmp_path / "sc", "SC", "scene_consistent", None, data="a", digest="A")
    for place, (split, share, checkpoint) in enumerate(
        (
            ("test", 0.101, "best"),
            ("test", 0.104, "best"),
            ("val", 0.104, "best"),
            ("test", 0.101, "last"),
            ("test", -1, "best"),
        )
    ):
        settings = {"settings": {"share": share}, "split": split, "checkpoint": checkpoint, "test": f"test-{place}"}
        on(run, "a", 1.0 + place, data_digest="A", name=f"-{place}", **settings)
    found = {(one.data, one.split): one.metrics["minSADE"] for one in read_parts(run)}
    assert found == {
        ("a, 10.1% of the scenes", "test"): 1.0,
        ("a, 10.4% of the scenes", "test"): 2.0,
        ("a, 10.4% of the scenes", "val"): 3.0,
    }


@pytest.mark.parametrize("settings", [[1], {"share": None}, {"share": "0.5"}])
def test_damaged_settings_of_a_test_make_no_part(tmp_path: Path, settings: Any) -> None:
    run = make_run(tmp_path / "sc", "SC", "scene_consistent", None, data="a", digest="A")
    on(run, "a", 1.0, split="test", data_digest="A", settings=settings)
    assert read_parts(run) == []


def test_players_of_games_are_told_apart_by_their_settings(tmp_path: Path) -> None:
    """The hard split of RPI and its kinds of players are data sets of their own, as in the tables of trainings."""
    run = make_run(tmp_path / "sc", "SC", "scene_consistent", scores(1.0), data="a", digest="A")
    for place, players in enumerate(("potential", "feedback")):
        settings = {"name": "rpi", "split": "hard", "solver": players}
        on(run, "rpi", 2.0 + place, f"-{place}", split="test", data_digest=players, test=players, settings=settings)
    (sheet, *_) = transfer_sheets(transfers([run]))
    assert sheet.header[4:] == ("rpi_hard, test", "rpi_hard, feedback players, test")


def test_a_test_is_not_named_after_a_share_of_games_that_only_a_training_has(tmp_path: Path) -> None:
    run = make_run(tmp_path / "sc", "SC", "scene_consistent", None, data="a", digest="A")
    on(run, "rpi", 2.0, split="test", settings={"name": "rpi", "games_share": 0.25})
    (sheet, *_) = transfer_sheets(transfers([run]))
    assert sheet.header[3:] == ("rpi, test",)


def test_rows_of_several_data_sets_share_the_columns_of_the_same_scenes(tmp_path: Path) -> None:
    one = make_run(tmp_path / "one", "SC", "scene_consistent", scores(1.0), data="a", digest="A")
    other = make_run(tmp_path / "other", "SC", "scene_consistent", scores(2.0), data="b", digest="B")
    on(one, "b", 3.0, split="test", data_digest="B")
    on(other, "a", 4.0, split="test", data_digest="A")
    sheet, *_, tests = transfer_sheets(transfers([one, other]))
    assert sheet.header[3:] == ("a, test", "b, test")
    assert [line[0] for line in sheet.lines] == ["a", "b"]
    assert [line[3:] for line in sheet.lines] == [("1.000", "3.000"), ("4.000", "2.000")]
    counts = {line[0]: line[3:] for line in tests.lines}
    assert counts == dict.fromkeys(("a, test", "b, test"), ("12", "3")), "known from the run that was trained elsewhere"


def test_rows_of_different_data_keep_their_titles(tmp_path: Path) -> None:
    """The first column tells them apart; rows of the same data are told apart by the settings in which they differ."""
    rows = [("one", "a", 0.1), ("two", "b", 0.2), ("three", "b", 0.3)]
    for name, data, rate in rows:
        run = make_run(tmp_path / name, "SC", "scene_consistent", None, data=data, settings={"optimizer.lr": rate})
        on(run, "c", 1.0)
    lines = transfers(RunFolder.open(tmp_path / name) for name, _, _ in rows)
    assert [(line.trained, line.method) for line in lines] == [("a", "SC"), ("b", "SC, lr=0.2"), ("b", "SC, lr=0.3")]


def test_a_part_of_the_own_data_is_shown_if_others_were_scored_on_it(tmp_path: Path) -> None:
    one = make_run(tmp_path / "one", "SC", "scene_consistent", None, data="a", digest="A")
    other = make_run(tmp_path / "other", "SC", "scene_consistent", None, data="b", digest="B")
    for run, value in ((one, 1.0), (other, 2.0)):
        on(run, "a", value, split="test", data_digest="A", settings={"share": 0.5})
    on(one, "a", 3.0, name="-0", split="test", data_digest="A", settings={"share": 0.25}, test="another")
    sheet = transfer_sheets(transfers([one, other]))[0]
    assert sheet.header[3:] == ("a, test",)
    assert [(line[0], line[3]) for line in sheet.lines] == [("a", "1.000"), ("b", "2.000")]


def test_other_scenes_have_columns_of_their_own(tmp_path: Path) -> None:
    one = make_run(tmp_path / "one", "SC", "scene_consistent", None, data="a")
    on(one, "b", 3.0, data_digest="first1", name="-x")
    on(one, "b", 4.0, data_digest="second", name="-y")
    on(one, "c", 5.0, test="disc01", name="-x")
    on(one, "c", 6.0, test="box002", name="-y")
    lines = transfers([one])
    labels = list(labels_of(lines).values())
    assert labels == ["b, all (first1)", "b, all (second)", "c, all (box002)", "c, all (disc01)"]
    assert transfer_sheets(lines)[0].lines == (("a", "SC", "1", "3.000", "4.000", "6.000", "5.000"),)


def test_of_two_versions_the_later_one_counts_and_checkpoints_have_lines_of_their_own(tmp_path: Path) -> None:
    one = make_run(tmp_path / "one", "SC", "scene_consistent", None, data="a")
    on(one, "b", 3.0)
    on(one, "b", 4.0, name="-2")
    on(one, "b", 5.0, name="-10")
    on(one, "b", 8.0, checkpoint="last", name="-last")
    sheet = transfer_sheets(transfers([one]))[0]
    assert sheet.lines == (("a", "SC", "1", "5.000"), ("a", "SC, checkpoint last", "1", "8.000"))


def test_a_baseline_that_learned_nothing_has_one_line_whatever_its_checkpoint(tmp_path: Path) -> None:
    run = make_run(tmp_path / "cv", "Const. Vel.", "constant_velocity", None, data="a")
    on(run, "b", 3.0)
    on(run, "c", 4.0, checkpoint="last")
    sheet = transfer_sheets(transfers([run]))[0]
    assert sheet.lines == (("-", "Const. Vel.", "1", "3.000", "4.000"),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "has no entry data"),
        ("half", "is not JSON"),
        ('{"data": "b", "split": "all", "test": "t", "checkpoint": "best", "data_digest": "d"}', "no entry metrics"),
        (
            '{"data": "b", "split": "all", "test": "t", "checkpoint": "best", "data_digest": "d", "metrics": {"a": "x"}}',
            "metrics must be numbers",
        ),
        *(
            (
                '{"data": "b", "split": "all", "test": "t", "checkpoint": "best", "data_digest": "d", "metrics": {}, '
                f"{entry}}}",
                message,
            )
            for entry, message in (
                ('"agents": {"car": "x"}', "is damaged: its entry agents must be numbers by name, not {'car': 'x'}"),
                ('"notes": 3', "is damaged: its entry notes must be a list of texts, not 3"),
            )
        ),
    ],
)
def test_damaged_files_are_named_with_a_remedy(tmp_path: Path, text: str, message: str) -> None:
    run = make_run(tmp_path / "one", "SC", "scene_consistent", None)
    (run.path / "scores-on-b-all-1-2.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"scores-on-b-all-1-2\.json.*{message}.*epo evaluate run=.*one data="):
        transfers([run])
