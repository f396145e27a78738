"""Forecasts whose hard constraints were not met are counted, in scores and by a warning."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch
from games import random_scene
from suites import model

from epo_lightning.forecast import Status
from epo_lightning.forecasters import build_forecaster
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.metrics.forecast import EQUILIBRIUM_METRICS


@pytest.fixture(scope="module")
def forecast_and_scene():
    """A forecaster with hard constraints, and three scenes: in the last one two agents stand on one spot."""
    torch.manual_seed(0)
    config = {"name": "epo", "modes": 2, "initial": "zero", "one_game": False}
    parts = {
        "energy": {"name": "features", "own": ["vel", "acc", "turnr"], "pair": ["proximity"]},
        "solver": {"name": "augmented_lagrangian", "rounds": 5},
        "backward": {"name": "implicit"},
    }
    forecaster = build_forecaster(model(config, **parts)).eval()
    horizon = forecaster.task.horizon
    scene = random_scene(3, 2, history=4, size=0.5)
    history = torch.zeros_like(scene.history)
    history[:2, 1, :, 0] = 50.0
    return forecaster, dataclasses.replace(
        scene, history=history, dt=forecaster.task.dt, future=torch.zeros(3, 2, horizon, 4), future_mask=None
    )


def test_predictions_warn_of_modes_that_violate_their_constraints(forecast_and_scene) -> None:
    forecaster, scene = forecast_and_scene
    with pytest.warns(UserWarning, match=r"in 33\.33% of the joint modes of 3 scene\(s\) the solver stopped"):
        forecast = forecaster.predict(scene)
    assert (forecast.solution.status == Status.STOPPED).tolist() == [[False] * 2, [False] * 2, [True] * 2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forecaster.predict(scene[:2])


def test_scores_have_the_share_of_modes_that_violate_their_constraints(forecast_and_scene) -> None:
    forecaster, scene = forecast_and_scene
    with torch.no_grad():
        forecast = forecaster(scene)
    metrics = ForecastMetrics(("calm", "interactive"))
    metrics.update(forecast, dataclasses.replace(scene, subset=torch.tensor([0, 0, 1])))
    scores = metrics.compute()
    assert [float(scores[name]) for name in ("stopped", "calm/stopped", "interactive/stopped")] == [
        pytest.approx(1 / 3),
        0.0,
        1.0,
    ]
    soft = dataclasses.replace(forecast, solution=dataclasses.replace(forecast.solution, constraints=None))
    metrics.reset()
    metrics.update(soft, scene)
    assert "stopped" not in metrics.compute()


def test_forecasts_with_hard_constraints_are_scored_without_a_nash_gap(forecast_and_scene) -> None:
    forecaster, scene = forecast_and_scene
    with torch.no_grad():
        examined = forecaster.examine(scene, forecaster(scene))
    assert examined.equilibrium is None
    metrics = ForecastMetrics()
    metrics.update(examined, scene)
    scores = metrics.compute()
    assert "stopped" in scores
    assert not scores.keys() & set(EQUILIBRIUM_METRICS)


def test_tests_warn_with_the_share_of_all_scenes(forecast_and_scene, monkeypatch) -> None:
    forecaster, scene = forecast_and_scene
    monkeypatch.setattr(type(forecaster), "log_dict", lambda *_, **__: None)
    with torch.no_grad():
        forecaster.test_metrics.update(forecaster(scene), scene)
    with pytest.warns(UserWarning, match=r"33\.33% of the joint modes of 3 scene"):
        forecaster.on_test_epoch_end()
