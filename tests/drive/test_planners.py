"""Planners: which game they solve, from where, and what happens when they find no plan."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import epo_lightning
from epo_lightning.drive.planners import (
    BRAKING,
    ForecastPlanner,
    GamePlanner,
    Plan,
    ResponsePlanner,
    constant,
    shifted,
)
from epo_lightning.drive.rpi import RPIWorld
from epo_lightning.forecast import JointForecast, Status
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.frames import in_world
from epo_lightning.registry import ConfigError
from epo_lightning.scene import SPEED, Scene


@pytest.fixture(scope="module")
def world() -> RPIWorld:
    return RPIWorld(3, seed=1, pedestrian="plays")


@pytest.fixture(scope="module")
def epo() -> Forecaster:
    return epo_lightning.load("rpi/v_lstm_epo")


class Given(Forecaster):
    """A forecaster that returns a given forecast."""

    def __init__(self, like: Forecaster, forecast: JointForecast) -> None:
        super().__init__(like.task, like.optimizer)
        self.given = forecast

    def forward(self, scene: Scene) -> JointForecast:
        return self.given


def likely(forecast: JointForecast) -> torch.Tensor:
    return forecast.states[torch.arange(len(forecast.states)), forecast.probabilities.argmax(1)]


def test_a_plan_is_the_part_of_the_most_likely_mode(world: RPIWorld, epo: Forecaster) -> None:
    scene = world.observe()
    plan = ForecastPlanner(epo)(scene, None)
    torch.testing.assert_close(plan.states, likely(epo.predict(scene)))
    rolled = world.energy.dynamics.rollout(scene.current[:, 0], plan.controls.double(), scene.dt)
    torch.testing.assert_close(rolled.float(), plan.states[:, 0], rtol=0, atol=1e-4)


def test_the_nearest_mode_is_kept(world: RPIWorld, epo: Forecaster) -> None:
    scene = world.observe()
    forecast = epo.predict(scene)
    unlikely = forecast.probabilities.argmin(1)
    rows = torch.arange(3)
    states = forecast.states[rows, unlikely]
    before = torch.cat((states[:, :, :1], states[:, :, :-1]), 2)  # one step later it is the unlikely mode
    previous = Plan(torch.zeros(3, 40, 2), before, torch.ones(3, dtype=torch.bool))
    kept = ForecastPlanner(epo, keep=True)(scene, previous)
    torch.testing.assert_close(kept.states, states)
    torch.testing.assert_close(ForecastPlanner(epo)(scene, previous).states, likely(forecast))
    lost = forecast.states.clone()
    lost[rows, 1 - unlikely] = torch.nan
    broken = Given(epo, dataclasses.replace(forecast, states=lost))
    found = ForecastPlanner(broken, keep=True)(scene, previous)
    assert found.found.all(), "no mode that is not finite is the nearest one"
    torch.testing.assert_close(found.states, states)


def test_pair_terms_and_warm_starts_change_the_solved_game(world: RPIWorld, epo: Forecaster) -> None:
    scene = world.observe().to(torch.float32)
    forecast = epo.predict(scene)
    game = forecast.parameters
    assert game is not None
    assert forecast.solution is not None
    mode, rows = forecast.probabilities.argmax(1), torch.arange(3)
    alone = dataclasses.replace(game, pair_weights={name: 0 * weight for name, weight in game.pair_weights.items()})
    wanted = epo.solve(scene, alone).states[rows, mode]
    torch.testing.assert_close(ForecastPlanner(epo, pair_terms=False)(scene, None).states, wanted)
    joint = torch.cat((torch.zeros_like(forecast.solution.controls[..., :1, :]), forecast.solution.controls), -2)
    previous = Plan(torch.zeros(3, 40, 2), torch.zeros(3, 2, 40, 4), torch.ones(3, dtype=torch.bool), joint)
    onward = dataclasses.replace(game, initial_controls=forecast.solution.controls)
    warm = ForecastPlanner(epo, warm=True)
    torch.testing.assert_close(warm(scene, previous).states, epo.solve(scene, onward).states[rows, mode])
    torch.testing.assert_close(warm(scene, None).states, likely(forecast))


def test_a_plan_is_found_where_its_own_mode_is_finite_and_its_solver_did_not_stop(
    world: RPIWorld, epo: Forecaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What happens in modes that are not chosen does not matter."""
    scene = world.observe()
    forecast = epo.predict(scene)
    solution = forecast.solution
    assert solution is not None
    chosen = forecast.probabilities.argmax(1).tolist()
    states, solved, status = forecast.states.clone(), solution.states.clone(), solution.status.clone()
    status[:] = Status.COMPLETED
    for values in (states, solved):
        values[0, chosen[0], 1, 3, 0] = torch.nan  # the other agent's future belongs to the plan
        values[2, 1 - chosen[2]] = torch.nan
    known = ForecastPlanner(Given(epo, dataclasses.replace(forecast, states=states)))(scene, None)
    assert known.found.tolist() == [False, True, True]
    status[1, chosen[1]], status[2, 1 - chosen[2]] = Status.STOPPED, Status.STOPPED
    solution = dataclasses.replace(solution, states=solved, status=status)
    forecast = dataclasses.replace(forecast, solution=solution)
    monkeypatch.setattr(type(epo), "forward", lambda _self, _scene: forecast)
    plan = ForecastPlanner(epo)(scene, None)
    assert plan.found.tolist() == [False, False, True]
    resting = plan.or_else(known, scene)
    torch.testing.assert_close(resting.controls[1], shifted(known.controls, known.controls.shape[1])[1])


def test_options_of_a_game_need_a_game() -> None:
    baseline = epo_lightning.load("rpi/v_lstm_sc")
    for options in ({"warm": True}, {"pair_terms": False}):
        with pytest.raises(ConfigError, match="SceneConsistent solves no game"):
            ForecastPlanner(baseline, **options)


def test_forecasts_without_controls_are_tracked(world: RPIWorld, epo: Forecaster) -> None:
    scene = world.observe()
    forecast = epo.predict(scene)
    plan = ForecastPlanner(Given(epo, JointForecast(forecast.states, forecast.probabilities)))(scene, None)
    torch.testing.assert_close(plan.controls, ForecastPlanner(epo)(scene, None).controls, rtol=0, atol=1e-3)


def test_a_response_is_the_best_one_to_the_forecast(world: RPIWorld, epo: Forecaster) -> None:
    scene = world.observe().to(torch.float64)
    game = world.game(scene)
    for forecaster in (None, epo):
        plan = ResponsePlanner(world.energy, world.game, forecaster)(scene, None)
        assert plan.joint is not None
        other = plan.states[:, 1]
        if forecaster is None:
            straight = world.energy.dynamics.rollout(scene.current[:, 1], torch.zeros_like(plan.joint[:, 0, 1]), 0.1)
            torch.testing.assert_close(other, straight)
        else:
            torch.testing.assert_close(other[:, :40].float(), likely(epo.predict(scene))[:, 1], rtol=0, atol=1e-3)
        cost = world.energy(scene, game, plan.joint)
        for seed in range(4):
            noise = torch.zeros_like(plan.joint)
            noise[:, :, 0] = 0.01 * torch.randn(noise[:, :, 0].shape, generator=torch.Generator().manual_seed(seed))
            assert bool((world.energy(scene, game, plan.joint + noise) > cost).all())


def test_others_without_a_finite_forecast_are_expected_to_go_straight_on(world: RPIWorld, epo: Forecaster) -> None:
    scene = world.observe()
    forecast = epo.predict(scene)
    assert forecast.controls is not None
    broken = dataclasses.replace(forecast, controls=torch.full_like(forecast.controls, torch.nan))
    known, unknown = (
        ResponsePlanner(world.energy, world.game, forecaster)(scene, None) for forecaster in (None, Given(epo, broken))
    )
    torch.testing.assert_close(unknown.states, known.states)


def test_a_plan_is_found_if_every_best_response_is(world: RPIWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    for lacking in (0, 1):
        planner = GamePlanner(world.energy, world.game, rounds=1)
        monkeypatch.setattr(
            planner, "_descend", lambda *given, no=lacking: (given[2], torch.full((3,), given[3] != no))
        )
        assert not planner(world.observe(), None).found.any()


def test_iterated_best_responses_meet_the_joint_minimum(world: RPIWorld) -> None:
    scene = world.observe()
    joint, iterated = (GamePlanner(world.energy, world.game, rounds)(scene, None) for rounds in (None, 20))
    assert float((joint.states - iterated.states)[..., :2].abs().max()) < 0.05


def test_a_step_without_a_plan_follows_the_last_one() -> None:
    world = RPIWorld(2, seed=1)
    scene = world.observe()
    controls = torch.arange(2 * 5 * 2.0).view(2, 5, 2)
    last = Plan(controls, torch.arange(2 * 2 * 5 * 4.0).view(2, 2, 5, 4), torch.ones(2, dtype=torch.bool))
    broken = Plan(
        torch.full((2, 5, 2), torch.nan), torch.full((2, 2, 5, 4), torch.nan), torch.tensor([False, False]), None
    )
    plan = broken.or_else(last, scene)
    again = dataclasses.replace(broken, joint=torch.full((2, 1, 2, 5, 2), torch.nan)).or_else(last, scene)
    assert again.joint is not None
    assert again.joint.isfinite().all(), "the next step has a warm start"
    torch.testing.assert_close(plan.controls, shifted(controls, 5))
    torch.testing.assert_close(plan.states[:, :, :-1], last.states[:, :, 1:])
    assert not plan.found.any()
    part = dataclasses.replace(last, found=torch.tensor([True, False])).or_else(last, scene)
    torch.testing.assert_close(part.controls[0], controls[0])
    torch.testing.assert_close(part.controls[1], shifted(controls, 5)[1])
    stop = broken.or_else(None, scene)
    assert bool((stop.controls[..., 0] >= -BRAKING - 1e-9).all())
    speed = scene.current[:, 0, SPEED] + 0.1 * stop.controls[..., 0].double().sum(1)
    torch.testing.assert_close(speed, torch.zeros_like(speed), rtol=0, atol=0.5)


def test_a_first_step_without_a_plan_stops_among_more_agents_than_the_plan_has() -> None:
    """In traffic, scenes have eight agents, and a forecaster plans for four of them."""
    scene = Scene(torch.ones(2, 8, 1, 4), dt=0.2)
    nothing = torch.full((2, 4, 5, 4), torch.nan)
    broken = Plan(torch.full((2, 5, 2), torch.nan), nothing, torch.zeros(2, dtype=torch.bool))
    stop = broken.or_else(None, scene)
    torch.testing.assert_close(stop.states, torch.ones(2, 4, 5, 4))
    assert stop.controls.isfinite().all()


def test_shifted_strategies_are_padded_or_cut() -> None:
    controls = torch.arange(8.0).view(4, 2)
    torch.testing.assert_close(shifted(controls, 3), controls[1:])
    torch.testing.assert_close(shifted(controls, 2), controls[1:3])
    torch.testing.assert_close(shifted(controls, 5), torch.cat((controls[1:], torch.zeros(2, 2))))


def test_a_plan_keeps_its_place_in_the_world_when_the_frame_of_scenes_moves() -> None:
    frames = torch.tensor([[[100.0, -50.0, 0.5]], [[103.0, -49.0, 0.9]]], dtype=torch.double)
    before, now = (Scene(torch.zeros(1, 2, 1, 4), dt=0.1, frame=frame) for frame in frames)
    states = torch.randn(1, 2, 5, 4, dtype=torch.double)
    plan = Plan(torch.zeros(1, 5, 2), states, torch.ones(1, dtype=torch.bool)).seen_from(before, now)
    torch.testing.assert_close(in_world(plan.states, frames[1]), in_world(states, frames[0]))


def test_agents_brake_until_they_stand_forwards_and_backwards() -> None:
    speed = torch.tensor([1.0, -1.0, 0.0])
    rate = constant(speed, -2.0, 10, 0.1)[..., 0]
    torch.testing.assert_close(rate[:, :5], torch.tensor([[-2.0], [2.0], [0.0]]).expand(-1, 5))
    torch.testing.assert_close(rate[:, 5:], torch.zeros(3, 5), rtol=0, atol=1e-6)
