"""The loop that drives a planner: which controls are executed, and what a planner is told about its last plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from epo_lightning.drive.episodes import chunks, play
from epo_lightning.drive.planners import Plan
from epo_lightning.drive.world import Outcome, World
from epo_lightning.scene import Scene

EPISODES, AGENTS, STEPS, PLANNED = 3, 2, 3, 3
GOING = ([0, 1, 2], [0, 2], [0, 2], [])
"""Indices of the episodes that go on at every step: the second one ends after the first step."""
FRAMES = torch.tensor(
    [
        [[10.0, 20.0, 0.0], [5.0, 5.0, 1.0], [-30.0, 4.0, 2.0]],
        [[12.0, 21.0, 0.5], [0.0, 0.0, 0.0], [-33.0, 3.0, 3.0]],
        [[15.0, 19.0, -0.4], [0.0, 0.0, 0.0], [-35.0, 9.0, -3.0]],
    ],
    dtype=torch.double,
)
"""Origin and rotation of the frame of every step and episode."""


def planned(step: int, episode: int) -> tuple[Tensor, Tensor]:
    """The controls [K, 2] that are planned at a step, and the states [N, K, 4] in the world's coordinates."""
    random = torch.Generator().manual_seed(10 * step + episode)
    controls = torch.randn(PLANNED, 2, generator=random, dtype=torch.double)
    return controls, 10 * torch.randn(AGENTS, PLANNED, 4, generator=random, dtype=torch.double)


def moved(states: Tensor, frame: Tensor, to_world: bool) -> Tensor:
    """States from the frame of a scene to the world, or from the world to the frame."""
    x, y, heading, speed = states.unbind(-1)
    east, north, turn = frame.tolist()
    cosine, sine = math.cos(turn), math.sin(turn)
    if to_world:
        return torch.stack((cosine * x - sine * y + east, sine * x + cosine * y + north, heading + turn, speed), -1)
    x, y = x - east, y - north
    return torch.stack((cosine * x + sine * y, cosine * y - sine * x, heading - turn, speed), -1)


class MovingFrames:
    """A world of three steps, whose scenes are in a frame of their own at every step."""

    dt = 0.5

    def __init__(self) -> None:
        self.driven: list[Tensor] = []

    def reset(self, episodes: Sequence[int]) -> None:
        self.step = 0

    @property
    def going(self) -> Tensor:
        return torch.tensor(GOING[self.step], dtype=torch.long)

    def observe(self) -> Scene:
        frame = FRAMES[self.step, self.going]
        there = torch.ones(len(frame), AGENTS, dtype=torch.bool)
        there[self.going == 0, 1] = False
        history = torch.zeros(len(frame), AGENTS, 1, 4, dtype=torch.double)
        return Scene(history, dt=self.dt, frame=frame, agent_mask=there)

    def advance(self, controls: Tensor) -> None:
        self.driven.append(controls)
        self.step += 1

    def outcome(self) -> Outcome:
        return Outcome(
            states=torch.zeros(EPISODES, AGENTS, STEPS + 1, 4, dtype=torch.double),
            agent_mask=torch.ones(EPISODES, AGENTS, STEPS + 1, dtype=torch.bool),
            size=torch.ones(EPISODES, AGENTS, 2, dtype=torch.double),
            progress=torch.zeros(EPISODES, STEPS + 1, dtype=torch.double),
            measures={},
        )


class Forgetful:
    """A planner that finds no plan in the last episode after the first step.

    Attributes:
        told: the last plans that it was told, in the frames of the scenes.
    """

    def __init__(self, world: MovingFrames) -> None:
        self.world, self.told = world, list[Plan | None]()

    def __call__(self, scene: Scene, previous: Plan | None) -> Plan:
        self.told.append(previous)
        step, going = self.world.step, self.world.going.tolist()
        made = [planned(step, episode) for episode in going]
        frames = FRAMES[step, going]
        controls = torch.stack([each for each, _ in made])
        states = torch.stack([moved(each, frame, False) for (_, each), frame in zip(made, frames, strict=True)])
        found = torch.tensor([step == 0 or episode != 2 for episode in going])
        controls[~found], states[~found] = torch.nan, torch.nan
        return Plan(controls, states, found)


@pytest.fixture
def world() -> MovingFrames:
    return MovingFrames()


def test_the_rest_of_the_last_plan_is_driven_where_none_is_found(world: MovingFrames) -> None:
    episodes = play(cast(World, world), Forgetful(world), range(EPISODES))
    first, last = [[planned(step, episode)[0] for step in range(STEPS)] for episode in (0, 2)]
    expected = [
        [first[0][0], planned(0, 1)[0][0], last[0][0]],
        [first[1][0], last[0][1]],
        [first[2][0], last[0][2]],
    ]
    assert len(world.driven) == STEPS
    for driven, wanted in zip(world.driven, expected, strict=True):
        torch.testing.assert_close(driven, torch.stack(wanted))
    assert episodes.found.tolist() == [[True, True, True], [True, True, True], [True, False, False]]
    for episode, place in ((0, 0), (2, -1)):
        torch.testing.assert_close(episodes.controls[episode], torch.stack([each[place] for each in expected]))
    torch.testing.assert_close(episodes.controls[1, 0], expected[0][1])
    assert episodes.controls[1, 1:].isnan().all(), "the episode is over"


def test_a_planner_is_told_its_last_plan_in_the_frame_of_the_present_scene(world: MovingFrames) -> None:
    """In the world's coordinates, it is where it was; in the last episode it is the rest of the first plan at the end."""
    planner = Forgetful(world)
    play(cast(World, world), planner, range(EPISODES))
    assert planner.told[0] is None
    rest = planned(0, 2)[1][:, [1, 2, 2]]
    expected = [[planned(0, 0)[1], planned(0, 2)[1]], [planned(1, 0)[1], rest]]
    for step, wanted in enumerate(expected, 1):
        told = planner.told[step]
        assert told is not None
        assert len(told.states) == 2, "the episode that is over is left out"
        for states, frame, there in zip(told.states, FRAMES[step, GOING[step]], wanted, strict=True):
            torch.testing.assert_close(moved(states, frame, True), there)
    assert planner.told[2] is not None
    assert planner.told[2].found.tolist() == [True, False]
    torch.testing.assert_close(planner.told[2].controls[1, :2], planned(0, 2)[0][1:])


def test_plans_are_kept_in_coordinates_of_the_world(world: MovingFrames) -> None:
    plans = play(cast(World, world), Forgetful(world), range(EPISODES), keep_plans=True).plans
    assert len(plans) == STEPS
    last = planned(0, 2)[1][..., :2]
    for step, (plan, wanted) in enumerate(zip(plans, (last, last[:, [1, 2, 2]], last[:, [2, 2, 2]]), strict=True)):
        torch.testing.assert_close(plan[0, 0], planned(step, 0)[1][0, :, :2])
        assert plan[0, 1].isnan().all(), "this agent is not there"
        torch.testing.assert_close(plan[2], wanted)
        assert bool(plan[1].isnan().all()) == (step > 0)


@pytest.mark.parametrize(
    ("together", "expected"), [(2, [[0, 1], [2, 3], [4]]), (5, [[0, 1, 2, 3, 4]]), (8, [[0, 1, 2, 3, 4]])]
)
def test_all_episodes_are_driven_in_chunks_of_those_that_can_be_begun_together(together: int, expected: object) -> None:
    class Five(SimpleNamespace):
        def __len__(self) -> int:
            return 5

    assert [list(chunk) for chunk in chunks(cast(Any, Five(together=together)))] == expected
