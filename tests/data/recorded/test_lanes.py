"""Lanes of agents, lane changes and leaders, compared with plain loops."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.lanes import LaneGraph, Located, Polylines, lane_changes
from epo_lightning.data.recorded.routes import Routes
from epo_lightning.data.simulate.leaders import leaders

from .crossings import graph
from .roads import FOUR, WIDTH, curve, road, traffic


@given(st.integers(0, 10_000))
def test_projection_is_the_nearest_point_of_a_line_that_goes_straight_on(seed):
    random = np.random.default_rng(seed)
    lines = [np.cumsum(random.normal((1.5, 0.0), size=(random.integers(2, 6), 2)), 0) for _ in range(4)]
    lines[1] = np.repeat(lines[1], 2, axis=0)  # equal points in succession
    of, position = random.integers(0, 4, 20), random.normal(size=(20, 2)) * 4
    along, offset = Polylines(lines).project(of, position)
    foot, tangent = Polylines(lines).at(of, along)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1.0)
    for i in range(20):
        line = np.unique(lines[of[i]], axis=0, return_index=True)[1]
        points = lines[of[i]][np.sort(line)]
        length = shapely.LineString(points).length
        inside = shapely.LineString(points).distance(shapely.Point(position[i]))
        assert np.linalg.norm(position[i] - foot[i]) == pytest.approx(abs(offset[i]), abs=1e-9)
        assert abs(offset[i]) <= inside + 1e-9
        if 0 < along[i] < length:
            assert abs(offset[i]) == pytest.approx(inside, abs=1e-9)
        way = position[i] - foot[i]
        assert np.sign(offset[i]) == (np.sign(tangent[i, 0] * way[1] - tangent[i, 1] * way[0]) or 1)


@given(st.integers(0, 10_000), st.floats(-1e6, 1e6))
def test_lines_go_straight_on_beyond_both_ends(seed, shift):
    """Shapely and numpy add segments up in other orders: a line's end must not be missed by the rounding of its length."""
    random = np.random.default_rng(seed)
    turns = np.cumsum(random.normal(scale=0.05, size=(20, 30)), axis=1)  # gentle bends: the end is the nearest point
    steps = random.uniform(2.0, 6.0, turns.shape)[..., None] * np.stack((np.cos(turns), np.sin(turns)), -1)
    lines = np.array([shift, -shift]) + np.cumsum(steps, axis=1)
    which, beyond, left = np.arange(20), random.uniform(0.0, 10.0, 20), random.uniform(-3.0, 3.0, 20)
    length = np.linalg.norm(np.diff(lines, axis=1), axis=-1).sum(1)
    for end, turn, expected in ((lines[:, -1], turns[:, -1], length + beyond), (lines[:, 0], turns[:, 1], -beyond)):
        ahead = np.stack((np.cos(turn), np.sin(turn)), -1)
        way = np.sign(expected - length / 2)[:, None] * beyond[:, None] * ahead
        position = end + way + left[:, None] * np.stack((-ahead[:, 1], ahead[:, 0]), -1)
        along, offset = Polylines(list(lines)).project(which, position)
        np.testing.assert_allclose(along, expected, atol=1e-5)
        np.testing.assert_allclose(offset, left, atol=1e-5)


@given(st.integers(0, 10_000), st.sampled_from([1e-7, 1e-5, 1e-2]))
def test_a_short_last_segment_is_extended_along_itself(seed, short):
    """Positions beside the segment before it are not beyond the line, though its end is within rounding."""
    random = np.random.default_rng(seed)
    ends = random.uniform(1.0, 10.0, 20)
    lines = [np.array([[0.0, 0.0], [end, 0.0], [end, short]]) for end in ends]  # the last segment turns left
    position = np.stack([ends + random.uniform(0.1, 3.0, 20), random.uniform(-3.0, 3.0, 20)], -1)
    along, offset = Polylines(lines).project(np.arange(20), position)
    np.testing.assert_allclose(along, ends + np.maximum(position[:, 1], 0.0), atol=2 * short)
    below = np.minimum(position[:, 1], 0.0)
    np.testing.assert_allclose(np.abs(offset), np.hypot(position[:, 0] - ends, below), atol=2 * short)


@given(st.floats(150, 2000), st.floats(-3, 3), st.integers(0, 10_000))
@settings(max_examples=25)
def test_agents_are_found_on_their_lanes_wherever_the_road_lies(radius, turn, seed):
    random = np.random.default_rng(seed)
    place = curve(radius, turn, (5e4, -3e5))
    lanes = road(place)
    along, lane = random.uniform(1, 599, 50), random.integers(0, 3, 50)
    offset = random.uniform(-1.7, 1.7, 50)
    position, heading = place(along, lane * WIDTH + offset)
    found = lanes.locate(position, heading + random.uniform(-0.5, 0.5, 50))
    np.testing.assert_array_equal(found.lane, lane + 3 * (along // 200).astype(int))
    np.testing.assert_allclose(found.offset, offset, atol=0.1)  # chords of the arc


def test_agents_heading_against_a_lane_or_beside_the_road_are_on_no_lane():
    lanes = road(curve(None))
    cases = [  # y [m] and heading [rad] at x = 50 m, and the lane
        *((0.0, 0.3, 0), (0.0, np.pi, -1), (-2.5, 0.0, 0), (-3.5, 0.0, -1)),
        *((0.0, 1.5, 0), (0.0, 1.65, -1), (0.0, -1.5, 0), (-2.5, 1.65, -1), (WIDTH, 0.3, 1)),
    ]
    y, heading, lane = np.array(cases).T
    found = lanes.locate(np.stack((np.full(len(y), 50.0), y), -1), heading)
    assert found.lane.tolist() == lane.tolist()
    np.testing.assert_allclose(found.offset, np.where(lane < 0, 0.0, y - lane * WIDTH), atol=1e-9)


@pytest.mark.parametrize(("offset", "heading", "lane"), [(0.0, 0.2, 0), (-0.8, 0.2, 1), (-0.8, 0.0, 0), (-1.3, 0.0, 1)])
def test_where_lanes_overlap_a_radian_counts_as_much_as_five_metres(offset, heading, lane):
    """The second lane is 1.5 m to the right of the first one at x = 0, and turned to the left by 0.2 radians."""
    direction = np.array([np.cos(0.2), np.sin(0.2)])
    lines = [np.array([[-80.0, 0.0], [80.0, 0.0]]), np.array([[0.0, -1.5]]) + np.array([[-80.0], [80.0]]) * direction]
    for order in (1, -1):
        lanes = LaneGraph.from_centrelines(lines[::order], 8.0)
        (found,) = lanes.locate(np.array([[0.0, offset]]), np.array([heading])).lane
        assert found == (lane if order == 1 else 1 - lane)
    twice = LaneGraph.from_centrelines([lines[lane]] * 3, 8.0)
    assert twice.locate(np.array([[0.0, offset]]), np.array([heading])).lane.tolist() == [0], "the first of equal lanes"


@pytest.mark.parametrize(("heading", "angle"), [(0.1, 1.0), (-0.1, 1.0), (0.9, 1.0), (1.1, 1.0), (0.1, 0.05)])
@pytest.mark.parametrize("distance", [0.5, 2.0, 6.0])
def test_lanes_around_a_position_are_those_within_a_distance_and_an_angle(heading, angle, distance):
    lanes = road(curve(None), sections=1)
    positions, headings = np.array([[10.0, 50.0], [50.0, 1.0]]), np.array([0.0, heading])
    row, lane, along, cost = lanes.around(positions, headings, distance, angle)
    away = [max(abs(1.0 - WIDTH * k) - WIDTH / 2, 0.0) for k in range(3)]  # from the borders of the lanes
    expected = [k for k in range(3) if away[k] <= distance and abs(heading) < angle]
    order = np.argsort(lane)
    assert lane[order].tolist() == expected
    assert (row == 1).all()
    np.testing.assert_allclose(along, 50.0)
    np.testing.assert_allclose(cost[order], [abs(1.0 - WIDTH * k) + 5.0 * abs(heading) for k in expected])


def test_a_lane_change_is_the_first_row_on_the_lane_beside():
    lanes = road(curve(None))
    tracks = traffic(curve(None), FOUR)
    found = lanes.locate(tracks.position, tracks.heading)
    changed = np.flatnonzero(lane_changes(tracks.agent, found, lanes))
    assert tracks.agent[changed].tolist() == [0]
    assert tracks.position[changed[0], 1] >= WIDTH / 2 >= tracks.position[changed[0] - 1, 1]
    # Driving on from one section into the next is none, though the lane is another one.
    assert len(np.unique(found.lane[tracks.agent == 1])) == 2


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_leaders_are_the_nearest_ahead(seed):
    random = np.random.default_rng(seed)
    vehicles = [(i, random.uniform(0, 500), int(random.integers(0, 3)), 20.0, None) for i in range(8)]
    lanes, tracks = road(curve(None)), traffic(curve(None), vehicles, seconds=1.0, rate=2.0)
    found = lanes.locate(tracks.position, tracks.heading)
    leader, distance = leaders(tracks, found, lanes)
    for row in range(len(tracks)):
        x, lane = tracks.position[row, 0], found.lane[row] % 3
        ahead = [
            (tracks.position[other, 0] - x, other)
            for other in range(len(tracks))
            if tracks.frame[other] == tracks.frame[row]
            and found.lane[other] % 3 == lane
            and tracks.position[other, 0] > x
        ]
        nearest = min(ahead, default=(np.inf, -1))
        expected = nearest if nearest[0] < 250 else (np.inf, -1)
        assert (pytest.approx(distance[row]), leader[row]) == expected


def crossing(angle: float):
    """Two straight lanes that cross at the origin, as under a bridge; the second one turned by ``angle``."""
    one, other = (road(curve(None, turn, (-100 * np.cos(turn), -100 * np.sin(turn))), 1, 1) for turn in (0.0, angle))
    both = {n: [*getattr(one, n), *getattr(other, n)] for n in ("left", "right", "centre", "successors")}
    none = np.full(2, -1)
    return LaneGraph(
        ids=np.arange(2),
        **both,
        left_of=none,
        right_of=none,
        adjacent_left=none,
        adjacent_right=none,
        speed_limit=np.full(2, np.nan),
        kind=np.zeros(2, int),
    )


@pytest.mark.parametrize("degrees", [20, 45, 70])
def test_agents_on_bridges_are_not_on_the_road_below(degrees):
    lanes = crossing(np.radians(degrees))
    along = np.linspace(-20, 20, 81)
    position = np.stack([along, np.full(81, 0.5)], 1)  # half a metre left of the middle, right along the lane
    assert (lanes.locate(position, np.zeros(81)).lane == 0).all()


@pytest.mark.parametrize("length", [3.0, 4.0, 8.0, 200.0])
def test_changes_are_seen_on_lanelets_of_any_length(length):
    place = curve(None)
    lanes = road(place, 2, int(400 / length) + 1, length)
    position, _ = place(np.arange(0, 300, 6.0), np.where(np.arange(50) < 25, 0.0, WIDTH))  # 30 m/s at 5 Hz
    found = lanes.locate(position, np.zeros(50))
    assert np.flatnonzero(lane_changes(np.zeros(50, int), found, lanes)).tolist() == [25]


def changes(lanes: LaneGraph, *passed: int) -> list[int]:
    """The rows in which an agent changes lane that is on these lanes, one after the other."""
    nothing = np.zeros(len(passed))
    return np.flatnonzero(
        lane_changes(np.zeros(len(passed)), Located(np.array(passed), nothing, nothing), lanes)
    ).tolist()


def test_a_way_through_a_fork_is_no_lane_change_though_its_branches_are_neighbours():
    """Lane 0 leads to the short lane 1, which forks into 2 and, on its left, 3; 4 follows 2."""
    lines = [[[0, 0], [50, 0]], [[50, 0], [53, 0]], [[53, 0], [99, -3]], [[53, 0], [99, 3]], [[99, -3], [150, -3]]]
    lanes = graph(lines, [(1,), (2, 3), (4,), (), ()], left=[-1, -1, 3, -1, -1], right=[-1, -1, -1, 2, -1])
    assert changes(lanes, 0, 0, 1, 2, 4) == changes(lanes, 0, 1, 3, 3) == []
    assert changes(lanes, 0, 2, 2) == changes(lanes, 0, 3) == changes(lanes, 1, 4) == [], "several lanes in one step"
    assert changes(lanes, 0, 2, 3) == changes(lanes, 0, 3, 2) == [2]
    assert changes(lanes, 3, 4) == [1], "from one branch to the lane after the other one"


def test_changes_are_seen_across_markings_after_a_gap_and_where_lanes_part():
    """Lanes 0 and, on its left, 1 lead to 2 and 3, which are not beside each other; 4 is another road."""
    lines = [[[0, 0], [50, 0]], [[0, 4], [50, 4]], [[50, 0], [99, -30]], [[50, 4], [99, 30]], [[0, -9], [50, -9]]]
    lanes = graph(lines, [(2,), (3,), (), (), ()], left=[1, -1, -1, -1, -1], right=[-1, 0, -1, -1, -1])
    lanes = dataclasses.replace(lanes, left_of=np.full(5, -1), right_of=np.full(5, -1))  # a line not to be crossed
    assert changes(lanes, 0, 0, 1, 1, 0) == [2, 4]
    assert changes(lanes, 0, -1, 1) == changes(lanes, -1, 0, 1) == [2], "rows on no lane are ignored"
    assert changes(lanes, 0, -1, 0, -1) == []
    assert changes(lanes, 2, 3) == changes(lanes, 3, 2) == [1], "the lanes before were neighbours"
    assert changes(lanes, 0, 4, 2) == [], "a road that is not beside, such as that below a bridge"


def test_routes_on_a_loop_start_at_the_agent():
    """A lane that leads into a ring and over its own beginning."""
    angles = np.linspace(-np.pi / 2, np.pi, 60)
    ring = np.stack([60 + 40 * np.cos(angles), 40 + 40 * np.sin(angles)], 1)
    lines = [
        np.stack([np.linspace(0, 60, 13), np.zeros(13)], 1),
        ring,
        np.stack([np.full(9, 20.0), np.linspace(40, -40, 9)], 1),  # down over the first lane at x = 20
    ]

    def beside(line, offset):
        way = np.gradient(line, axis=0)
        normal = np.stack([-way[:, 1], way[:, 0]], 1) / np.linalg.norm(way, axis=1, keepdims=True)
        return line + offset * normal

    none = np.full(3, -1)
    lanes = LaneGraph(
        np.arange(3),
        [beside(line, 1.8) for line in lines],
        [beside(line, -1.8) for line in lines],
        lines,
        [(1,), (2,), ()],
        *(none,) * 4,
        np.full(3, np.nan),
        np.zeros(3, int),
    ).check("loop")
    x = np.arange(15.0, 30.0)
    position, speed = np.stack([x, np.full(15, -0.3)], 1), np.full(15, 10.0)
    route = Routes(lanes).of(position, speed, lanes.locate(position, np.zeros(15)), 4.0)
    own = route.candidates[:, route.line == 1]
    # From 12.5 m ahead (braking) to 64 m: never down the other side of the loop.
    np.testing.assert_allclose(own[:, 0], np.stack([x + 12.5, np.zeros(15)], 1), atol=0.05)
    assert (own[..., 0] > x[:, None]).all()


def test_invalid_lane_graphs_are_refused():
    lanes = road(curve(None))
    beside = ("left_of", "right_of", "adjacent_left", "adjacent_right")
    absent = (-2, len(lanes))
    for change, message in (
        *(
            ({"successors": [(lane,)] * len(lanes)}, "names a successor that does not exist")
            for lane in (-1, len(lanes))
        ),
        *(
            ({name: np.full(len(lanes), lane)}, "names a neighbouring lane that does not exist")
            for name in beside
            for lane in absent
        ),
        *(({"centre": [line[:few] for line in lanes.centre]}, "has no length") for few in (0, 1)),
        ({"left": [line * np.nan for line in lanes.left]}, "are not finite or beyond"),
        ({"right": [line * 1e5 for line in lanes.right]}, "the right line of lane .* beyond .* m: are they in metres"),
    ):
        with pytest.raises(RecordingError, match=message):
            dataclasses.replace(lanes, **change).check("map.osm")
