"""How long a forecast takes: what is written, that it is the forecast's time, and that nobody has to train for it."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import torch
from experiment.conftest import Epo

import epo_lightning
from epo_lightning.experiment import assembly
from epo_lightning.experiment.settings import Settings, read
from epo_lightning.experiment.timing import SAMPLES, measure
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, discover, read_json

DRAWN = ("data=drawn", "data.scenes=32", "callbacks.progress=none")


def timed(epo: Epo, tmp_path: Path, *words: str) -> RunFolder:
    """The one run that a command line leaves behind."""
    assert epo("train", *DRAWN, *words) == 0
    (run,) = discover(tmp_path)
    return run


@pytest.fixture
def untrained(epo: Epo, tmp_path: Path) -> RunFolder:
    return timed(epo, tmp_path, "experiment=exid/v_lstm_epo", "budget=untrained")


def test_what_is_written(epo: Epo, tmp_path: Path) -> None:
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


def test_a_trained_run_and_one_without_a_solver(epo: Epo, tmp_path: Path) -> None:
    run = timed(epo, tmp_path, "experiment=rpi/v_lstm_sc", "data.like=rpi", "budget=smoke", "score=time")
    found = read_json(run.metrics_file("time"))
    assert run.record["steps"] > 0
    assert (found["agents"], found["steps"], found["modes"]) == (2, None, 2)


def test_steps_are_those_that_are_taken_when_forecasting(epo: Epo, tmp_path: Path) -> None:
    words = ("experiment=exid/v_lstm_epo", "budget=untrained", "solver.steps=1", "solver.test_steps=3", "score=time")
    assert read_json(timed(epo, tmp_path, *words).metrics_file("time"))["steps"] == 3


def test_it_is_the_time_of_one_forecast_without_gradients(epo: Epo, tmp_path: Path) -> None:
    run = timed(epo, tmp_path, "experiment=exid/const_vel", "budget=untrained")

    class Slow(torch.nn.Module):
        """A forecaster that takes five milliseconds longer."""

        def __init__(self) -> None:
            super().__init__()
            self.inner = epo_lightning.load(run.checkpoint())

        def forward(self, scene: epo_lightning.Scene) -> epo_lightning.JointForecast:
            assert not torch.is_grad_enabled()
            assert not self.training
            assert len(scene.history) == 1
            time.sleep(0.005)
            return self.inner(scene)

    settings = read(Settings, run.config())
    assert 0.005 < measure(run, settings, Slow())["seconds"]["median"] < 0.05
    assert measure(run, settings)["seconds"]["median"] < 0.005


def test_an_untrained_run_is_a_whole_one(untrained: RunFolder, epo: Epo) -> None:
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


def test_a_lost_checkpoint_is_said(untrained: RunFolder) -> None:
    untrained.checkpoint("best").unlink()
    with pytest.raises(ConfigError, match=r"no checkpoint .*best\.ckpt"):
        measure(untrained, read(Settings, untrained.config()))
