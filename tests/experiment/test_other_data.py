"""`epo evaluate` and `epo predict` on data on which a run was not trained."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from experiment import pedestrians, tiny
from experiment.conftest import Epo

from epo_lightning import cli
from epo_lightning.data.datamodule import SceneDataset
from epo_lightning.data.recorded import versions
from epo_lightning.experiment.assembly import build_data
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.other_data import OtherData, _files, follow
from epo_lightning.identity import digest_of
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import read
from epo_lightning.task import Task

SMALL = ("budget=smoke", "callbacks.progress=none")
ROAD = ("data=drawn", "data.like=highway", "data.scenes=24")
"""Data of the road runs, with lanes and goal candidates."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of roads: a game that chooses goals on lanes, and constant velocity; and two runs of RPI scenes."""
    home = tmp_path_factory.mktemp("trained")
    for row in ("v_lstm_epo", "const_vel"):
        cli.main(["train", f"experiment=highway/{row}", *ROAD, *SMALL, f"run_dir={home / 'runs' / row}"])
    for row in ("v_lstm_epo", "v_lstm_sc"):
        drawn = ("data=drawn", "data.scenes=16")
        cli.main(["train", f"experiment=rpi/{row}", *drawn, *SMALL, f"run_dir={home / 'rpi' / row}"])
    cli.main(["evaluate", f"run={home / 'runs' / 'v_lstm_epo'}"])
    return home


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EPO_CACHE", raising=False)


@pytest.fixture
def home(trained: Path, tmp_path: Path) -> Path:
    """A copy of the run folders."""
    for name in ("runs", "rpi"):
        shutil.copytree(trained / name, tmp_path / name)
    return tmp_path


def others(run: Path) -> list[Path]:
    return sorted(run.glob("scores-on-*.json"))


def content(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(file.read_text())
    return found


def test_own_data_by_the_other_way_gives_the_same_scores(epo: Epo, home: Path) -> None:
    run = home / "runs" / "v_lstm_epo"
    before = (run / "metrics.json").read_bytes()
    assert epo("evaluate", f"run={run}", *ROAD) == 0
    (file,) = others(run)
    found = content(file)
    assert (found["split"], found["notes"], found["scenes"]) == ("test", [], 24)
    assert json.dumps(found["metrics"]) == json.dumps(content(run / "metrics.json")["metrics"])
    assert found["data_digest"] == RunFolder(run).record["data_digest"]
    assert found["checkpoint_digest"] == hashlib.sha256((run / "checkpoints/best.ckpt").read_bytes()).hexdigest()[:16]
    assert (run / "metrics.json").read_bytes() == before


def test_a_run_of_roads_is_scored_on_pedestrians_without_a_map(
    epo: Epo, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, folder = home / "runs" / "v_lstm_epo", pedestrians.square(home / "data")
    assert epo("evaluate", f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1") == 0
    printed = capsys.readouterr().out
    (file,) = others(run)
    assert f"in {file}" in printed
    found = content(file)
    assert (found["data"], found["split"], found["recordings"]) == ("ucy", "all", 1)
    assert set(found["agents"]) == {"pedestrian"}
    windows = found["settings"]["windows"]
    assert [windows[key] for key in ("dt", "history", "horizon", "agents")] == [0.2, 10, 20, 4]
    assert (windows["every"], windows["interpolate"], windows["radius"]) == (2, True, 10.0)
    assert found["settings"]["frame"] == "aligned"
    for words in ("data.windows.dt=0.2 instead of 0.4, as the run", "no map: lanes are absent"):
        assert any(words in note for note in found["notes"])
        assert words in printed
    assert 0 < found["metrics"]["minSADE"] < 50
    assert not list(run.glob("metrics-*"))

    written = file.read_bytes()
    assert epo("evaluate", f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1", "batch_size=7") == 0
    assert others(run) == [file]
    assert file.read_bytes() == written
    assert epo("evaluate", f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1", "checkpoint=last") == 0
    assert len(others(run)) == 2
    before = {*others(run)}
    assert epo("evaluate", f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1", "data.share=0.5") == 0
    (half,) = {*others(run)} - before
    assert content(half)["scenes"] == round(found["scenes"] / 2)
    assert content(half)["test"] != found["test"], "a report takes scores of one test for those of two versions"
    pedestrians.square(folder, seed=1)  # the recordings have changed
    assert epo("evaluate", f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1") == 0
    assert len(others(run)) == 4
    assert len({content(file)["data_digest"] for file in others(run)}) == 2
    assert file.read_bytes() == written


def test_scores_of_another_version_are_kept_beside_the_first(epo: Epo, home: Path) -> None:
    run, folder = home / "runs" / "const_vel", pedestrians.square(home / "data")
    words = ("evaluate", f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1")
    assert epo(*words) == 0
    (file,) = others(run)
    old = content(file)
    old["metrics"]["minSADE"] += 1.0
    old["digest"] = digest_of(old)
    file.write_text(json.dumps(old))
    assert epo(*words) == 0
    assert content(file) == old
    assert [other.name for other in others(run) if other != file] == [f"{file.stem}-2.json"]
    file.write_text("half a fi")
    assert epo(*words) == 0
    assert content(file)["metrics"]["minSADE"] == pytest.approx(old["metrics"]["minSADE"] - 1.0)


def test_the_windows_lie_on_the_recorded_frames(epo: Epo, home: Path) -> None:
    from safetensors.torch import load_file

    run, folder = home / "runs" / "v_lstm_epo", pedestrians.square(home / "data")
    assert (
        epo(
            "predict",
            f"run={run}",
            "out=out",
            "data=ucy",
            f"data.folder={folder}",
            "workers=1",
            "scenes=3",
            "figures=1",
        )
        == 0
    )
    index = content(home / "out" / "index.json")
    assert (index["data"], index["split"], index["subsets"]) == ("ucy", "all", ["calm", "interactive"])
    assert index["provenance"][1]["recording"] == "square"
    assert any("no map" in note for note in index["notes"])
    tensors = load_file(home / "out" / "forecasts.safetensors")
    assert tensors["states"].shape[2:] == (4, 20, 4)
    table = np.loadtxt(folder / "square" / "obsmat.txt")
    for scene, origin in enumerate(index["provenance"]):
        (x, y, angle), past = tensors["frame"][scene].tolist(), tensors["history"][scene].double().numpy()
        for agent, track in enumerate(origin["tracks"]):
            rows = table[table[:, 1] == track]
            time = 0.2 * np.arange(-9, 1) + origin["frame"] / 2.5
            world = np.stack([np.interp(time, rows[:, 0] / 25, rows[:, column]) for column in (2, 4)], 1) - (x, y)
            turned = world @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            np.testing.assert_allclose(past[agent, :, :2], turned, atol=1e-4)
    assert (
        epo(
            "predict",
            f"run={run}",
            "out=five",
            "data=ucy",
            f"data.folder={folder}",
            "figures=0",
            "data.windows.history=5",
        )
        == 0
    )
    assert load_file(home / "five" / "forecasts.safetensors")["history"].shape[2] == 5


def test_recordings_of_another_rate_are_read_at_the_runs(trained: Path) -> None:
    settings = read(Settings, RunFolder(trained / "runs" / "v_lstm_epo").config())
    task = build_data(settings.data).task
    section = compose("evaluate", ["run=x", "data=exid"])["data"]
    usual = section["windows"]
    faster = {**section, "windows": {**usual, "dt": 0.1, "horizon": 30, "history": 19}}
    followed, notes = follow(faster, settings, task)
    assert followed["windows"] == usual, "the digest is that of the usual extraction at 0.2 s"
    assert notes[0] == "data.windows.dt=0.2 instead of 0.1, as the run"
    assert len(notes) == 3
    slower = {**section, "windows": {**usual, "dt": 0.6, "every": 2, "least_agents": 6, "agents": 8}}
    windows = follow(slower, settings, task)[0]["windows"]
    wanted = {"dt": 0.2, "every": 6, "agents": 4, "least_agents": 4, "interpolate": True}
    assert {key: windows[key] for key in wanted} == wanted
    section, notes = follow(slower, settings, task, {"data.windows.agents", "data.windows.every"})
    given = section["windows"]
    assert "data.windows.agents=8, unlike the run's 4" in notes
    assert (given["agents"], given["least_agents"], given["every"]) == (8, 6, 2)
    with pytest.raises(ConfigError, match=r"least_agents=6 is above the 4 agents of the run's scenes: give 4 or less"):
        follow(slower, settings, task, {"data.windows.least_agents"})
    assert follow({"name": "drawn"}, settings, task) == ({"name": "drawn"}, ())


def test_the_frame_of_other_data_is_that_of_the_run_unless_it_is_given():
    fixed = read(Settings, compose("train", ["experiment=exid/v_lstm_epo", "data.frame=fixed"]))
    drawn = read(Settings, compose("train", ["experiment=exid/v_lstm_epo", "data=drawn"]))
    task = build_data(fixed.data).task
    section = compose("evaluate", ["run=x", "data=exid"])["data"]
    assert section["frame"] == "aligned"
    assert follow(section, fixed, task)[0]["frame"] == "fixed"
    assert follow(section, fixed, task, {"data.frame"})[0]["frame"] == "aligned"
    assert follow({**section, "frame": "fixed"}, drawn, task)[0]["frame"] == "fixed"


def test_games_for_an_earlier_run_are_of_its_recipe():
    settings = read(Settings, compose("train", ["experiment=rpi/v_lstm_epo"]))
    section, task = dict(settings.data), build_data(settings.data).task
    earlier = replace(settings, data={name: value for name, value in settings.data.items() if name != "recipe"})
    assert follow(section, settings, task) == (section, ())
    followed, notes = follow(section, earlier, task)
    assert followed == {**section, "recipe": 1}
    assert notes == ("data.recipe=1 instead of 2, as the run",)
    assert follow(section, earlier, task, {"data.recipe"}) == (section, ())


def test_what_does_not_fit_is_refused_with_a_reason(
    epo: Epo, trained: Path, home: Path, refused: Callable[..., str]
) -> None:
    run, game = f"run={home / 'runs' / 'v_lstm_epo'}", f"run={home / 'rpi' / 'v_lstm_epo'}"
    folder = f"data.folder={pedestrians.square(home / 'data')}"
    assert "data.folder needs a choice of data: add data=<one of" in refused("evaluate", run, "data.folder=x")
    told = refused("evaluate", run, "solver=best_response")
    assert "unknown key 'solver' of epo evaluate: solver is a choice of epo train, and a run keeps it" in told
    assert "split=all needs data=" in refused("evaluate", run, "split=all")
    assert "split=train needs data=" in refused("predict", run, "split=train", "out=o")
    message = refused("evaluate", run, "data=ucy", folder, "data.windows.dt=0.4")
    assert "data.windows.dt=0.4 does not fit the run, whose forecaster has dt 0.2: leave it out" in message
    assert "horizon 20: leave it out" in refused("predict", run, "out=o", "data=ucy", folder, "data.windows.horizon=12")
    said = (
        "with dt 0.2 s, and data=drawn has 0.1 s, and cannot be read with another time step: choose data of recordings"
    )
    assert said in refused("evaluate", run, "data=drawn", "data.like=rpi")
    assert "reads each agent's given goal, which data=ucy does not have: train a row without" in refused(
        "evaluate", game, "data=ucy", folder
    )
    assert "split=all needs recordings, and data=drawn has none" in refused(
        "evaluate", run, "data=drawn", "data.like=highway", "split=all"
    )
    assert "data.folder=nowhere: there is no such folder" in refused("evaluate", run, "data=ucy", "data.folder=nowhere")
    assert "too few" in refused("evaluate", run, "data=ucy", folder, "split=test")


def test_recordings_of_the_training_are_found_in_any_folder(
    epo: Epo, tmp_path: Path, refused: Callable[..., str]
) -> None:
    folder = tmp_path / "one"
    for place in range(4):
        pedestrians.square(folder, f"square{place}", seed=place)
    words = ("data=ucy", f"data.folder={folder}", "data.val_share=0.3")
    assert epo("generate", *words, "workers=1", "progress=false") == 0
    assert epo("train", "experiment=ucy/const_vel", *words, *SMALL, "run_dir=run", "score=test") == 0
    assert epo("evaluate", "run=run", *words, "workers=1") == 0
    (own,) = others(tmp_path / "run")
    assert (content(own)["split"], content(own)["notes"]) == ("test", [])
    assert content(own)["metrics"] == content(tmp_path / "run" / "metrics.json")["metrics"]

    folder.rename(tmp_path / "two")
    pedestrians.square(tmp_path / "two", "square9", seed=9)
    moved = ("run=run", "data=ucy", f"data.folder={tmp_path / 'two'}")
    message = refused("evaluate", *moved)
    seen = len(content(next((tmp_path / "cache").glob("ucy-*/manifest.json")))["report"]["recordings"]["test"])
    assert f"trained, or its checkpoint chosen, on {4 - seen} of these 5 recordings (square" in message
    assert "choose split=test, or split=all to score them nevertheless" in message
    assert epo("evaluate", *moved, "workers=1", "split=all") == 0
    (new,) = [file for file in others(tmp_path / "run") if file != own]
    assert content(new)["notes"] == [f"trained or validated on {4 - seen} of these 5 recordings"]

    shutil.rmtree(tmp_path / "cache")
    assert epo("evaluate", *moved, "workers=1", "data.windows.radius=9") == 0
    (last,) = [file for file in others(tmp_path / "run") if file not in (own, new)]
    assert "is unknown: its own data is not here" in content(last)["notes"][0]


def test_a_run_on_scenes_of_an_older_version_keeps_its_splits(
    epo: Epo, tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in range(4):
        pedestrians.square(tmp_path / "data", f"square{place}", seed=place)
    words = ("data=ucy", f"data.folder={tmp_path / 'data'}", "data.val_share=0.3")
    assert epo("generate", *words, "workers=1", "progress=false") == 0
    assert epo("train", "experiment=ucy/const_vel", *words, *SMALL, "run_dir=run", "score=test") == 0
    monkeypatch.setattr(versions, "VERSION", versions.VERSION + 1)
    assert epo("generate", *words, "workers=1", "progress=false") == 0
    message = refused("evaluate", "run=run")
    assert "were extracted from the same recordings by an older version of epo_lightning" in message
    assert f"`epo evaluate run=run data=ucy data.folder={tmp_path / 'data'} split=test`" in message
    assert epo("evaluate", "run=run", *words, "workers=1") == 0
    (scores,) = others(tmp_path / "run")
    assert (content(scores)["split"], content(scores)["notes"]) == ("test", [])


def test_renamed_files_are_the_same_recordings() -> None:
    recordings = [["a", "x", [["a.csv", 9, 77]]], ["b", "y", [["b.csv", 9, 77]]], ["c", "z", [["c.csv", 9, 78]]]]
    files = _files(SimpleNamespace(config={"recordings": recordings}))  # type: ignore[arg-type]
    assert files["a"] == files["b"] != files["c"]


def test_a_run_without_goals_is_scored_on_any_recordings(epo: Epo, home: Path) -> None:
    run = home / "rpi" / "v_lstm_sc"
    assert (
        epo("evaluate", f"run={run}", "data=ucy", f"data.folder={pedestrians.square(home / 'data')}", "workers=1") == 0
    )
    (file,) = others(run)
    windows = content(file)["settings"]["windows"]
    wanted = {"dt": 0.1, "history": 19, "horizon": 40, "agents": 2, "least_agents": 2, "every": 4}
    assert {key: windows[key] for key in wanted} == wanted
    assert not any("map" in note for note in content(file)["notes"]), "the run reads no map"


def test_all_runs_on_several_data_sets_and_the_table_of_them(
    epo: Epo, home: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    folder = pedestrians.square(home / "data")
    shutil.copytree(home / "rpi" / "v_lstm_epo", home / "runs" / "rpi")
    assert epo("evaluate", "runs=runs", "data=ucy", f"data.folder={folder}", "workers=1") == 0
    printed = capsys.readouterr().out
    assert "runs/rpi: left out, the run reads each agent's given goal" in printed
    assert "no run in or below runs/rpi can be scored on this data" in refused(
        "evaluate", "runs=runs/rpi", "data=ucy", f"data.folder={folder}"
    )
    assert (
        epo("evaluate", "-m", "run=runs/const_vel", "data=drawn", "data.like=highway", "data.scenes=8", "data.seed=1,2")
        == 0
    )
    assert len(others(home / "runs" / "const_vel")) == 3
    assert not (home / "multirun.yaml").exists()
    assert epo("report", "runs=runs", "out=report") == 0
    text = (home / "report" / "results.md").read_text()
    assert "## Transfer: SADE" in text
    (header,) = [line for line in text.splitlines() if line.startswith("| trained on | method | n |")][:1]
    assert "ucy, all" in header
    (row,) = [line for line in text.splitlines() if line.startswith("| drawn (highway) | V-LSTM + EPO |")][:1]
    own = content(home / "runs" / "v_lstm_epo" / "metrics.json")["metrics"]["minSADE"]
    assert f"| {own:.3f} |" in row
    assert "pedestrian 100%" in text
    assert "Transfer" in (home / "report" / "index.html").read_text()
    assert (
        (home / "report" / "transfer.csv").read_text().startswith("trained_on,method,budget,checkpoint,test_on,split")
    )
    assert "\\label{tab:transfer-sade}" in (home / "report" / "results.tex").read_text()


def test_a_changed_run_is_not_scored_anywhere(epo: Epo, home: Path, refused: Callable[..., str]) -> None:
    run, folder = home / "runs" / "v_lstm_epo", pedestrians.square(home / "data")
    file = run / "config.yaml"
    file.write_text(file.read_text().replace("seed: 0", "seed: 1"))
    for verb in (("evaluate",), ("predict", "out=o")):
        assert "was changed since the run began" in refused(
            *verb, f"run={run}", "data=ucy", f"data.folder={folder}", "workers=1"
        )


def test_nothing_is_written_beside_a_run_that_ships(
    epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert epo("evaluate", "run=rpi/v_lstm_epo", "data=drawn", "data.like=rpi", "data.scenes=8") == 0
    assert "minSADE" in capsys.readouterr().out
    assert not list(RunFolder.open("rpi/v_lstm_epo").path.glob("scores-on-*"))


def test_tiny_data_is_no_recording(epo: Epo, home: Path, refused: Callable[..., str]) -> None:
    message = refused("evaluate", f"run={home / 'rpi' / 'v_lstm_sc'}", "data=tiny")
    assert "is no SceneDataModule" in message
    assert tiny.CONF.is_dir()


@pytest.mark.parametrize("other", [{"digest": "b"}, {"share": 0.5}, {"task": Task(20, 0.2, shape="box")}])
def test_scenes_their_share_and_the_outline_of_agents_make_another_test(other: dict[str, Any]) -> None:
    """A report takes scores of one test and checkpoint for those of two versions."""
    plain = {"digest": "a", "share": 1.0, "task": Task(20, 0.2, shape="disc")}
    one, two = (
        OtherData("data", "test", SimpleNamespace(**of), cast(SceneDataset, ()), {}, ())
        for of in (plain, plain | other)
    )
    assert one.test != two.test
    assert replace(one, split="val").test != one.test == replace(one, name="b").test
