"""Reference lines and goal candidates on straight roads, compared with closed forms."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest

from epo_lightning.data.recorded.junctions import Junctions
from epo_lightning.data.recorded.lanes import SHOULDER, LaneGraph
from epo_lightning.data.recorded.routes import Routes, direction, pieces, reach

from .crossings import graph
from .roads import WIDTH, curve, road


@pytest.mark.parametrize("speed", [-2.0, 0.0, 3.0, 15.0, 40.0])
@pytest.mark.parametrize("time", [1.0, 4.0])
def test_the_range_is_that_of_agents_that_brake_and_accelerate_in_small_steps(speed: float, time: float) -> None:
    dt = 1e-4
    ways = []
    for acceleration in (-4.0, 3.0):
        now, gone = max(speed, 0.0), 0.0
        for _ in range(round(time / dt)):
            after = max(now + acceleration * dt, 0.0)
            gone, now = gone + 0.5 * (now + after) * dt, after
        ways.append(gone)
    near, far = (float(end[0]) for end in reach(np.array([speed]), time))
    assert far == pytest.approx(ways[1])
    assert near == pytest.approx(min(ways[0], far - 10.0), abs=1e-3)


def lines_of(lanes: LaneGraph, x: float, speed: float = 10.0) -> list[float]:
    """The y of the left, own and right reference line of an agent on lane 1, at their last points."""
    position = np.array([[x, WIDTH]])
    route = Routes(lanes).of(position, np.array([speed]), lanes.locate(position, np.zeros(1)), 4.0)
    return route.references[0, :, -1, 1].tolist()


def test_boundaries_stand_for_neighbours_that_are_shoulders_or_begin_too_far_ahead() -> None:
    lanes = road(curve(None), sections=2)  # from right to left at y = 0, WIDTH, 2 WIDTH; the sections meet at x = 200
    assert lines_of(lanes, 150.0) == pytest.approx([2 * WIDTH, WIDTH, 0.0])
    shoulder = dataclasses.replace(lanes, kind=np.where(np.arange(6) % 3 == 0, SHOULDER, lanes.kind))
    assert lines_of(shoulder, 150.0) == pytest.approx([2 * WIDTH, WIDTH, 0.5 * WIDTH])
    later = dataclasses.replace(lanes, left_of=np.array([-1, -1, -1, *lanes.left_of[3:]]))
    # An agent that accelerates from 10 m/s by 3 m/s^2 gets 64 m far in 4 s.
    assert lines_of(later, 137.0) == pytest.approx([2 * WIDTH, WIDTH, 0.0])
    assert lines_of(later, 135.0) == pytest.approx([1.5 * WIDTH, WIDTH, 0.0])


def test_lanes_are_cut_into_the_fewest_equal_pieces() -> None:
    for length, count in ((20.0, 1), (20.0 * (1 + 1e-12), 1), (20.5, 2), (61.0, 4)):
        found = pieces(road(curve(None), lanes=1, sections=1, length=length), vectors=4, spacing=5.0)
        assert found.shape == (count, 5, 2)
        np.testing.assert_allclose(np.diff(found[..., 0]), length / count / 4, rtol=1e-9)
        np.testing.assert_allclose(found[1:, 0], found[:-1, -1], atol=1e-9)


Maker = Callable[[LaneGraph, np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]


def on_own_lane(
    lanes: LaneGraph, position: np.ndarray, heading: np.ndarray, speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """The reference line on an agent's own lane and the goal candidates on it, in four seconds."""
    route = Routes(lanes).of(position, np.array([speed]), lanes.locate(position, heading), 4.0)
    return route.references[0, 1], route.candidates[0, route.line == 1]


def through_junctions(
    lanes: LaneGraph, position: np.ndarray, heading: np.ndarray, speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """The same for the first line through junctions."""
    located = lanes.locate(position, heading)
    route = Junctions(lanes, 3).of(position, heading, np.array([speed]), located, 4.0)
    return route.references[0, 0], route.candidates[0, route.line == 0]


both = pytest.mark.parametrize("make", [on_own_lane, through_junctions])


@both
def test_lines_follow_many_short_lanes_of_a_bend_from_five_metres_behind_to_ten_beyond_the_last_goal(
    make: Maker,
) -> None:
    place = curve(150.0)
    lanes = road(place, lanes=1, sections=24, length=9.0)
    position, heading = place(np.array([30.0]), np.zeros(1))
    references, candidates = make(lanes, position, heading, 30.0)
    for points, first, last in ((references, -5.0, 154.0), (candidates, 88.0, 144.0)):
        expected, _ = place(30.0 + np.linspace(first, last, len(points)), np.zeros(len(points)))
        np.testing.assert_allclose(points, expected, atol=2e-3)


@both
def test_a_line_goes_back_along_the_lane_that_ends_in_its_direction(make: Maker) -> None:
    bend = np.sin(np.linspace(0.0, np.pi / 2, 20)), 1.0 - np.cos(np.linspace(0.0, np.pi / 2, 20))
    to_the_north = np.stack((20.0 * bend[0] - 20.0, 20.0 * bend[1] - 20.0), 1)  # begins as the lane, and ends across it
    from_the_south = np.stack((20.0 * bend[1] - 20.0, 20.0 * bend[0] - 20.0), 1)  # begins across it
    ahead = np.stack((np.linspace(0.0, 200.0, 21), np.zeros(21)), 1)
    lanes = graph([to_the_north, from_the_south, ahead], [(2,), (2,), ()])
    position = np.array([[2.0, 0.0]])
    references, _ = make(lanes, position, np.zeros(1), 10.0)
    x, y = references[0]
    assert x == pytest.approx(-3.0, abs=0.1)
    assert y == pytest.approx(-(20.0 - np.sqrt(400.0 - 9.0)), abs=0.02), "3 m before the lane, on the bend of 20 m"


@both
def test_a_line_goes_on_along_the_lane_that_begins_in_its_direction(make: Maker) -> None:
    """The last goal is at x = 64 m; at x = 70 m the lane forks, to the left and straight on, and both branches bend."""
    turning = [[70.0, 0.0], [80.0, 10.0], [200.0, 10.0]]
    straight = [[70.0, 0.0], [90.0, 0.0], [90.0, -100.0]]
    lanes = graph([[[0.0, 0.0], [70.0, 0.0]], turning, straight], [(1, 2), (), ()])
    references, _ = make(lanes, np.zeros((1, 2)), np.zeros(1), 10.0)
    np.testing.assert_allclose(references[-1], (74.0, 0.0))


def test_the_direction_of_a_line_is_that_of_its_first_or_last_piece_with_length() -> None:
    line = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0], [9.0, 5.0], [9.0, 8.0], [9.0, 8.0]])
    assert direction(line, at_end=False).tolist() == [1.0, 0.0]
    assert direction(line, at_end=True).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("x", "left"), [(60.0, WIDTH / 2), (70.0, WIDTH)])
def test_the_way_to_a_neighbour_ahead_is_that_over_lanes_of_other_lengths(x: float, left: float) -> None:
    """Lanes of 80 m and 50 m, and one with a left neighbour, which begins at 130 m; the agent gets 64 m far."""
    ends = [0.0, 80.0, 130.0, 300.0]
    lines = [[[begin, 0.0], [end, 0.0]] for begin, end in itertools.pairwise(ends)]
    lanes = graph([*lines, [[130.0, WIDTH], [300.0, WIDTH]]], [(1,), (2,), (), ()], left=[-1, -1, 3, -1])
    position = np.array([[x, 0.0]])
    route = Routes(lanes).of(position, np.array([10.0]), lanes.locate(position, np.zeros(1)), 4.0)
    np.testing.assert_allclose(route.candidates[0, :20, 1], left)
