"""``epo drive``: files, films, and mistakes."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from experiment.conftest import epo  # noqa: F401 - a fixture

from epo_lightning.drive.rpi import RPIWorld
from epo_lightning.drive.worlds import BEST_RESPONSE, JOINT
from epo_lightning.experiment import drive
from epo_lightning.experiment.config.settings import DriveSettings
from epo_lightning.experiment.drive import ROUNDS, _baseline, _milliseconds, _results, _titles, folder_of
from epo_lightning.files import read_json
from epo_lightning.report.closed_loop import read_closed_loop
from epo_lightning.run_folder import RunFolder

SMALL = ["episodes=2", "timed=1", "others=[ignores]"]
QUICK = [
    "run=rpi/v_lstm_epo",
    "ways=[own]",
    "baselines=[constant_velocity]",
    "film=null",
    "timed=0",
    "episodes=2",
    "others=[ignores]",
]


@pytest.mark.slow
def test_tables_and_films_are_written(epo: Callable[..., int], tmp_path: Path) -> None:  # noqa: F811
    words = ["run=[rpi/v_lstm_epo,rpi/v_lstm_sc]", "ways=[own,warm]", "baselines=[constant_velocity]"]
    assert epo("drive", *words, *SMALL, f"out={tmp_path}/driven") == 0
    results = read_json(tmp_path / "driven" / "results.json")
    planners = results["worlds"]["ignores"]["planners"]
    row, baseline = "V-LSTM + EPO, relaxed", "response to constant velocity"
    assert list(planners) == [row, f"{row}, warm start", "V-LSTM + SC, relaxed", baseline], "+SC has no warm start"
    assert set(planners[row]) >= {"collision", "time_to_collision", "progress", "jerk", "lateral", "deadlock", "cost"}
    difference = results["worlds"]["ignores"]["differences"][f"{row} - {baseline}"]["progress"]
    wanted = planners[row]["progress"]["mean"] - planners[baseline]["progress"]["mean"]
    assert difference["mean"] == pytest.approx(wanted)
    assert results["milliseconds"]["ignores"][row]["plans"] == 81
    assert (tmp_path / "driven" / "film-ignores.gif").read_bytes()[:3] == b"GIF"
    table = (tmp_path / "driven" / "table.md").read_text()
    assert table.startswith(
        "world=rpi, 2 episodes of seed 0, runs rpi/v_lstm_epo, rpi/v_lstm_sc, checkpoint best, commit "
    )
    assert table.count(f"| {baseline} |") == 2
    ignores = read_closed_loop(tmp_path / "driven" / "results.json", "ignores")
    line = next(line for line in table.splitlines() if line.startswith(f"| {row} |"))
    assert sorted(line.strip("| ").split(" | ")[1:]) == sorted(ignores.text(row, name) for name in planners[row])
    assert ignores.units["collision"] == "%"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run=highway_sim/hivt_m_epo"], "was trained on data=highway_sim, and world=rpi takes runs of data=rpi"),
        (["run=rpi/v_lstm_epo", "others=[play]"], "did you mean 'plays'"),
        (["run=rpi/v_lstm_epo", "others=[plays,plays]"], "others names 'plays' twice: name each kind of others once"),
        (["run=rpi/v_lstm_epo", "film=2", "episodes=2"], "film must be an episode from 0 to 1, or null, not 2"),
        (["run=rpi/v_lstm_epo", "episodes=0", "film=null"], "episodes must be 1 or more, not 0"),
        (["run=rpi/v_lstm_epo", "ways=[]", "baselines=[]"], "nothing drives"),
        (["run=rpi/v_lstm_epo", "others=[]"], "nothing drives: name one of others"),
        (["run=rpi/v_lstm_sc", "ways=warm", "baselines=[]"], "no planner is left to drive (rpi/v_lstm_sc, warm: "),
        (["run=[rpi/v_lstm_epo,rpi/v_lstm_epo]"], "the run rpi/v_lstm_epo is named twice"),
        (["run=rpi/v_lstm_epo", "ways=own,"], "cannot read the override"),
        (["run=rpi/v_lstm_epo", "ways=owm"], "ways must be one of own, warm, alone, respond"),
        (["run=rpi/v_lstm_epo", "ways=[own,own]"], "two planners are called 'V-LSTM + EPO, relaxed'"),
        (["run=rpi/v_lstm_epo", "world=sum"], "unknown world 'sum': did you mean 'sumo'"),
        (
            ["run=rpi/v_lstm_epo", "world=sumo"],
            "was trained on data=rpi, and world=sumo takes runs of recorded traffic",
        ),
        (["run=highway_sim/hivt_m_epo", "world=sumo", "others=[dens]"], "did you mean 'dense'"),
        (["run=highway_sim/hivt_m_epo", "world=highway_env", "others=[merging]"], "did you mean 'merge'"),
        (["run=rpi/v_lstm_epo", "baselines=[driver]"], "unknown baseline 'driver' of world=rpi"),
    ],
)
def test_mistakes_are_named(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    assert epo("drive", *words, f"out={tmp_path}/driven") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "driven").exists()


def test_a_command_that_was_killed_is_continued(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "driven"
    assert epo("drive", *QUICK, f"out={out}") == 0
    told = capsys.readouterr().out
    assert "drives 2 episodes with each of 2 planners, others: ignores; the same command continues" in told
    assert "V-LSTM + EPO, relaxed: 2 of 2 episodes" in told
    whole, lines = (out / "results.json").read_text(), (out / "episodes.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) == 3, "settings, and a line per planner"
    (out / "results.json").unlink()
    (out / "episodes.jsonl").write_text(lines[0] + lines[1] + lines[2][:50])
    assert epo("drive", *QUICK, f"out={out}") == 0
    assert (out / "results.json").read_text() == whole
    told = capsys.readouterr().out
    assert "V-LSTM + EPO, relaxed: 2 of 2 episodes" not in told, "what was driven is not driven again"
    assert "response to constant velocity: 2 of 2 episodes" in told
    (out / "results.json").unlink()
    words = [word for word in QUICK if not word.startswith(("timed=", "film="))]
    assert epo("drive", *words, "timed=1", "film=1", f"out={out}") == 0, "episodes do not depend on times and films"
    told = capsys.readouterr().out
    assert "2 of 2 episodes" not in told
    assert "times every plan of V-LSTM + EPO, relaxed; episodes driven once more, one by one: 1" in told
    assert "draws a film of episode 1" in told
    (out / "results.json").unlink()
    assert epo("drive", *QUICK, "seed=1", f"out={out}") == 2
    assert "was begun with other settings (seed)" in capsys.readouterr().err


def test_a_damaged_row_is_told_and_driven_again(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "driven"
    assert epo("drive", *QUICK, f"out={out}") == 0
    whole, text = (out / "results.json").read_text(), (out / "episodes.jsonl").read_text()
    (out / "results.json").unlink()
    (out / "episodes.jsonl").write_text(text.replace('"collision": [', '"collision": [1.0, ', 1))
    capsys.readouterr()
    assert epo("drive", *QUICK, f"out={out}") == 0
    assert f"{out / 'episodes.jsonl'}, line 2 is damaged: its episodes are driven again" in capsys.readouterr().out
    assert (out / "results.json").read_text() == whole


def test_a_run_that_was_trained_on_is_refused(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(RunFolder.open("rpi/v_lstm_epo").path, tmp_path / "own")
    words = ["run=own", *QUICK[1:], "out=driven"]
    assert epo("drive", *words) == 0
    (tmp_path / "driven" / "results.json").unlink()
    best = tmp_path / "own" / "checkpoints" / "best.ckpt"
    content = torch.load(best, weights_only=False)
    next(iter(content["state_dict"].values())).add_(1e-3)
    torch.save(content, best)
    assert epo("drive", *words) == 2
    assert "was begun with other settings: the checkpoint of the run own has changed" in capsys.readouterr().err


def test_a_folder_has_one_command_at_a_time(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with RunFolder(tmp_path / "driven").lock():
        assert epo("drive", *QUICK, "out=driven") == 2
    assert "another process works on driven" in capsys.readouterr().err
    assert not (tmp_path / "driven" / "episodes.jsonl").exists()


def test_results_that_appear_meanwhile_are_not_overwritten(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def meanwhile(*values: object) -> str:
        (tmp_path / "driven" / "results.json").write_text("{}")
        return ""

    monkeypatch.setattr("epo_lightning.experiment.drive._table", meanwhile)
    assert epo("drive", *QUICK, "out=driven") == 2
    assert "driven holds results already" in capsys.readouterr().err
    assert (tmp_path / "driven" / "results.json").read_text() == "{}"


@pytest.mark.parametrize("out", ["file", "file/below", "x" * 300])
def test_a_folder_that_cannot_be_made_is_refused_before_anything_is_driven(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    out: str,
) -> None:
    (tmp_path / "file").write_text("mine")
    assert epo("drive", *QUICK, f"out={out}") == 2
    captured = capsys.readouterr()
    assert f"out={out} is no folder that can be made and written" in captured.err
    assert "episodes" not in captured.out
    assert (tmp_path / "file").read_text() == "mine"


def test_a_command_that_was_killed_in_the_middle_of_a_line_is_continued(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
) -> None:
    out = tmp_path / "driven"
    assert epo("drive", *QUICK, f"out={out}") == 0
    whole, lines = (out / "results.json").read_text(), (out / "episodes.jsonl").read_text().splitlines(keepends=True)
    for left in (lines[0] + lines[2] + lines[1][:50], lines[0][:20]):
        (out / "results.json").unlink()
        (out / "episodes.jsonl").write_text(left)
        assert epo("drive", *QUICK, f"out={out}") == 0
        assert (out / "results.json").read_text() == whole, "the first planner stays the first"
        rows = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
        assert len(rows) == 3, "no row is lost"


def test_what_was_driven_by_a_killed_command_gives_the_same_table(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
) -> None:
    """Also the rates of a world, with its driver as the only planner, which has no plans to be timed."""
    pytest.importorskip("highway_env", reason="the extra `drive` is not installed")
    words = ["world=highway_env", "run=x", "ways=[]", "baselines=[driver]", "others=[merge]", "episodes=2", "film=null"]
    assert epo("drive", *words, "out=driven") == 0
    files = [tmp_path / "driven" / name for name in ("results.json", "table.md")]
    whole = [file.read_text() for file in files]
    assert "arrived [%]" in whole[1]
    files[0].unlink()
    assert epo("drive", *words, "out=driven") == 0
    assert [file.read_text() for file in files] == whole


def test_runs_with_one_title_are_told_apart(epo: Callable[..., int], tmp_path: Path) -> None:  # noqa: F811
    for name in ("short-s1", "short-s2"):
        shutil.copytree(RunFolder.open("rpi/v_lstm_epo").path, tmp_path / name)
    words = ["ways=[own]", "baselines=[]", "film=null", "timed=0", *SMALL[::2]]
    assert epo("drive", "run=[short-s1,short-s2,rpi/v_lstm_sc]", *words, "out=driven") == 0
    planners = read_json(tmp_path / "driven" / "results.json")["worlds"]["ignores"]["planners"]
    row = "V-LSTM + EPO, relaxed"
    assert set(planners) == {f"{row} (short-s1)", f"{row} (short-s2)", "V-LSTM + SC, relaxed"}
    paths = ["a/s1", "b/s1"]
    assert _titles(paths, [Path("/a/s1"), Path("/b/s1")], ["x", "x"]) == ["x (a/s1)", "x (b/s1)"]


def test_results_are_not_overwritten(
    epo: Callable[..., int],  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "results.json").write_text("{}")
    assert epo("drive", "run=rpi/v_lstm_epo", f"out={tmp_path}") == 2
    assert "holds results already" in capsys.readouterr().err


def test_every_setting_that_decides_on_episodes_has_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    one = DriveSettings(run="rpi/v_lstm_epo", ways="own", others="plays")
    assert (one.run, one.ways, one.others) == (["rpi/v_lstm_epo"], ["own"], ["plays"])
    assert folder_of(dataclasses.replace(one, timed=0, film=None)) == folder_of(one)
    assert folder_of(one).parent == Path("drive")
    assert folder_of(one).name.startswith("rpi-")
    for change in ({"seed": 1}, {"episodes": 7}, {"others": ["ignores"]}, {"run": ["rpi/v_lstm_sc"]}):
        assert folder_of(dataclasses.replace(one, **change)) != folder_of(one)
    assert folder_of(dataclasses.replace(one, out="mine")) == Path("mine")
    before, traffic = folder_of(one), dataclasses.replace(one, world="highway_env")
    elsewhere = folder_of(traffic)
    monkeypatch.setattr(drive, "RECIPE", drive.RECIPE + 1)
    assert folder_of(one) != before, "games of another version are other episodes"
    assert folder_of(traffic) == elsewhere


def test_differences_are_those_of_the_first_planner_from_the_others_in_the_same_episodes() -> None:
    first = {"cost": torch.tensor([1.0, 2.0, 6.0]), "collision": torch.tensor([0.0, 0.0, 1.0])}
    other = {"cost": torch.tensor([3.0, 3.0, 9.0]), "collision": torch.tensor([1.0, 1.0, 1.0])}
    found = _results({"a": first, "b": other}, ["collision"])
    assert list(found["differences"]) == ["a - b"]
    difference = found["differences"]["a - b"]["cost"]
    assert difference["mean"] == pytest.approx(-2.0)
    assert difference["low"] < -2.0 < difference["high"]
    assert found["planners"]["a"]["cost"]["mean"] == pytest.approx(3.0)
    assert found["units"]["collision"] == "%"


def test_times_of_plans_are_milliseconds_by_the_clock_and_of_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[range] = []

    def times(world: object, planner: object, episodes: range) -> tuple[list[float], list[float]]:
        driven.append(episodes)
        return [0.001 * number for number in range(101)], [0.002 * number for number in range(101)]

    monkeypatch.setattr(drive, "times", times)
    world: Any = [0, 1]
    planner: Any = object()
    found = _milliseconds(world, "plays", {"the driver of the world": None, "a": planner}, 5, lambda line: None)
    assert found.keys() == {"a"}
    assert found["a"] == pytest.approx(
        {"clock median": 50.0, "clock 99 %": 99.0, "processor median": 100.0, "processor 99 %": 198.0, "plans": 101}
    )
    assert driven == [range(2)], "there are no more episodes"


def test_one_baseline_iterates_best_responses_and_another_one_solves_the_game() -> None:
    world = RPIWorld(1, 0, "ignores")
    planners: list[Any] = [_baseline(name)(world) for name in (BEST_RESPONSE, JOINT)]
    assert [planner.rounds for planner in planners] == [ROUNDS, None]
