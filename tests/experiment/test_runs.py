"""Run folders: their contents, reproducibility, and continuation of stopped runs."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import torch
import yaml
from experiment import tiny
from experiment.conftest import TINY, Epo
from filelock import FileLock

import epo_lightning
from epo_lightning.experiment import score_files
from epo_lightning.experiment import train as training
from epo_lightning.files import read_json, write_json
from epo_lightning.forecasters.checkpoint import read_checkpoint
from epo_lightning.identity import identity, row_identity
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.solvers.gauss_newton.kernel import interface

ROW = "experiment=rpi/v_lstm_sc"


def weights(folder: str | Path, which: str = "last") -> dict[str, torch.Tensor]:
    return torch.load(RunFolder(Path(folder)).checkpoint(which), weights_only=True)["state_dict"]


def test_a_folder_with_a_run_on_other_data_is_named_as_such(epo: Epo, refused: Callable[..., str]) -> None:
    words = ("train", ROW, "data=drawn", "budget=smoke", "callbacks.progress=none", "run_dir=run")
    assert epo(*words, "data.scenes=32") == 0
    message = refused(*words, "data.scenes=48")
    assert "run holds a run on other data (digest " in message
    assert "choose another run_dir=<folder>" in message
    assert "data.scenes: 32 there, 48 here" in refused(*words, "data.scenes=48", "existing=continue")
    assert epo_lightning.load("run").configuration == epo_lightning.load("run/checkpoints/best.ckpt").configuration


def test_a_missing_folder_is_answered_by_the_one_beside_it_with_a_similar_name(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    there = tmp_path / "v_lstm_epo-s0-1a2b3c"
    there.mkdir()
    (tmp_path / "notes").mkdir()
    missing = tmp_path / "v_lstm_epo-s0-9f8e7d"
    for words in (f"evaluate run={missing}", f"evaluate runs={missing}", f"report runs={missing}"):
        assert f"did you mean {there}?" in refused(*words.split())
    (tmp_path / "best.ckpt").touch()
    assert "best.ckpt is a file, and not a run folder" in refused("evaluate", f"run={tmp_path / 'best.ckpt'}")
    for nothing in (tmp_path / "zzz", tmp_path / "no" / "such" / "folder"):
        assert "did you mean" not in refused("evaluate", f"run={nothing}").partition("The folder")[0]


@pytest.fixture
def in_japan(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine whose clock shows another time than UTC."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "JST-9")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("in_japan")
def test_a_run_folder_holds_what_a_run_needs(epo: Epo) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run", "seed=3") == 0
    run = RunFolder.open("run")
    record, config = run.record, run.config()
    assert record["status"] == "finished"
    assert record["seed"] == config["seed"] == 3
    assert record["data_digest"] == "tiny-64-0"
    assert record["identity"] == identity(config, "tiny-64-0")
    assert record["row"] == row_identity(config, "tiny-64-0") == row_identity({**config, "seed": 4}, "tiny-64-0")
    began = datetime.strptime(record["began"], "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    assert abs((datetime.now(UTC) - began).total_seconds()) < 3600
    assert record["versions"]["torch"]
    assert bool(record["versions"]["compiled layer"]) == (not isinstance(interface.find(), str))
    assert record["parameters"] > 0
    assert "experiment=rpi/v_lstm_sc" in record["command"]
    assert (run.logs / "metrics.csv").read_text().count("\n") > 2
    assert run.checkpoint("best").is_file()
    assert run.checkpoint("last").is_file()
    assert not run.metrics_file().exists(), "the test split is nobody's business while training"
    assert not run.progress_file.exists(), "nobody works on it any more"
    assert "run_dir" in yaml.safe_load(run.config_file.read_text())


def test_the_next_commands_are_quoted_for_a_shell(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    def following(*words: str) -> list[str]:
        assert epo(*words) == 0
        (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("next: epo "))
        return shlex.split(line)[2:]

    trained = following(
        "train", ROW, "data=tiny", "budget=untrained", "callbacks.progress=none", "run_dir='my runs/a b'"
    )
    assert trained[0] == "evaluate"
    scored = following(*trained)
    assert scored[0] == "report"
    assert epo(*scored, "out=out") == 0


def test_checkpoints_load_from_anywhere_and_forecast(epo: Epo, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert epo("train", "experiment=rpi/v_lstm_epo", *TINY, "run_dir=run") == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    forecast = epo_lightning.load(tmp_path / "run" / "checkpoints" / "best.ckpt").predict(tiny.scenes(3, seed=9))
    assert forecast.states.shape == (3, 2, 2, 40, 4)


def test_the_same_seed_gives_the_same_metrics_and_another_does_not(epo: Epo) -> None:
    for name, seed in (("one", 0), ("two", 0), ("three", 1)):
        assert epo("train", ROW, *TINY, f"run_dir={name}", f"seed={seed}") == 0
        assert epo("evaluate", f"run={name}") == 0
    one, two, three = (RunFolder(Path(name)).metrics_file().read_bytes() for name in ("one", "two", "three"))
    assert one == two
    assert one != three
    assert set(json.loads(one)) == {"split", "data_digest", "checkpoint", "metrics", "digest"}


def test_constant_velocity_has_a_run_folder_and_scores(epo: Epo) -> None:
    assert epo("train", "experiment=rpi/const_vel", *TINY, "run_dir=run") == 0
    assert epo("evaluate", "run=run") == 0
    assert RunFolder(Path("run")).record["parameters"] == 0
    assert json.loads(Path("run/metrics.json").read_text())["metrics"]["minSADE"] > 0


def test_validation_scores_go_to_their_own_file(epo: Epo) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    assert epo("evaluate", "run=run", "split=val") == 0
    assert Path("run/metrics-val.json").is_file()
    assert not Path("run/metrics.json").exists()


def test_two_evaluations_do_not_write_at_the_same_moment(
    epo: Epo, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    monkeypatch.setattr(score_files, "PATIENCE", 0.1)
    with FileLock(f"run/{score_files.LOCK}"):
        for words in ((), ("data=drawn", "data.like=rpi", "data.scenes=8")):
            assert "another process has written scores of run for" in refused("evaluate", "run=run", *words)
    assert epo("evaluate", "run=run") == 0


def test_scores_that_are_stored_are_computed_again_in_a_folder_that_cannot_be_written(
    epo: Epo, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    assert epo("evaluate", "run=run") == 0

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "run/.scores.lock")

    monkeypatch.setattr(score_files.FileLock, "acquire", refuse)
    assert epo("evaluate", "run=run") == 0


def test_an_interruption_says_how_to_continue_what_has_begun(tmp_path: Path) -> None:
    for run, notes in ((RunFolder(tmp_path / "waiting"), []), (RunFolder(tmp_path / "begun"), ["continue with"])):
        if notes:
            run.begin({"seed": 0}, {})
        with pytest.raises(KeyboardInterrupt) as ended, training._continuation(run):
            raise KeyboardInterrupt
        assert [note.partition(" `")[0] for note in getattr(ended.value, "__notes__", [])] == notes


def test_a_finished_run_is_never_overwritten(
    epo: Epo, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("train", ROW, *TINY[:-1], "callbacks.progress=lines", "run_dir=run")
    assert epo(*words) == 0
    assert "V-LSTM + SC, seed 0: at most 8 steps, in run\n" in capsys.readouterr().out
    before = weights("run")
    message = refused(*words)
    assert "nothing is overwritten" in message
    assert "existing=continue" in message
    assert "is finished" in refused("train", "resume=run")
    assert epo(*words, "existing=continue") == 0
    assert all(torch.equal(before[key], value) for key, value in weights("run").items())


def test_another_configuration_does_not_continue_a_run(epo: Epo, refused: Callable[..., str]) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    RunFolder(Path("run")).update(status="training")
    assert "optimizer.lr" in refused("train", ROW, *TINY, "run_dir=run", "existing=continue", "optimizer.lr=0.5")
    assert "keeps its own configuration" in refused("train", "resume=run", "seed=4")
    run = RunFolder(Path("run"))
    run.update(data_digest="other", identity=identity(run.config(), "other"))
    assert "the data of run has changed" in refused("train", "resume=run")


def test_a_changed_config_file_is_refused(epo: Epo, refused: Callable[..., str]) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    file = Path("run/config.yaml")
    text = file.read_text()
    file.write_text(text.replace("goal: energy", "goal: all"))
    assert file.read_text() != text
    RunFolder(Path("run")).update(status="training")
    changed = "was changed since the run began"
    assert f"run/config.yaml or run.json beside it {changed}" in refused("train", "resume=run")
    RunFolder(Path("run")).update(status="finished")
    # Also where the changed settings name data that do not exist, and where only the name of the row was changed.
    for before, after in (
        ("seed: 0", "seed: 1"),
        ("name: tiny,", "name: tiny, seed: 77,"),
        ("name: tiny,", "name: tiny, when: 2020-01-01,"),
        ("title: V-LSTM", "title: EPO"),
        ("experiment: rpi", "was: rpi"),
        ("budget: {name: smoke}", "budget: smoke, but longer"),
    ):
        file.write_text(text.replace(before, after, 1))
        assert file.read_text() != text
        for words in (("evaluate",), ("predict", "out=out"), ("export", "out=out.pt2"), ("drive",), ("explore",)):
            assert changed in refused(*words, "run=run")
        assert changed in refused("train", ROW, *TINY, "run_dir=run", "existing=continue")
    file.write_text(text)
    assert epo("evaluate", "run=run") == 0


@pytest.mark.parametrize(("key", "value"), [("identity", 7), ("data_digest", None)])
def test_a_damaged_record_is_not_blamed_on_the_configuration(
    epo: Epo, refused: Callable[..., str], key: str, value: object
) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    RunFolder(Path("run")).update(**{key: value})
    assert f"run/run.json: {key} is {value!r}, expected text" in refused("evaluate", "run=run")


def test_scores_that_were_edited_are_found_and_written_again(epo: Epo, refused: Callable[..., str]) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run", "score=test") == 0
    file = Path("run/metrics.json")
    written = read_json(file)
    write_json(file, {**written, "metrics": {**written["metrics"], "minSADE": 0.01}})
    assert "run/metrics.json was edited: its scores do not have the digest" in refused(
        "report", "runs=run", "out=report"
    )
    assert epo("evaluate", "run=run") == 0
    assert read_json(file) == written
    assert epo("report", "runs=run", "out=report", "scenes=false") == 0


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_scored(
    epo: Epo, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write everywhere
    assert "run cannot be written, and its scores are kept there" in refused("evaluate", "run=run", "split=val")
    assert not Path("run/metrics-val.json").exists()


def test_checkpoints_that_do_not_fit_are_refused(epo: Epo, refused: Callable[..., str]) -> None:
    assert epo("train", ROW, *TINY, "run_dir=sc") == 0
    assert epo("train", "experiment=rpi/v_lstm", *TINY, "run_dir=marginal") == 0
    assert "another architecture" in refused("evaluate", "run=sc", "checkpoint=marginal/checkpoints/best.ckpt")
    assert epo("train", ROW, *TINY, "goal=all", "run_dir=all") == 0
    message = refused("evaluate", "run=sc", "checkpoint=all/checkpoints/best.ckpt")
    assert "goal is all in the checkpoint and energy in the run's config.yaml" in message
    assert "not a checkpoint" in refused("evaluate", "run=sc", "checkpoint=sc/run.json")
    assert "no checkpoint" in refused("evaluate", "run=sc", "checkpoint=nowhere.ckpt")
    Path("marginal/checkpoints/best.ckpt").unlink()
    assert "best.ckpt; the folder has last.ckpt" in refused("evaluate", "run=marginal")
    Path("sc/checkpoints/best.ckpt").write_bytes(b"half a file")
    assert "not a checkpoint" in refused("predict", "run=sc", "out=out")


def test_forecasts_are_written_with_an_index(epo: Epo, refused: Callable[..., str]) -> None:
    from safetensors.torch import load_file

    assert epo("train", "experiment=rpi/v_lstm_epo", *TINY, "run_dir=run") == 0
    assert epo("predict", "run=run", "out=out", "scenes=5", "figures=1") == 0
    tensors, index = load_file("out/forecasts.safetensors"), json.loads(Path("out/index.json").read_text())
    assert tensors["states"].shape == (5, 2, 2, 40, 4)
    assert set(tensors) == set(index["tensors"])
    assert Path("out/figures/joint_predictions.png").stat().st_size > 1000
    assert "nothing is overwritten" in refused("predict", "run=run", "out=out")
    Path("out/index.json").unlink()  # an interrupted command leaves no index
    assert epo("predict", "run=run", "out=out", "scenes=4", "figures=1") == 0
    assert load_file("out/forecasts.safetensors")["states"].shape == (4, 2, 2, 40, 4)


def test_a_sweep_trains_every_row_and_the_report_shows_them(epo: Epo, capsys: pytest.CaptureFixture[str]) -> None:
    assert epo("train", "-m", "sweeps=rpi_main", *TINY, "seed=0", "runs=runs") == 0
    assert epo("evaluate", "runs=runs") == 0
    assert epo("report", "runs=runs", "out=out") == 0
    text = Path("out/results.md").read_text()
    assert "Budget: smoke" in text
    for title in ("Constant velocity", "V-LSTM", "V-LSTM + SC", "V-LSTM + EPO"):
        assert title in text
    assert Path("out/figures/joint_predictions.png").is_file()
    assert Path("out/figures/learned_weights.png").is_file()
    assert sorted(path.name for path in Path.cwd().iterdir()) == ["out", "runs"]


def test_files_are_replaced_as_a_whole(tmp_path: Path) -> None:
    file = tmp_path / "metrics.json"
    write_json(file, {"a": 1})
    with pytest.raises(TypeError):
        write_json(file, {"a": object()})
    assert json.loads(file.read_text()) == {"a": 1}
    assert list(tmp_path.iterdir()) == [file]


def test_missing_checkpoints_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no checkpoint at"):
        read_checkpoint(tmp_path / "no.ckpt")
