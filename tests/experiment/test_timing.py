"""Time of a forecast: the written record, the measured interval, and measurements without training."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from experiment.conftest import TINY, Epo

import epo_lightning
from epo_lightning.experiment import assembly, timing, verbs
from epo_lightning.experiment.callbacks import RandomStates
from epo_lightning.experiment.config.settings import Settings, measures
from epo_lightning.experiment.timing import SAMPLES, measure
from epo_lightning.files import read_json, write_json
from epo_lightning.forecasters import Forecaster
from epo_lightning.identity import identity
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover
from epo_lightning.schema import read

DRAWN = ("data=drawn", "data.scenes=32", "callbacks.progress=none")


def timed(epo: Epo, tmp_path: Path, *words: str) -> RunFolder:
    """The one run that a command line leaves behind."""
    assert epo("train", *DRAWN, *words) == 0
    (run,) = discover(tmp_path)
    return run


@pytest.fixture
def untrained(epo: Epo, tmp_path: Path) -> RunFolder:
    return timed(epo, tmp_path, "experiment=exid/v_lstm_epo", "budget=untrained")


def test_the_record_has_sizes_machine_and_times(epo: Epo, tmp_path: Path) -> None:
    words = ("data.agents=3", "forecaster.modes=4", "solver.steps=1", "budget=untrained", "score=time")
    run = timed(epo, tmp_path, "experiment=exid/v_lstm_epo", *words)
    found = read_json(run.metrics_file("time"))
    sizes = {"agents": 3, "steps": 1, "modes": 4, "batch": 1, "samples": SAMPLES, "threads": 1, "device": "cpu"}
    assert {key: found[key] for key in sizes} == sizes
    assert found["data_digest"] == run.record["data_digest"]
    assert found["machine"]
    seconds = found["seconds"]
    assert 0 < seconds["p10"] <= seconds["median"] <= seconds["p90"] < 1
    assert seconds["p10"] < seconds["mean"]


def test_trained_runs_and_runs_without_a_solver_are_timed(epo: Epo, tmp_path: Path) -> None:
    run = timed(epo, tmp_path, "experiment=rpi/v_lstm_sc", "data.like=rpi", "budget=smoke", "score=time")
    found = read_json(run.metrics_file("time"))
    assert run.record["steps"] > 0
    assert (found["agents"], found["steps"], found["modes"]) == (2, None, 2)


def test_recorded_steps_are_those_of_a_forecast(epo: Epo, tmp_path: Path) -> None:
    words = ("experiment=exid/v_lstm_epo", "budget=untrained", "solver.steps=1", "solver.test_steps=3", "score=time")
    assert read_json(timed(epo, tmp_path, *words).metrics_file("time"))["steps"] == 3


def opened_with(
    monkeypatch: pytest.MonkeyPatch, run: RunFolder, before: Callable[[Forecaster, epo_lightning.Scene], None]
) -> None:
    """Have the run's forecaster do something before each forecast."""
    forecaster = epo_lightning.load(run.checkpoint())
    forecaster.register_forward_pre_hook(lambda module, inputs: before(module, *inputs))
    monkeypatch.setattr(timing, "open_checkpoint", lambda *_: forecaster)


def test_the_time_is_that_of_one_forecast_without_gradients(
    epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = timed(epo, tmp_path, "experiment=exid/const_vel", "budget=untrained")

    def wait(forecaster: Forecaster, scene: epo_lightning.Scene) -> None:
        assert not torch.is_grad_enabled()
        assert not forecaster.training
        assert len(scene.history) == 1
        time.sleep(0.005)

    settings = read(Settings, run.config())
    assert measure(run, settings)["seconds"]["median"] < 0.005
    opened_with(monkeypatch, run, wait)
    assert 0.005 < measure(run, settings)["seconds"]["median"] < 0.05


def test_many_scenes_are_timed_and_none_while_caches_settle(
    epo: Epo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = timed(epo, tmp_path, "experiment=exid/const_vel", "budget=untrained")
    clock, scenes = [0.0], []

    def settle(_: Forecaster, scene: epo_lightning.Scene) -> None:
        """The first forecasts take seconds, and the others 1, 4, 9 .. us by a clock of the test: mean and median differ."""
        scenes.append(tuple(scene.current.flatten().tolist()))
        counted = len(scenes) - timing.WARM_UP
        clock[0] += 1e-6 * counted**2 if counted > 0 else 9.0

    opened_with(monkeypatch, run, settle)
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    seconds = measure(run, read(Settings, run.config()))["seconds"]
    assert seconds == pytest.approx({"mean": 3383.5e-6, "median": 2550.5e-6, "p10": 118.9e-6, "p90": 8118.1e-6})
    assert len(set(scenes)) > 10


def test_times_on_a_cpu_are_those_of_a_cpu_also_where_there_is_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert timing._device("cpu", 1) == torch.device("cpu")
    assert timing._device("auto", 1) == torch.device("cuda", 0)
    assert timing._device("gpu", [3]) == torch.device("cuda", 3)


def test_an_untrained_run_has_a_complete_run_folder(untrained: RunFolder, epo: Epo) -> None:
    record = untrained.record
    assert (record["status"], record["steps"], record["budget"]) == ("finished", 0, "untrained")
    settings = read(Settings, untrained.config())
    torch.manual_seed(settings.seed)
    drawn = assembly.build_model(settings, assembly.build_data(settings.data))
    kept = epo_lightning.load(untrained.checkpoint("best"))
    for name, parameter in drawn.named_parameters():
        assert torch.equal(parameter, kept.get_parameter(name)), name
    assert epo("evaluate", f"run={untrained.path}") == 0
    assert read_json(untrained.metrics_file("test"))["metrics"]["minSADE"] > 0


def test_one_run_has_scores_and_a_time(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("experiment=rpi/v_lstm_epo", "data.like=rpi", "budget=smoke", "score=[time,test]")
    run = timed(epo, tmp_path, *words)
    assert "next: epo report runs=" in capsys.readouterr().out
    assert run.metrics_file("test").is_file()
    assert not run.metrics_file("val").exists()
    measured = {which: run.metrics_file(which).stat().st_mtime_ns for which in ("test", "time")}
    run.metrics_file("time").unlink()
    assert epo("train", *DRAWN, *words, "existing=continue") == 0
    assert run.metrics_file("test").stat().st_mtime_ns == measured["test"], "it was scored again"
    assert run.metrics_file("time").stat().st_mtime_ns > measured["time"]
    run.metrics_file("test").unlink()
    assert epo("train", f"resume={run.path}") == 0, "it is finished, and lacks a measurement"
    assert run.metrics_file("test").is_file()


def test_a_run_that_lacks_what_it_was_asked_for_is_not_ready_for_a_report(
    untrained: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, asked in {"test": None, "time": ["test", "time"]}.items():
        config = untrained.config() | {"score": asked}
        untrained.begin(config, untrained.record)
        untrained.update(status="finished")
        verbs._print_trained(untrained)
        assert f"next: epo evaluate run={untrained.path}" in capsys.readouterr().out
        write_json(untrained.metrics_file(name), {})
        verbs._print_trained(untrained)
        left = "report" if asked is None else "evaluate"
        assert f"next: epo {left} run" in capsys.readouterr().out
        untrained.metrics_file(name).unlink()


@pytest.mark.parametrize(
    ("score", "found"),
    [
        *((None, ()), ([], ()), ("test", ("test",)), (["test"], ("test",)), ("val", ("val",)), ("time", ("time",))),
        *((("time", "test"), ("test", "time")), (["test", "time", "test"], ("test", "time"))),
    ],
)
def test_measurements_have_one_canonical_order(score: Any, found: tuple[str, ...]) -> None:
    assert measures(score) == found


@pytest.mark.parametrize("score", ["[test,tiem]", "speed", "[[test]]", "1"])
def test_unknown_measurements_are_refused(refused: Callable[..., str], score: str) -> None:
    message = refused("train", "experiment=rpi/v_lstm", *DRAWN, f"score={score}")
    assert "score must be one of test, val, time, or a list with any of test, val, time, or null" in message


def test_measurements_do_not_change_the_identity_of_a_run(untrained: RunFolder) -> None:
    config = untrained.config()
    names = {identity({**config, "score": score}, "digest") for score in (None, "test", ["test", "time"])}
    assert len(names) == 1


def test_training_time_includes_stopped_parts(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> None:
    original, epochs = RandomStates.on_train_epoch_start, []

    def slow_then_stop(self: RandomStates, *words: Any) -> None:
        epochs.append(1)
        time.sleep(1.5 if len(epochs) == 1 else 0.0)
        if len(epochs) == 3:
            raise RuntimeError("power failure")
        original(self, *words)

    words = ("experiment=rpi/v_lstm", *TINY, "trainer.max_epochs=4", "run_dir=run")
    with monkeypatch.context() as patch:
        patch.setattr(RandomStates, "on_train_epoch_start", slow_then_stop)
        with pytest.raises(RuntimeError, match="power failure"):
            epo("train", *words)
    run = RunFolder(Path("run"))
    before = torch.load(run.checkpoint("last"), weights_only=True)["callbacks"]["Timer"]["time_elapsed"]["train"]
    assert before > 1.5
    assert epo("train", "resume=run") == 0
    assert run.record["epochs"] == 4
    assert run.record["seconds"] > before


def test_a_missing_checkpoint_is_named(untrained: RunFolder) -> None:
    untrained.checkpoint("best").unlink()
    with pytest.raises(ConfigError, match=r"no checkpoint .*best\.ckpt"):
        measure(untrained, read(Settings, untrained.config()))
