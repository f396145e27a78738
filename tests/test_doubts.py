"""Doubts about scenes: which mistakes are noticed, and that data of all kinds is not doubted."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch
from games import highway_scene

import epo_lightning
from epo_lightning import Scene, pretrained
from epo_lightning.doubts import contradict, of_coordinates, of_goal_headings, of_motion, shows_motion
from epo_lightning.forecasters.base import PLAUSIBLE
from epo_lightning.forecasters.constant_velocity import ConstantVelocity
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.optimizers import Adam
from epo_lightning.scene import HEADING, SPEED
from epo_lightning.task import Task


def doubts(scene: Scene) -> list[str]:
    """All doubts about a scene."""
    return [doubt for doubt in (of_motion(scene), of_goal_headings(scene)) if doubt]


def walking(**fields: torch.Tensor) -> Scene:
    """A pedestrian who walks to the left for a second, and a robot that stands."""
    steps = torch.arange(10) / 10.0
    history = torch.zeros(1, 2, 10, 4)
    history[0, 0, :, 0] = -1.5 * steps
    history[0, 0, :, HEADING], history[0, 0, :, SPEED] = math.pi, 1.5
    return Scene(history=history, dt=0.1, goal_candidates=torch.zeros(1, 2, 1, 2), **fields)


def changed(scene: Scene, entry: int, value: float) -> Scene:
    history = scene.history.clone()
    history[:, 0, :, entry] = value
    return dataclasses.replace(scene, history=history)


@pytest.mark.parametrize(
    ("entry", "value"), [(HEADING, 180.0), (HEADING, 0.0), (SPEED, 0.0), (SPEED, -1.5), (SPEED, 15.0), (0, 0.0)]
)
def test_motions_that_contradict_headings_and_speeds_are_doubted(entry: int, value: float) -> None:
    assert not doubts(walking())
    (doubt,) = doubts(changed(walking(), entry, value))
    assert doubt.startswith("in scene(s) 0 of the batch agents do not move")


def test_reversing_is_not_doubted() -> None:
    assert not doubts(changed(changed(walking(), HEADING, 0.0), SPEED, -1.5))


@pytest.mark.parametrize("value", [math.nan, math.inf, 3e38])
def test_numbers_that_are_not_finite_are_left_to_their_own_warning(value: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for entry in (0, HEADING, SPEED):
            doubts(changed(walking(), entry, value))


def test_scenes_of_any_size_and_type_are_read() -> None:
    scene = changed(walking(goal_headings=torch.full((1, 2, 1), math.inf)), SPEED, 15.0)
    for other in (scene[slice(0, 0)], scene.to(torch.bfloat16)):
        doubts(other)
    turned = dataclasses.replace(scene, history=torch._neg_view(-scene.history))
    assert len(doubts(turned)) == 1, "goal headings that are not finite have a warning of their own"
    many = doubts(scene[[0] * 30])
    assert "in scene(s) 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 20 more of the batch agents" in many[0]
    forecaster, empty = epo_lightning.load("rpi/v_lstm_epo"), pretrained.examples("rpi/v_lstm_epo")[slice(0, 0)]
    assert forecaster.predict(empty).states.shape[0] == 0


def test_absent_agents_and_steps_are_not_doubted() -> None:
    scene = changed(walking(), SPEED, 15.0)
    assert not doubts(dataclasses.replace(scene, agent_mask=torch.tensor([[False, True]])))
    seen = torch.zeros(1, 2, 10, dtype=torch.bool)
    seen[..., -1] = True
    assert not doubts(dataclasses.replace(scene, history_mask=seen))


@pytest.mark.parametrize(("wanted", "doubted"), [(math.pi, False), (-math.pi, True), (0.0, False), (3 * math.pi, True)])
def test_goal_headings_that_were_wrapped_are_doubted(wanted: float, doubted: bool) -> None:
    scene = walking(goal_headings=torch.tensor([[[wanted], [0.0]]]))
    assert ["a goal heading differs" in doubt for doubt in doubts(scene)] == ([True] if doubted else [])


@pytest.mark.parametrize("name", pretrained.names())
def test_shipped_examples_are_not_doubted(name: str) -> None:
    assert not doubts(pretrained.examples(name))


def test_vehicles_on_lanes_are_not_doubted() -> None:
    torch.manual_seed(0)
    assert not doubts(highway_scene(50))


@pytest.mark.parametrize("name", pretrained.names())
def test_histories_of_another_length_than_those_of_the_training_are_doubted(name: str) -> None:
    forecaster, scene = epo_lightning.load(name), pretrained.examples(name)[torch.arange(2)]
    steps = scene.history.shape[2]
    assert forecaster.task.history == steps
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forecaster.predict(scene)
    short = dataclasses.replace(scene, history=scene.history[:, :, 1:], history_mask=scene.history_mask[:, :, 1:])
    with pytest.warns(UserWarning, match=f"the history has {steps - 1} steps, and that of the training had {steps}"):
        forecaster.predict(short)


@pytest.mark.parametrize("name", ["rpi/v_lstm_epo_game_refined", "rpi/v_lstm_epo_feedback"])
def test_games_without_their_ends_are_doubted(name: str) -> None:
    """They are taken to last as long as the longest one, and errors are many times as large."""
    forecaster, scene = epo_lightning.load(name), pretrained.examples(name)
    with pytest.warns(UserWarning, match="no game_steps, so each game is taken to last 82 steps"):
        endless = forecaster.predict(dataclasses.replace(scene, game_steps=None))
    assert (endless.states - forecaster.predict(scene).states)[..., :2].abs().amax() > 0.1


def test_coordinates_of_a_map_are_doubted() -> None:
    name = "highway_sim/hivt_m_epo"
    forecaster, scene = epo_lightning.load(name), pretrained.examples(name)[torch.arange(2)].to(torch.float64)
    history = scene.history + torch.tensor([5e5, 5.4e6, 0.0, 0.0])
    with pytest.warns(UserWarning, match=r"in scene\(s\) 0, 1 of the batch agents are more than 10 km from the origin"):
        forecaster.predict(dataclasses.replace(scene, history=history))


def test_constant_velocity_needs_no_history() -> None:
    forecaster = ConstantVelocity(Task(horizon=5, dt=0.1, history=19), Adam(), Unicycle())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forecaster.predict(walking())


def test_a_prediction_warns() -> None:
    name = "rpi/v_lstm_epo"
    forecaster, scene = epo_lightning.load(name), pretrained.examples(name)
    wrong = dataclasses.replace(scene, history=scene.history.flip(2))
    standing = dataclasses.replace(scene, history=scene.history * torch.tensor([1.0, 1.0, 1.0, 0.0]))
    for tried in (*[scene] * (PLAUSIBLE - 1), standing[:0]):
        forecaster.predict(tried)
    assert not shows_motion(standing)
    with pytest.warns(UserWarning, match="do not move in the direction of their headings"):
        forecaster.predict(wrong)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forecaster.predict(scene)
        forecaster.predict(wrong)  # motions are looked at until so many batches had no doubt


@pytest.mark.parametrize("name", ["rpi/v_lstm_epo", "rpi/v_lstm_epo_game_refined"])
def test_goal_headings_are_looked_at_where_forecasts_depend_on_them(name: str) -> None:
    forecaster, scene = epo_lightning.load(name), pretrained.examples(name)[:2]
    forecaster.predict(scene)
    wrapped = dataclasses.replace(scene, goal_headings=scene.goal_headings - 2 * math.pi)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        forecaster.predict(wrapped)
    said = ["a goal heading differs" in str(warning.message) for warning in caught]
    assert said == ([True] if forecaster.reads_goal_headings else [])


@pytest.mark.parametrize(
    ("one", "other", "time", "contradicts"),
    [
        *((0.0, 0.99, 1.0, False), (0.0, 1.01, 1.0, True)),  # 0.5 + 0.4 v + 0.1 / t = v at v = 1 m/s after 1 s,
        *((0.0, 2.49, 0.1, False), (0.0, 2.51j, 0.1, True)),  # and at 2.5 m/s after 0.1 s
        *((10.0, 17.6, 1.0, False), (18.2, 10.0, 1.0, True)),
        (10.0, 10.0j, 1.0, True),
    ],
)
def test_velocities_may_differ_by_slack_a_share_and_noise_of_positions(
    one: complex, other: complex, time: float, contradicts: bool
) -> None:
    assert contradict(np.array(one), np.array(other), time) == contradicts


def test_states_of_controls_that_change_fast_are_not_doubted() -> None:
    """A step goes with the speed and the heading before it."""
    start = torch.tensor([0.0, 0.0, 0.0, 1.0])
    driven = Unicycle().rollout(start, torch.tensor([[8.0, 3.0], [-4.0, 0.0]]), 1.0)
    history = torch.cat((start[None], driven))[None, None]
    assert history[0, 0, :, SPEED].tolist() == [1.0, 9.0, 5.0]
    assert not doubts(Scene(history=history[:, :, :2], dt=1.0))
    assert not doubts(Scene(history=history, dt=1.0))


def test_far_positions_of_absent_agents_and_wrapped_headings_of_absent_goals_are_not_doubted() -> None:
    far = changed(walking(), 0, 1e6)
    assert of_coordinates(far)
    assert not of_coordinates(dataclasses.replace(far, agent_mask=torch.tensor([[False, True]])))
    wrapped = walking(goal_headings=torch.tensor([[[-math.pi], [0.0]]]))
    assert of_goal_headings(wrapped)
    for mask in ({"goal_mask": torch.tensor([[[False], [True]]])}, {"agent_mask": torch.tensor([[False, True]])}):
        assert not of_goal_headings(dataclasses.replace(wrapped, **mask))
