"""Traffic as a world: how episodes end, what is measured of them, and how controls move the planned vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.drive.ride import Moment, Position, Simulation
from epo_lightning.drive.traffic import Simulator, TrafficWorld

LENGTH, WIDTH = 4.0, 2.0
State = tuple[float, float, float, float]
DRIVING: State = (0.0, 0.0, 0.0, 10.0)


class Road:
    """A road along x that ends at 6 m, and is 6 m wide; the other vehicle moves along it by the same distance in each step.

    Attributes:
        ended: how often the episode was ended.
    """

    lanes = cast(LaneGraph, SimpleNamespace(left=[np.ones((2, 2))], right=[np.zeros((2, 2))]))

    def __init__(self, ego: State, other: State, along: float = 0.0) -> None:
        self.ego, self.other, self.along = np.array(ego), np.array(other), np.array([along, 0.0, 0.0, 0.0])
        self.ended = 0

    def history(self) -> list[Moment]:
        return [self.moment()]

    def step(self, way: tuple[np.ndarray, np.ndarray]) -> None:
        assert not self.ended, "an episode that is over is not simulated"
        before, self.ego = way
        np.testing.assert_array_equal(before, self.now)
        self.other = self.other + self.along

    def moment(self) -> Moment:
        self.now = self.ego
        return Moment(
            names=["ego", "other"],
            states=np.stack([self.ego, self.other]),
            size=np.array([[LENGTH, WIDTH]] * 2),
            kind=np.zeros(2, dtype=int),
        )

    def position(self, state: np.ndarray) -> Position:
        x, y = (float(value) for value in state[:2])
        return Position(progress=x, arrived=x >= 6.0, off_road=abs(y) > 3.0, line=1)

    def end(self) -> None:
        self.ended += 1


class Roads:
    """A simulator of some episodes, which take four steps at most."""

    steps = 4

    def __init__(self, *roads: Road) -> None:
        self.roads, self.together = roads, len(roads)

    def __len__(self) -> int:
        return len(self.roads)

    def begin(self, episode: int) -> Simulation:
        return self.roads[episode]

    def close(self) -> None:
        """Does nothing."""


def begun(*roads: Road) -> TrafficWorld:
    world = TrafficWorld(cast(Simulator, Roads(*roads)))
    world.reset(range(len(roads)))
    return world


@pytest.fixture
def roads() -> list[Road]:
    """Planned vehicles that move by 2 m in a step of 0.2 s, in episodes that end in all ways."""
    far: State = (100.0, 0.0, 0.0, 0.0)
    return [
        Road(DRIVING, (7.5, 0.0, 0.0, 0.0)),  # bumpers are 3.5 m, 1.5 m and -0.5 m apart
        Road(DRIVING, (-7.0, 0.0, 0.0, 20.0), along=4.5),  # it is 7 m, 4.5 m and 2 m behind
        Road((0.0, 0.0, math.pi / 2, 10.0), far),  # it leaves the road at 4 m
        Road(DRIVING, far),
        Road((1.0, 0.0, 0.0, 0.0), far),
        Road((0.0, 0.0, -math.pi / 2, 16.0), far),  # it leaves the road at 3.2 m
    ]


def driven(world: TrafficWorld, controls: Sequence[tuple[float, float]]) -> list[list[int]]:
    """Drive every episode to its end with the same controls at each step; the episodes that went on before each step."""
    going = []
    while len(left := world.going):
        going.append(left.tolist())
        world.advance(torch.tensor(controls, dtype=torch.double)[left])
    return going


def test_an_episode_ends_by_contact_off_the_road_at_the_end_of_the_way_or_of_its_time(roads: list[Road]) -> None:
    world = begun(*roads)
    accelerations = [(0.0, 0.0)] * 3 + [(5.0, 0.0)] + [(0.0, 0.0)] * 2
    assert driven(world, accelerations) == [[0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4], [3, 4], [4]]
    assert [road.ended for road in roads] == [1] * 6
    assert all(ride.over for ride in world.rides)
    outcome = world.outcome()
    assert {name: values.tolist() for name, values in outcome.measures.items() if name != "speed"} == {
        "arrived": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        "hit_from_behind": [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        "off_road": [0.0, 0.0, 1.0, 0.0, 0.0, 1.0],
    }
    assert outcome.rates == {"arrived", "hit_from_behind", "off_road"}
    # At 10, 11, 12 and 13 m/s the fourth vehicle moves by 2, 2.2 and 2.4 m.
    assert outcome.measures["speed"].tolist() == pytest.approx([10.0, 10.0, 10.0, 11.5, 0.0, 16.0])
    assert outcome.agent_mask[:, 0].sum(1).tolist() == [3, 3, 3, 4, 5, 2]
    progress = [[0.0, 2.0, 4.0, 4.0, 4.0]] * 2 + [[0.0] * 5, [0.0, 2.0, 4.2, 6.6, 6.6], [1.0] * 5, [0.0] * 5]
    np.testing.assert_allclose(outcome.progress, progress, atol=1e-9)


def test_an_episode_that_has_begun_over_is_not_driven(roads: list[Road]) -> None:
    """One begins off the road, and one at the end of its way."""
    world = begun(Road((0.0, 4.0, 0.0, 10.0), DRIVING), Road((6.0, 0.0, 0.0, 10.0), DRIVING), roads[3])
    assert world.going.tolist() == [2]
    world.reset([2])
    assert [road.ended for road in cast(Roads, world.simulator).roads] == [1, 1, 1], "all are ended at the latest here"


def test_controls_move_the_planned_vehicle_as_a_unicycle() -> None:
    """In a step of 0.2 s, it moves at the velocity before the step, and then takes its new speed and heading."""
    road = Road((1.0, 0.5, math.pi / 2, 5.0), (50.0, 0.0, 0.0, 0.0))
    world = begun(road)
    world.advance(torch.tensor([[2.0, -0.5]]))
    np.testing.assert_allclose(road.ego, [1.0, 1.5, math.pi / 2 - 0.1, 5.4])
    world.advance(torch.tensor([[-1.0, 0.0]]))
    moved = 0.2 * 5.4
    np.testing.assert_allclose(
        road.ego, [1.0 + moved * math.sin(0.1), 1.5 + moved * math.cos(0.1), math.pi / 2 - 0.1, 5.2]
    )
