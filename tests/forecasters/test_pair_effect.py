"""Effect of the other agents: the displacement between forecasts with and without the pair terms of the same games."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import pytest
import torch
from suites import models

from epo_lightning.data.drawn import DrawnData
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters import build_forecaster
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.metrics.forecast import pair_effect
from epo_lightning.scene import Scene


def scenes() -> Scene:
    """Two agents that pass a common point, in eight random records."""
    return DrawnData("rpi").open("test")[torch.arange(16)]


def forecaster(pair: list[str], **changes: Any) -> Any:
    configuration = models.model({"name": "epo", "modes": 2}, **changes)
    configuration["energy"] = {**copy.deepcopy(configuration["energy"]), "pair": pair}
    torch.manual_seed(0)
    return build_forecaster(configuration).eval()


@pytest.mark.parametrize("steps", [2, 8])
@torch.no_grad()
def test_it_is_the_displacement_to_a_forecaster_without_pair_terms(steps: int) -> None:
    solver = {"name": "levenberg_marquardt", "steps": steps, "step_size": 0.5, "damping": 1.0}
    game, twin = (forecaster(pair, solver=solver) for pair in (["proximity"], []))
    # Everything but the decoder of pair weights is the same in both.
    twin.load_state_dict({name: value for name, value in game.state_dict().items() if name in twin.state_dict()})
    scene = scenes()
    found, expected = game.examine(scene, game(scene)), twin(scene)
    torch.testing.assert_close(found.states_without_pairs, expected.states, atol=1e-5, rtol=0)
    effect = pair_effect(found, scene.agent_mask)
    for row in range(len(scene.history)):
        mode = int(found.probabilities[row].argmax())
        moved = [
            (found.states[row, mode, agent, step, :2] - expected.states[row, mode, agent, step, :2]).norm()
            for agent in range(2)
            for step in range(40)
        ]
        assert float(effect[row]) == pytest.approx(float(torch.stack(moved).mean()), abs=1e-5)
    assert effect.max() > 0.005, "in some of these scenes the agents avoid each other"


@torch.no_grad()
def test_it_is_a_score_of_all_scenes_and_of_every_subset() -> None:
    game, scene = forecaster(["proximity"]), scenes()
    found = game.examine(scene, game(scene))
    metrics = ForecastMetrics(("executed", "alternative"))
    metrics.update(found, scene)
    scores, values = metrics.compute(), pair_effect(found, scene.agent_mask).double()
    assert scores["pair_effect"] == pytest.approx(float(values.mean()))
    for number, name in enumerate(("executed", "alternative")):
        assert scores[f"{name}/pair_effect"] == pytest.approx(float(values[scene.subset == number].mean()))


def test_games_without_pair_terms_and_other_forecasts_have_no_such_score() -> None:
    alone, scene = forecaster([]), scenes()
    found = alone.examine(scene, alone(scene))
    assert found.states_without_pairs is None
    metrics = ForecastMetrics()
    metrics.update(found, scene)
    assert "pair_effect" not in metrics.compute()


def test_absent_agents_and_broken_forecasts_do_not_count() -> None:
    states = torch.zeros(3, 1, 2, 4, 4)
    without = states.clone()
    without[:, :, 0, :, 0], without[:, :, 1, :, 1] = 1.0, 5.0
    states[2] = torch.nan
    forecast = JointForecast(states, torch.ones(3, 1), states_without_pairs=without)
    present = torch.tensor([[True, True], [True, False], [True, True]])
    assert pair_effect(forecast, present)[:2].tolist() == [3.0, 1.0]
    assert pair_effect(forecast, present)[2].isnan()
    assert pair_effect(dataclasses.replace(forecast, states_without_pairs=None), present).isnan().all()
