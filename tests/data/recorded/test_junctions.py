"""Routes through junctions, compared with slow and obvious versions on random road graphs."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.data.recorded import summary
from epo_lightning.data.recorded.junctions import (
    APART,
    CHANGE,
    SIDEWAYS,
    Junctions,
    _followed,
    choose_lines,
    too_sharp,
    ways,
)
from epo_lightning.data.recorded.lanes import SHOULDER, LaneGraph
from epo_lightning.data.recorded.routes import BEHIND, BRAKING, PER_LINE, Routes, reach
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.windows import WindowConfig, extract, identifying
from epo_lightning.registry import ConfigError

from .crossings import crossing, graph
from .roads import WIDTH, curve, recording, road


def random_graph(seed: int, count: int = 6) -> LaneGraph:
    """Straight lanes anywhere, with random successors and neighbours."""
    random = np.random.default_rng(seed)
    start = random.uniform(-50, 50, (count, 2))
    centres = [[point, point + random.uniform(5, 30, 2)] for point in start]
    successors = [tuple(np.flatnonzero(random.uniform(size=count) < 0.3).tolist()) for _ in range(count)]
    beside = [random.permutation(count) for _ in range(2)]
    beside = [np.where(random.uniform(size=count) < 0.5, each, -1) for each in beside]
    beside = [np.where(each == np.arange(count), -1, each) for each in beside]
    return graph(centres, successors, *beside, kind=(random.uniform(size=count) < 0.2).astype(int))


@given(st.integers(0, 10_000), st.floats(-30, 5), st.floats(1, 80))
@settings(max_examples=25)
def test_all_successors_within_reach_are_followed(seed, begin, far):
    lanes = random_graph(seed)
    length = lanes.centrelines.length.tolist()
    expected = set()
    for size in range(1, len(lanes) + 1):
        for path in itertools.permutations(range(len(lanes)), size):  # every sequence of lanes without a loop
            ends = np.cumsum([begin, *(length[lane] for lane in path)])[1:]
            if path[0] != 0 or any(after not in lanes.successors[lane] for lane, after in itertools.pairwise(path)):
                continue
            goes_on = ends[-1] < far and set(lanes.successors[path[-1]]) - set(path)
            if (ends[:-1] < far).all() and not goes_on:
                expected.add(path)
    found = _followed(0, begin, far, lanes, length)
    assert {path for path, _ in found} == expected
    assert len(found) == len(expected)
    for path, begins in found:
        np.testing.assert_allclose(begins, begin + np.cumsum([0, *(length[lane] for lane in path[:-1])]))


def ahead_of(lanes: LaneGraph, one: int, other: int) -> float:
    """Distance [m] by which one straight lane begins ahead of another one."""
    way = lanes.centre[other][1] - lanes.centre[other][0]
    return float((lanes.centre[one][0] - lanes.centre[other][0]) @ way / np.linalg.norm(way))


@given(st.integers(0, 10_000))
@settings(max_examples=25)
def test_ways_change_lane_once_at_most_and_only_to_driving_lanes(seed):
    lanes = random_graph(seed)
    random = np.random.default_rng(seed)
    length = lanes.centrelines.length.tolist()
    starts = [(0, float(random.uniform(0, length[0])), 0.0), (1, float(random.uniform(0, length[1])), 2.0)]
    far = float(random.uniform(10, 80))
    found = ways(starts, far, lanes, length)
    cost = [way.cost for way in found]
    assert cost == sorted(cost)
    assert {way.lanes for way in found if way.cost < CHANGE} == {
        path for lane, along, _ in starts for path, _ in _followed(lane, -along, far, lanes, length)
    }
    kept = {lane for way in found if way.cost < CHANGE for lane in way.lanes}
    beside = {(lane, int(side[lane])) for lane in kept for side in (lanes.left_of, lanes.right_of)}
    pairs = {(lane, other) for lane, other in beside if other >= 0 and lanes.kind[other] != SHOULDER}
    driving = {other for lane, other in pairs if lane in (0, 1) or ahead_of(lanes, other, lane) >= -BEHIND}
    assert driving <= {lane for way in found for lane in way.lanes}, (
        "every lane that begins beside a way can be reached"
    )
    for way in found:
        jumps = [(one, other) for one, other in itertools.pairwise(way.lanes) if other not in lanes.successors[one]]
        assert len(jumps) <= (way.cost >= CHANGE)
        if way.cost >= CHANGE:
            assert any(lane in driving for lane in way.lanes)
        first = {0, 1} | {int(side[lane]) for lane in (0, 1) for side in (lanes.left_of, lanes.right_of)}
        assert way.lanes[0] in first, "every way begins on a lane of the agent or beside one"


@given(st.integers(0, 10_000), st.integers(1, 4))
@settings(max_examples=30)
def test_lines_are_chosen_as_by_a_plain_loop(seed, most):
    random = np.random.default_rng(seed)
    points = random.uniform(-1, 1, (5, 6, 3, 2)) * random.choice([0.3, 2.0], (5, 6, 1, 1))
    cost = random.permutation(30).reshape(5, 6).astype(float)
    absent = random.uniform(size=(5, 6)) < 0.3
    absent[:, 0] = False
    cost[absent], points[absent] = np.inf, np.nan
    order, count = choose_lines(points, cost, most)
    for row in range(5):
        kept: list[int] = []
        for column in sorted(range(6), key=lambda column: cost[row, column]):
            new = all(np.linalg.norm(points[row, column] - points[row, k], axis=1).max() >= APART for k in kept)
            if new and len(kept) < most and not absent[row, column]:
                kept.append(column)
        assert order[row, : count[row]].tolist() == kept


def lines_of(lanes: LaneGraph, most: int, position, heading, speed):
    position = np.array([position], dtype=float)
    located = lanes.locate(position, np.array([heading]))
    return Junctions(lanes, most).of(position, np.array([heading]), np.array([speed]), located, 4.0)


@pytest.mark.parametrize(("end", "way"), [((12.0, 30.0), 1), ((30.0, 0.0), 2), ((8.0, -25.0), 3)])
def test_goals_lie_on_every_way_through_a_junction(end, way):
    lanes = crossing()
    route = lines_of(lanes, 6, (-10.0, 0.3), 0.0, 8.0)
    nearest = np.linalg.norm(route.candidates[0, : route.count[0] * PER_LINE] - end, axis=1).min()
    assert nearest < 1.5
    position, heading = np.array([[-10.0, 0.3]]), np.zeros(1)
    today = Routes(lanes).of(position, np.array([8.0]), lanes.locate(position, heading), 4.0)
    alone = np.linalg.norm(today.candidates[0] - end, axis=1).min()
    assert (alone < 2.5) == (way == 2), "three lines follow the straightest successor"


def test_the_number_of_lines_is_that_of_the_ways_and_the_others_repeat_the_first():
    route = lines_of(crossing(), 12, (-10.0, 0.3), 0.0, 8.0)
    assert route.count.tolist() == [9], "three ways, each with its centreline and two boundaries"
    np.testing.assert_array_equal(route.references[0, 9], route.references[0, 0])
    few = lines_of(crossing(), 2, (-10.0, 0.3), 0.0, 8.0)
    assert few.count.tolist() == [2]
    np.testing.assert_array_equal(few.references[0], route.references[0, :2])
    # A vehicle that stands far from the junction does not reach it.
    still = lines_of(crossing(), 5, (-50.0, 0.0), 0.0, 0.0)
    assert still.count.tolist() == [3]
    lateral = still.candidates[0].reshape(5, PER_LINE, 2)[:3, :, 1]
    np.testing.assert_allclose(lateral, np.array([0.0, WIDTH / 2, -WIDTH / 2])[:, None] * np.ones(PER_LINE))


def test_bends_that_a_fast_vehicle_cannot_take_come_last():
    slow, fast = (lines_of(crossing(), 1, (-2.0, -0.4), -0.2, speed) for speed in (5.0, 20.0))
    whole = lines_of(crossing(), 12, (-2.0, 0.0), 0.0, 20.0)
    lines = whole.candidates[0].reshape(12, PER_LINE, 2)
    assert (np.abs(lines[:3, :, 1]) <= WIDTH / 2 + 1e-9).all(), "straight on and its boundaries come first"
    assert (np.abs(lines[3 : whole.count[0], -1, 1]) > 20).all(), "the others are used where there are lines to spare"
    assert (whole.references[0, whole.count[0] :] == whole.references[0, 0]).all()
    assert (fast.candidates[0, :, 1] == 0).all()
    assert slow.count.tolist() == [1]


@given(st.floats(0, 30), st.floats(3, 60))
def test_a_bend_is_too_sharp_by_its_speed_after_braking(speed, radius):
    _, (far,) = reach(np.array([speed]), 4.0)
    along = np.linspace(0, far, PER_LINE)
    bend = np.maximum(along - 20.0, 0) / radius  # the bend begins after 20 m
    inside = np.minimum(along, 20.0)
    points = np.stack([inside + radius * np.sin(bend), radius * (1 - np.cos(bend))], 1)
    found = bool(too_sharp(points[None, None], np.array([speed]), np.array([far]))[0, 0])
    gap = far / (PER_LINE - 1)
    if bend[-1] == 0 or gap / radius > np.pi / 2:
        assert bend[-1] > 0 or not found
        return
    # The bend is seen up to two gaps late or early.
    least, most = (max(speed**2 - 2 * BRAKING * max(20.0 + way * gap, 0), 0) / radius for way in (2, -2))
    if most < 0.9 * SIDEWAYS:
        assert not found
    if least > 1.3 * SIDEWAYS and bend[-1] > 3 * gap / radius:
        assert found


def test_an_agent_on_overlapping_lanes_has_the_ways_of_all_of_them():
    # Just behind the fork the three lanes overlap, and the straight one fits best.
    route = lines_of(crossing(), 3, (3.0, 0.2), 0.05, 6.0)
    assert route.count.tolist() == [3]
    ends = route.candidates[0].reshape(3, PER_LINE, 2)[:, -1]
    assert (ends[:, 1] > 20).any()
    assert (ends[:, 1] < -20).any()
    assert (np.abs(ends[:, 1]) < 1).any()


def test_a_turning_bay_that_begins_ahead_is_reached_over_the_lanes_before_it():
    bay = [[20.0, WIDTH], [40.0, WIDTH]]
    lanes = graph(
        [
            [[0.0, 0.0], [20.0, 0.0]],
            [[20.0, 0.0], [40.0, 0.0]],
            bay,
            [[40.0, 0.0], [140.0, 0.0]],
            [[40.0, WIDTH], [40.0, 90.0]],
        ],
        [(1,), (3,), (4,), (), ()],
        left=[-1, 2, -1, -1, -1],
    )
    route = lines_of(lanes, 4, (5.0, 0.0), 0.0, 10.0)
    turning = route.candidates[0].reshape(4, PER_LINE, 2)[1]
    assert turning[-1, 1] > 20
    assert np.linalg.norm(turning - (30.0, WIDTH), axis=1).min() < 2.0


def test_a_lane_that_joins_from_another_road_is_reached_over_the_lanes_before_it():
    # The agent turns left into a road; the lane on the right of its lane there comes straight from the south.
    turned = [[60.0, 10.0], [60.0, 120.0]]
    joining = [[60.0 + WIDTH, 10.0], [60.0 + WIDTH, 120.0]]
    lanes = graph(
        [
            [[0.0, 0.0], [50.0, 0.0], [57.0, 3.0], [60.0, 10.0]],
            turned,
            joining,
            [[60.0 + WIDTH, -90.0], [60.0 + WIDTH, 10.0]],
        ],
        [(1,), (), (), (2,)],
        right=[-1, 2, -1, -1],
    )
    route = lines_of(lanes, 8, (5.0, 0.0), 0.0, 10.0)
    lines = route.references[0, : route.count[0]]
    assert route.count[0] >= 2
    assert np.linalg.norm(lines - (5.0, 0.0), axis=2).min(1).max() < 5.0, "every line passes the agent"
    ends = route.candidates[0].reshape(8, PER_LINE, 2)[: route.count[0], -1]
    assert np.isclose(ends[:, 0], 60.0 + WIDTH).any(), "the joining lane can be reached"


def test_no_line_leads_back_to_the_beginning_of_a_long_lane_that_joins():
    turned = [[60.0, 10.0], [60.0, 120.0]]
    lanes = graph(
        [
            [[0.0, 0.0], [50.0, 0.0], [57.0, 3.0], [60.0, 10.0]],
            turned,
            [[60.0 + WIDTH, -90.0], [60.0 + WIDTH, 120.0]],
        ],
        [(1,), (), ()],
        right=[-1, 2, -1],
    )
    route = lines_of(lanes, 8, (5.0, 0.0), 0.0, 10.0)
    steps = np.diff(route.references[0, : route.count[0]], axis=1)
    assert (steps[..., 1] > -0.1).all(), "no line goes south"


WINDOWS = WindowConfig(lane_change=False, lines=9, lanes=None)


def test_scenes_have_the_lines_of_their_agents_and_masks_of_those_that_exist():
    of = recording(curve(900.0, 0.3))
    found, _ = extract(of, WINDOWS)
    columns = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in found.columns().items()}
    data = RecordedScenes(columns, 0.2, "aligned", [of.name])
    scene = data[torch.arange(len(data))]
    assert scene.references.shape[2] == 9
    assert scene.goal_candidates.shape[2] == 9 * PER_LINE
    count = columns["lines"][columns["agents"].long()]
    assert torch.equal(scene.reference_mask.sum(-1), count)
    assert (count < 9).any()
    assert torch.equal(scene.goal_mask.sum(-1), PER_LINE * count)
    assert torch.equal(scene.goal_mask, scene.reference_mask.repeat_interleave(PER_LINE, -1))
    assert scene.finite.all()


def test_distances_to_goals_are_those_to_the_candidates_of_lines_that_exist(monkeypatch):
    scenes, _ = extract(recording(curve(900.0, 0.3)), WINDOWS)
    agents = len(scenes.history)
    monkeypatch.setattr(summary, "AT_ONCE", agents - 1)  # the last one comes alone
    assert (scenes.lines < WINDOWS.lines).all()
    of_line = scenes.candidates.reshape(len(scenes.lines), scenes.references.shape[1], -1, 2)
    expected = [
        np.linalg.norm(of_line[agent, :count] - scenes.future[agent, -1, :2], axis=-1).min()
        for agent, count in enumerate(scenes.lines)
    ]
    np.testing.assert_allclose(summary.distance_to_goals(scenes), expected)
    mask = np.ones_like(scenes.future_mask)
    mask[: agents // 2, -1] = False  # the ends of these are not observed
    told = summary.describe(dataclasses.replace(scenes, future_mask=mask))
    observed = expected[agents // 2 :]
    wanted = [np.mean(observed), np.percentile(observed, 95)]
    assert told["way to the nearest goal candidate [m], mean and 95th percentile"] == pytest.approx(wanted)


def test_settings_of_junctions_enter_the_identity_of_a_data_set_only_where_they_are_used():
    assert "lines" not in identifying(WindowConfig())
    assert identifying(WINDOWS)["lines"] == 9
    with pytest.raises(ConfigError, match=r"data\.windows\.lines must be a whole number, 1 or more, not 0"):
        WindowConfig(lines=0)


def test_a_road_without_junctions_has_the_lines_of_its_lanes():
    place = curve(None)
    lanes = road(place)
    position, heading = place(np.array([50.0]), np.array([WIDTH]))
    located = lanes.locate(position, heading)
    today = Routes(lanes).of(position, np.array([20.0]), located, 4.0)
    route = Junctions(lanes, 8).of(position, heading, np.array([20.0]), located, 4.0)
    assert route.count.tolist() == [7], "three lanes and their four boundaries"
    ours = {tuple(np.round(point, 3)) for point in route.candidates[0, : 3 * PER_LINE]}
    assert ours == {tuple(np.round(point, 3)) for point in today.candidates[0]}
