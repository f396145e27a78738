"""Limits of lines through junctions, as numbers: lines that are the same, bends, and lanes that begin behind."""

from __future__ import annotations

import numpy as np
import pytest

from epo_lightning.data.recorded.junctions import Junctions, _begins_behind, choose_lines, too_sharp, ways
from epo_lightning.data.recorded.lanes import LANE, SHOULDER
from epo_lightning.data.recorded.routes import PER_LINE

from .crossings import crossing, graph
from .roads import WIDTH


@pytest.mark.parametrize(("apart", "count"), [(0.9, 1), (1.1, 2)])
def test_lines_that_are_less_than_a_metre_apart_are_the_same(apart, count):
    line = np.stack([np.linspace(0.0, 40.0, PER_LINE), np.zeros(PER_LINE)], 1)
    other = line + np.linspace(0.0, apart, PER_LINE)[:, None] * (0.0, 1.0)
    _, found = choose_lines(np.stack([line, other])[None], np.array([[0.0, 1.0]]), 4)
    assert found.tolist() == [count]


@pytest.mark.parametrize(("speed", "sharp"), [(9.9, False), (10.1, True), (0.0, False)])
def test_a_bend_of_twenty_metres_is_taken_with_ten_metres_per_second(speed, sharp):
    angle = np.linspace(0.0, 1.5, PER_LINE)
    points = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    # The agent brakes on the way to the first corner of the line.
    first = 20.0 * angle[1]
    found = too_sharp(points[None, None], np.sqrt(np.array([speed**2 + 8.0 * first])), np.array([20.0 * 1.5]))
    assert found.tolist() == [[sharp]]


def test_a_vehicle_that_rolls_backwards_can_take_every_bend():
    lanes = crossing()
    position, heading = np.array([[-2.0, -0.4]]), np.array([-0.2])
    located = lanes.locate(position, heading)
    lines = [
        Junctions(lanes, 12).of(position, heading, np.array([speed]), located, 4.0).candidates for speed in (0.0, -20.0)
    ]
    np.testing.assert_array_equal(*lines)


@pytest.mark.parametrize(("begin", "behind"), [(-4.0, False), (4.0, False), (-20.0, True)])
def test_a_lane_beside_may_begin_some_metres_behind(begin, behind):
    lanes = graph([[[0.0, 0.0], [50.0, 0.0]], [[begin, WIDTH], [50.0, WIDTH]]], [(), ()])
    assert _begins_behind(1, 0, lanes) == behind


@pytest.mark.parametrize(
    ("away", "degrees", "counted"),
    [(1.9, 0, True), (2.1, 0, False), (0.0, 59, True), (0.0, 61, False), (1.9, -59, True)],
)
def test_an_agent_may_be_on_lanes_two_metres_away_whose_directions_are_up_to_sixty_degrees_off(away, degrees, counted):
    angle = np.radians(degrees)
    way, aside = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    beside = (WIDTH / 2 + away) * aside * (away > 0)  # its right border is that far from the agent
    lines = [[[-90.0, 0.0], [90.0, 0.0]], [beside - 90.0 * way, beside + 90.0 * way]]
    position, heading = np.zeros((1, 2)), np.zeros(1)
    for kind in (LANE, SHOULDER):
        lanes = graph(lines, [(), ()], kind=[LANE, kind])
        route = Junctions(lanes, 9).of(position, heading, np.zeros(1), lanes.locate(position, heading), 4.0)
        (count,) = route.count
        assert (count > 3) == (counted and kind == LANE), "its own lane has a centreline and two boundaries"
        assert (route.references[0, 0, :, 1] == 0).all(), "its own lane comes first"


@pytest.mark.parametrize(("forks", "count"), [(3, 8), (6, 64), (8, 64)])
def test_all_ways_through_forks_are_found_up_to_sixty_four(forks, count):
    """Each lane forks into two, several times in a row."""
    lanes = 2 ** (forks + 1) - 1
    depth = [np.floor(np.log2(lane + 1)) for lane in range(lanes)]
    lines = [[[10.0 * forked, lane], [10.0 * forked + 10.0, lane]] for lane, forked in enumerate(depth)]
    successors = [(2 * lane + 1, 2 * lane + 2) if 2 * lane + 2 < lanes else () for lane in range(lanes)]
    found = ways([(0, 0.0, 0.0)], 1e3, graph(lines, successors), [10.0] * lanes)
    assert len({way.lanes for way in found}) == len(found) == count
    assert {len(way.lanes) for way in found} == {forks + 1}
