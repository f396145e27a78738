"""Calibration on the history finds the pair weights of the game that was played, and leaves the others as they were."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import pad, widen

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.drive.rpi import ENERGY as RPI
from epo_lightning.drive.rpi import RPIWorld
from epo_lightning.forecast import GameParameters
from epo_lightning.forecasters.calibration import Calibration, _cost
from epo_lightning.forecasters.epo_settings import check_calibration
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, Scene, wrapped
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

ENERGY = FeatureEnergy(own=["goal", "vel", "acc", "turnr"], pair=["proximity"])
SOLVER = LevenbergMarquardt(steps=60, step_size=1.0, damping=1.0, adaptive=True)
BEFORE, AHEAD = 10, 20


def parameters(weight: torch.Tensor, modes: int, steps: int, goals: torch.Tensor) -> GameParameters:
    batch = len(weight)
    own = {"goal": 10.0, "vel": 3.0, "acc": 3.0, "turnr": 3.0}
    return GameParameters(
        own_weights={name: torch.full((batch, modes, 2), value, dtype=torch.double) for name, value in own.items()},
        pair_weights={"proximity": weight[:, None, None].expand(batch, modes, 1)},
        initial_controls=torch.zeros(batch, modes, 2, steps, 2, dtype=torch.double),
        goals=goals[:, None].expand(-1, modes, -1, -1),
    )


def played(weight: torch.Tensor, apart: float = 0.3) -> tuple[Scene, torch.Tensor]:
    """Scenes in which two agents pass each other, after ``BEFORE`` steps of the game, and the goals."""
    batch = len(weight)
    start = torch.tensor([[[-2.0, 0.0, 0.0, 1.0], [2.0, apart, torch.pi, 1.0]]], dtype=torch.double)
    start = start.expand(batch, 2, 4)
    goals = torch.tensor([[[2.0, 0.0], [-2.0, apart]]], dtype=torch.double).expand(batch, 2, 2)
    scene = Scene(history=start[:, :, None], dt=0.1, size=torch.full((batch, 2, 2), 1.2, dtype=torch.double))
    states = SOLVER(ENERGY, scene, parameters(weight, 1, BEFORE + AHEAD, goals)).states[:, 0]
    history = torch.cat((start[:, :, None], states[:, :, :BEFORE]), 2)
    return Scene(history=history, dt=0.1, size=scene.size), goals


def test_calibration_finds_the_weights_of_the_game_that_was_played() -> None:
    true = torch.tensor([2.0, 5.0, 10.0], dtype=torch.double)
    scene, goals = played(true)
    for wrong in (0.5, 2.0):
        inferred = parameters(wrong * true, 2, AHEAD, goals)
        found = Calibration()(SOLVER, ENERGY, scene, inferred)
        torch.testing.assert_close(
            found.pair_weights["proximity"], true[:, None, None].expand(3, 2, 1), rtol=1e-2, atol=0
        )
        assert found.own_weights is inferred.own_weights


@pytest.mark.parametrize(("guess", "true"), [(0.05, 20.0), (100.0, 2.0)])
def test_weights_that_are_off_by_a_large_factor_are_found_as_well(guess: float, true: float) -> None:
    """Six steps of at most a factor of e are too few for the first of these games."""
    scene, goals = played(torch.tensor([true], dtype=torch.double))
    inferred = parameters(torch.tensor([guess], dtype=torch.double), 1, AHEAD, goals)
    found = Calibration()(SOLVER, ENERGY, scene, inferred)
    assert float(found.pair_weights["proximity"]) == pytest.approx(true, rel=1e-2)


def test_several_starts_find_weights_beyond_a_jump_of_the_cost() -> None:
    """In the fifth of these games w is 13.3. An equilibrium is lost near 12.6, and a descent from 11.3 ends before it."""
    name = "rpi/v_lstm_epo_feedback"
    forecaster, scene = epo_lightning.load(name), pretrained.examples(name)[4]
    found = {}
    for starts in ((0.0,), (0.0, -0.4, -0.2, 0.2, 0.4)):
        forecaster.calibration = dataclasses.replace(forecaster.calibration, starts=starts)
        forecast = forecaster.predict(scene)
        weights = forecast.parameters
        found[len(starts)] = float(
            (weights.pair_weights["clearance"] / weights.own_weights["acc"][..., :1]).flatten()[0]
        )
    assert found[5] > 1.15 * found[1]


def test_a_start_that_is_worse_changes_nothing() -> None:
    true = torch.tensor([2.0, 5.0, 10.0], dtype=torch.double)
    scene, goals = played(true)
    inferred = parameters(1.1 * true, 2, AHEAD, goals)
    one, several = (
        Calibration(starts=starts)(SOLVER, ENERGY, scene, inferred).pair_weights["proximity"]
        for starts in ((0.0,), (0.0, 1.5, -1.5))
    )
    torch.testing.assert_close(several, one, rtol=1e-5, atol=0)
    torch.testing.assert_close(several, true[:, None, None].expand(3, 2, 1), rtol=1e-2, atol=0)


def test_games_without_a_solution_keep_their_weights() -> None:
    """Whatever the first start is; the other scene of the batch is calibrated as if it were alone."""
    scene, goals = played(torch.tensor([4.0, 4.0], dtype=torch.double))
    scene.history[0] = torch.nan
    inferred = parameters(torch.tensor([8.0, 8.0], dtype=torch.double), 1, AHEAD, goals)
    found = Calibration(starts=(0.5, -0.5))(SOLVER, ENERGY, scene, inferred).pair_weights["proximity"].flatten()
    assert found[0] == 8.0
    assert float(found[1]) == pytest.approx(4.0, rel=1e-2)


def test_headings_that_wrap_give_the_same_weights() -> None:
    """The same history, turned so that an agent's heading passes pi; recordings write it in [-pi, pi)."""
    true, angle = torch.tensor([5.0, 10.0], dtype=torch.double), 0.07
    scene, goals = played(true)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, sin], [-sin, cos]], dtype=torch.double)
    history = scene.history + torch.tensor([0.0, 0.0, angle, 0.0])
    history[..., :2] = history[..., :2] @ turn
    history[..., HEADING] = wrapped(history[..., HEADING])
    assert history[:, 1, :, HEADING].diff().amax() > 6
    inferred = parameters(2 * true, 1, AHEAD, goals @ turn)
    found = Calibration()(SOLVER, ENERGY, dataclasses.replace(scene, history=history), inferred)
    torch.testing.assert_close(found.pair_weights["proximity"].flatten(), true, rtol=1e-3, atol=0)


def test_headings_that_wrap_do_not_move_the_heading_that_is_wanted_at_a_goal() -> None:
    """The headings wanted at goals are counted from that at t0; earlier ones may be written a whole turn below it."""
    world = RPIWorld(3)
    scene, solver = world.observe(), LevenbergMarquardt(steps=20, step_size=1.0, damping=10.0, adaptive=True)
    game = world.game(scene)
    inferred = dataclasses.replace(game, pair_weights={name: 2 * weight for name, weight in game.pair_weights.items()})
    history = scene.history.clone()
    history[:, 1, :-1, HEADING] -= 2 * torch.pi
    expected, found = (
        Calibration()(solver, RPI, dataclasses.replace(scene, history=of), inferred).pair_weights["clearance"]
        for of in (scene.history, history)
    )
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
    torch.testing.assert_close(found, game.pair_weights["clearance"], rtol=1e-2, atol=0)


def test_few_steps_of_the_forecast_do_not_make_the_calibration_less_accurate() -> None:
    """Twenty Gauss-Newton steps do not arrive at the minima of these games; the weights are those of the minima anyway."""
    world = RPIWorld(3)
    scene = world.observe()
    game = world.game(scene)
    inferred = dataclasses.replace(game, pair_weights={name: 2 * weight for name, weight in game.pair_weights.items()})
    few = LevenbergMarquardt(steps=20, step_size=1.0, damping=10.0, adaptive=True)
    found, converged = (
        Calibration()(solver, RPI, scene, inferred).pair_weights["clearance"]
        for solver in (few, dataclasses.replace(few, newton_steps=100))
    )
    torch.testing.assert_close(found, converged, rtol=1e-5, atol=0)
    torch.testing.assert_close(found, game.pair_weights["clearance"], rtol=1e-2, atol=0)


def test_weights_without_an_effect_on_the_history_stay() -> None:
    scene, goals = played(torch.tensor([4.0], dtype=torch.double), apart=9.0)
    inferred = parameters(torch.tensor([8.0], dtype=torch.double), 1, AHEAD, goals)
    found = Calibration()(SOLVER, ENERGY, scene, inferred)
    torch.testing.assert_close(found.pair_weights["proximity"], inferred.pair_weights["proximity"])


def test_scenes_with_gaps_in_the_history_keep_their_weights() -> None:
    scene, goals = played(torch.tensor([4.0, 4.0], dtype=torch.double))
    seen = torch.ones(2, 2, BEFORE + 1, dtype=torch.bool)
    seen[0, 1, 3] = False
    inferred = parameters(torch.tensor([8.0, 8.0], dtype=torch.double), 1, AHEAD, goals)
    found = Calibration()(SOLVER, ENERGY, dataclasses.replace(scene, history_mask=seen), inferred)
    assert found.pair_weights["proximity"].flatten()[0] == 8.0
    assert abs(found.pair_weights["proximity"].flatten()[1] - 4.0) < 0.1


def test_absent_agents_leave_no_gap_in_the_history() -> None:
    true = torch.tensor([4.0], dtype=torch.double)
    scene, goals = played(true)
    inferred = parameters(2 * true, 1, AHEAD, goals)
    assert not pad(scene).history_mask[:, 2:].any()
    found = Calibration()(SOLVER, ENERGY, pad(scene), widen(inferred)).pair_weights["proximity"]
    torch.testing.assert_close(found[..., 0], true[:, None], rtol=1e-2, atol=0)  # the pair of both present agents


def test_the_cost_counts_deviations_in_their_own_spread() -> None:
    """Two games, missed by 3 and 4 times the noise, at s = 1 with a spread of 2; the second one has no solution."""
    missed = torch.tensor([[[3.0, 4.0], [3.0, math.nan]]])
    assert _cost(missed, torch.ones(1, 2), 2.0).tolist() == [[25.0 + 1 / 4, math.inf]]


def test_noise_moves_weights_less() -> None:
    """The noisier the observations, the nearer the weights stay to what the network decoded."""
    scene, goals = played(torch.tensor([4.0], dtype=torch.double))
    inferred = parameters(torch.tensor([8.0], dtype=torch.double), 1, AHEAD, goals)
    found = [
        float(Calibration(noise=noise)(SOLVER, ENERGY, scene, inferred).pair_weights["proximity"])
        for noise in (0.001, 0.1, 100.0)
    ]
    assert found == sorted(found)
    assert found[0] == pytest.approx(4.0, rel=1e-2)
    assert found[2] == pytest.approx(8.0, rel=1e-2)


def test_no_steps_change_nothing_and_invalid_settings_are_refused() -> None:
    scene, goals = played(torch.tensor([4.0], dtype=torch.double))
    inferred = parameters(torch.tensor([8.0], dtype=torch.double), 1, AHEAD, goals)
    assert Calibration(steps=0)(SOLVER, ENERGY, scene, inferred) is inferred
    for settings in ({"steps": -1}, {"noise": 0.0}, {"spread": -1.0}, {"starts": []}, {"starts": [math.inf]}):
        with pytest.raises(ConfigError, match=f"calibration.{next(iter(settings))}"):
            Calibration(**settings)
    with pytest.raises(ConfigError, match="the feature lane would pull agents forwards"):
        check_calibration({"steps": 3}, FeatureEnergy(["goal", "lane"], pair=["proximity"]), SOLVER)


def test_a_scene_is_calibrated_as_if_it_were_alone() -> None:
    """Scenes of a batch converge after different numbers of steps; one never does, because its history is not finite."""
    true = torch.tensor([2.0, 5.0, 10.0, 4.0], dtype=torch.double)
    scene, goals = played(true)
    scene.history[3] = torch.nan
    inferred = parameters(torch.tensor([0.5, 1.0, 3.0, 1.0]) * true, 2, AHEAD, goals)
    together = Calibration()(SOLVER, ENERGY, scene, inferred).pair_weights["proximity"]
    for index in range(4):
        alone = Calibration()(SOLVER, ENERGY, scene[index], inferred[index]).pair_weights["proximity"]
        assert torch.equal(alone[0], together[index])
    assert torch.equal(together[3], inferred.pair_weights["proximity"][3])
