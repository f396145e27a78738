"""Forecasters that solve a game to its own end, with shared weights and calibration."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from games import random_scene
from suites import ForecasterSuite, model

from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecast import JointForecast, Solution
from epo_lightning.forecasters import build_forecaster
from epo_lightning.forecasters.repeats import repeats_joined
from epo_lightning.optimizers import Adam
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

BOUNDS = {"vel": [-0.05, 2.0], "acc": [-9.81, 9.81], "turnr": [-0.2, 0.2]}
ENERGY = {
    "name": "features",
    "own": ["goal", "heading", "vel", "acc", "turnr", "velb", "accb", "turnrb"],
    "pair": ["clearance"],
    "margins": {"clearance": 0.5},
    "bounds": BOUNDS,
}
SOLVER = {
    "name": "levenberg_marquardt",
    "steps": 6,
    "newton_steps": 3,
    "step_size": 1.0,
    "damping": 1.0,
    "adaptive": True,
}
GAME = {
    "name": "epo",
    "modes": 2,
    "one_game": True,
    "own_weights": "shared",
    "game_horizon": 46,
    "calibration": {"steps": 2},
}
PARTS = {"energy": ENERGY, "solver": SOLVER, "backward": {"name": "implicit"}}


def scenes(count: int = 3, horizon: int = 40) -> Scene:
    scene = random_scene(count, 2, horizon=horizon)
    return dataclasses.replace(
        scene, goal_headings=torch.zeros(count, 2, 1), game_steps=torch.arange(42, 42 + count).clamp_max(60)
    )


def joined(solution: Solution, scene: Scene) -> Solution:
    """The solution after modes at one equilibrium have become one outcome, as that of a forecast of 40 steps."""
    return repeats_joined(solution, torch.zeros_like(solution.energy), 40, scene.agent_mask)[0]


class TestGame(ForecasterSuite):
    config = GAME
    lessons = 90
    tolerance = {
        "rtol": 0.0,
        "atol": 3e-3,
    }  # in float32, steps near the minimum are accepted or rejected by rounding errors

    def model(self, **changes: Any) -> dict[str, Any]:
        return model(self.config, **{**PARTS, **changes})

    def scene(self, scenes: int, **details: Any) -> Scene:
        scene = super().scene(scenes, **details)
        return dataclasses.replace(scene, goal_headings=torch.zeros(*scene.agent_mask.shape, 1))


def built(**changes: Any) -> Any:
    torch.manual_seed(0)
    parts = {**PARTS, **{part: changes.pop(part) for part in PARTS.keys() & changes.keys()}}
    return build_forecaster(model({**GAME, **changes}, **parts)).eval()


def test_the_forecast_is_the_beginning_of_the_solution_of_the_longer_game() -> None:
    forecaster, scene = built(), scenes()
    forecast = forecaster.predict(scene)
    assert forecast.solution is not None
    assert forecast.solution.states.shape == (3, 2, 2, 46, 4)
    assert forecast.states.shape == (3, 2, 2, 40, 4)
    assert forecast.controls is not None
    assert forecast.controls.shape == (3, 2, 2, 40, 2)
    assert torch.equal(forecast.states, forecast.solution.states[..., :40, :])
    assert forecast.parameters is not None
    assert forecast.parameters.initial_controls.shape == (3, 2, 2, 46, 2)
    with torch.no_grad():
        again = joined(forecaster.solver(forecaster.energy, scene, forecast.parameters), scene)
    torch.testing.assert_close(again.states, forecast.solution.states)


def test_the_end_of_the_game_matters_only_for_forecasters_that_solve_it() -> None:
    scene = scenes()
    for horizon, same in ((46, False), (None, True)):
        forecaster = built(game_horizon=horizon, calibration=None)
        found = [
            forecaster.predict(dataclasses.replace(scene, game_steps=end)).states for end in (None, scene.game_steps)
        ]
        assert torch.equal(*found) == same


def test_games_that_last_longer_are_cut_at_the_horizon() -> None:
    forecaster, scene = built(calibration=None), scenes()
    late = dataclasses.replace(scene, game_steps=torch.full((3,), 99))
    last = dataclasses.replace(scene, game_steps=torch.full((3,), 46))
    assert torch.equal(forecaster.predict(late).states, forecaster.predict(last).states)


def test_energies_and_equilibria_are_those_of_the_whole_game() -> None:
    forecaster, scene = built(), scenes()
    with torch.no_grad():
        forecast: JointForecast = forecaster.examine(scene, forecaster.explain(scene, forecaster(scene)))
    assert forecast.own_energy is not None
    assert forecast.pair_energy is not None
    assert forecast.solution is not None
    assert forecast.equilibrium is not None
    total = sum(value.sum(-1) for terms in (forecast.own_energy, forecast.pair_energy) for value in terms.values())
    torch.testing.assert_close(total, forecast.solution.energy)
    best = forecast.probabilities.argmax(1)
    torch.testing.assert_close(
        forecast.equilibrium.energy.float(), forecast.solution.energy[torch.arange(3), best], rtol=1e-4, atol=1e-4
    )


def test_the_modes_of_one_game_have_the_same_positive_weights_and_different_starts() -> None:
    forecaster, scene = built(calibration=None, pair_start=0.1), scenes()
    game = forecaster.predict(scene).parameters
    assert game is not None
    for weights in (*game.own_weights.values(), *game.pair_weights.values()):
        assert weights.shape[1] == 2
        assert torch.equal(weights[:, 0], weights[:, 1])
        assert (weights > 0).all()
    assert game.pair_weights["clearance"].std() > 0
    assert not torch.equal(game.initial_controls[:, 0], game.initial_controls[:, 1])


def test_weights_of_all_scenes_are_named_for_the_optimizer() -> None:
    forecaster = built()
    assert [id(parameter) for parameter in forecaster.shared_weights] == [id(forecaster.own_weights.logarithms)]
    assert built(own_weights="decoded").shared_weights == []


def test_the_row_of_the_inferred_game_gives_its_shared_weights_ten_times_the_learning_rate() -> None:
    config = compose("train", ["experiment=rpi/v_lstm_epo_game", "budget=reduced"])
    forecaster = built()
    forecaster.optimizer = Adam(**{key: value for key, value in config["optimizer"].items() if key != "name"})
    forecaster._trainer = SimpleNamespace(estimated_stepping_batches=10)
    network, shared = forecaster.configure_optimizers()["optimizer"].param_groups
    assert [id(parameter) for parameter in shared["params"]] == [id(forecaster.own_weights.logarithms)]
    assert (network["lr"], shared["lr"]) == pytest.approx((1e-3, 1e-2))
    assert len(network["params"]) + 1 == sum(parameter.requires_grad for parameter in forecaster.parameters())


def test_calibration_runs_outside_of_training_only(monkeypatch: pytest.MonkeyPatch) -> None:
    forecaster, scene = built(), scenes()
    seen = []
    monkeypatch.setattr(
        type(forecaster.calibration), "__call__", lambda self, *arguments: seen.append(1) or arguments[-1]
    )
    forecaster.train()(scene)
    assert seen == []
    forecaster.predict(scene)
    assert seen == [1]


def test_calibration_solves_its_games_as_training_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """With ``test_steps``, forecasts are refined by a few steps, but a game of the history has to be solved."""
    solver = {**SOLVER, "newton_steps": 0, "test_steps": 2}
    forecaster, scene = build_forecaster(model(GAME, **{**PARTS, "solver": solver})).eval(), scenes()
    seen = []
    monkeypatch.setattr(
        type(forecaster.calibration), "__call__", lambda self, *arguments: seen.append(arguments) or arguments[-1]
    )
    forecast = forecaster.predict(scene)
    minimiser, energy, game, parameters = seen[0]
    assert minimiser == forecaster.solver
    refined = joined(dataclasses.replace(minimiser, test_steps=None, steps=2)(energy, game, parameters), scene)
    torch.testing.assert_close(forecast.solution.states, refined.states)
    assert not torch.equal(minimiser(energy, game, parameters).states, refined.states)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"game_horizon": 39}, r"forecaster\.game_horizon must be 40 or more"),
        ({"own_weights": "decode"}, r"unknown forecaster\.own_weights 'decode': did you mean 'decoded'\?"),
        ({"calibration": {"noise": math.nan}}, r"calibration\.noise"),
        ({"calibration": {"nois": 0.1}}, r"unknown key forecaster\.calibration\.nois: .*noise"),
        ({"calibration": {"step": 3}}, "step"),
    ],
)
def test_invalid_settings_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        built(**changes)


def test_initial_strategies_after_the_forecast_are_taught_by_the_solution() -> None:
    """No data shows them. The term `initial` includes their difference from the solution's controls."""
    forecaster, scene = built(calibration=None).train(), scenes()
    forecast = forecaster(scene)
    game, solution = forecast.parameters, forecast.solution
    assert game.initial_controls.shape[3] == 46
    term = forecaster.losses(scene, forecast)["initial"][1]
    ahead = (game.initial_controls - solution.controls)[..., 40:, :].abs().mean()
    same = dataclasses.replace(solution, controls=game.initial_controls.detach())
    without = forecaster.losses(scene, dataclasses.replace(forecast, solution=same))["initial"][1]
    assert ahead > 0
    torch.testing.assert_close(term - without, ahead)
    term.backward()
    gradient = forecaster.strategies.mlp.output.bias.grad.view(2, 46, 2)
    assert (gradient[:, 40:] != 0).any()


BOTH = {"name": "both_sides", "steps": 6, "newton_steps": 4}


def test_modes_of_both_sides_have_one_game_and_one_start() -> None:
    torch.manual_seed(0)
    forecaster = build_forecaster(
        model({**GAME, "one_game": False, "initial": "zero"}, **{**PARTS, "solver": BOTH})
    ).eval()
    forecast = forecaster.predict(scenes())
    assert forecast.parameters is not None
    assert forecast.initial_states is not None
    assert forecast.initial_states.shape == forecast.states.shape == (3, 2, 2, 40, 4)
    for weights in forecast.parameters.own_weights.values():
        assert weights.shape == (3, 2, 2)


@pytest.mark.parametrize(
    ("changes", "parts", "message"),
    [
        ({"initial": "zero"}, {}, "all modes would be the same"),
        (
            {"one_game": False},
            {"solver": {"name": "enumeration", "candidates": 4}, "backward": {"name": "unrolled"}},
            "forecaster.calibration needs a solver",
        ),
        (
            {},
            {"solver": {"name": "levenberg_marquardt", "steps": 2}, "backward": {"name": "unrolled"}},
            r"forecaster\.calibration needs a solver that leads to a minimum, .* or solver\.adaptive=true",
        ),
        (
            {"calibration": None, "one_game": False},
            {
                "solver": {"name": "enumeration", "candidates": 4},
                "backward": {"name": "unrolled"},
                "objective": {"name": "conditional", "weights": {"density": 1.0, "marginal": 1.0, "regression": 1.0}},
            },
            "objective=imitation",
        ),
        (
            {"calibration": None},
            {
                "objective": {"name": "laplace", "weights": {"density": 1.0, "initial": 1.0, "goal": 1.0}},
                "backward": {"name": "detached"},
            },
            "objective=imitation",
        ),
    ],
)
def test_parts_that_do_not_fit_the_game_are_refused(changes, parts, message) -> None:
    with pytest.raises(ConfigError, match=message):
        build_forecaster(model({**GAME, **changes}, **{**PARTS, **parts}))


def test_losses_without_agents_are_finite() -> None:
    forecaster, scene = built(calibration=None).train(), scenes()
    empty = dataclasses.replace(scene, agent_mask=torch.zeros(3, 2, dtype=torch.bool))
    assert all(value.isfinite() for _, value in forecaster.losses(empty, forecaster(empty)).values())
