"""Scenes of recordings: their agents and observations, compared with a plain loop over all windows."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics.slow_interaction import interact

from data.recorded.window_scenes import crowd, scenes_of, tables
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.clock import TOO_SHORT
from epo_lightning.data.recorded.lanes import lane_changes
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.tables import joined
from epo_lightning.data.recorded.windows import AT_ENDS, MOMENTS, WindowConfig, extract
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS

from .roads import FOUR, WIDTH, curve, recording


def obvious(of, config: WindowConfig) -> set[tuple[int, frozenset[int]]]:
    """The windows of a recording, by frame and track ids, found one by one. Every track lasts the whole recording."""
    tracks = of.tracks
    found = of.lanes.locate(tracks.position, tracks.heading)
    step = round(config.dt * tracks.rate)
    agents = [tracks.agent == a for a in range(len(tracks.ids))]
    at = [tracks.position[rows][::step] for rows in agents]
    lane = [found.lane[rows][::step] for rows in agents]
    changed = []
    for a, rows in enumerate(agents):
        coarse = np.flatnonzero(rows)[::step]
        part = dataclasses.replace(
            found, lane=found.lane[coarse], along=found.along[coarse], offset=found.offset[coarse]
        )
        changed.append(np.flatnonzero(lane_changes(np.full(len(coarse), a), part, of.lanes)))
    windows = set()
    for now in range(config.history - 1, len(at[0]) - config.horizon):
        if now % config.every:
            continue
        for focal in range(len(at)):
            distance = [(np.linalg.norm(at[focal][now] - at[other][now]), other) for other in range(len(at))]
            limit = np.inf if config.radius is None else config.radius
            chosen = [other for away, other in sorted(distance)[: config.agents] if away <= limit]
            first, last = now - config.history + 1, now + config.horizon
            moving = any(((changed[a] > first) & (changed[a] <= last)).any() for a in chosen)
            if len(chosen) < config.least_agents or (config.lane_change and not moving):
                continue
            if any(lane[a][now] < 0 for a in chosen):
                continue
            windows.add((now * step, frozenset(tracks.ids[chosen].tolist())))
    return windows


@given(
    st.integers(0, 10_000),
    st.sampled_from(
        [
            WindowConfig(),
            WindowConfig(lane_change=False, radius=30.0),
            WindowConfig(agents=6, least_agents=2, radius=40.0, every=3),
            WindowConfig(agents=1, least_agents=1),
            WindowConfig(agents=32, least_agents=3, radius=None),
        ]
    ),
)
@settings(max_examples=25)
def test_windows_equal_those_of_a_plain_loop(seed, config):
    of = recording(vehicles=crowd(seed))
    scenes, counts = extract(of, config)
    expected = obvious(of, config)
    assert counts["scenes"] == len(expected)
    if scenes is None:
        assert not expected
        return
    data = RecordedScenes(tables(scenes), config.dt, "fixed", [of.name])
    known = data.provenance(range(len(data)))
    assert {(entry["frame"], frozenset(entry["tracks"])) for entry in known} == expected
    dropped = sum(
        counts[reason]
        for reason in ("too few agents around", "the same agents twice", "no lane change", "an agent on no lane")
        if reason in counts
    )
    assert counts["windows"] == counts["scenes"] + dropped
    # Every agent at every step of the clock is a window, or is counted under one reason.
    step = round(config.dt * of.tracks.rate)
    assert counts[MOMENTS] == sum(
        1 for frame in of.tracks.frame if frame % step == 0 and frame // step % config.every == 0
    )
    assert counts[MOMENTS] == counts["windows"] + counts.get(TOO_SHORT, 0) + counts[AT_ENDS]


@pytest.mark.parametrize("rate", [25.0, 10.0])
def test_a_scene_equals_the_states_of_the_recording(rate):
    of = recording(curve(700.0, 0.4, (4000.0, -900.0)), rate=rate)
    scene, data = scenes_of(of)
    tracks = of.tracks
    for index, entry in enumerate(data.provenance(range(len(data)))):
        for i, track in enumerate(entry["tracks"]):
            rows = np.flatnonzero(tracks.ids[tracks.agent] == track)
            origin = scene.frame[index, :2].numpy()
            for states, steps in ((scene.history, np.arange(-9, 1)), (scene.future, np.arange(1, 21))):
                at = rows[entry["frame"] + round(0.2 * rate) * steps]
                found = states[index, i].double().numpy()
                np.testing.assert_allclose(found[:, :2] + origin, tracks.position[at], atol=1e-3)
                np.testing.assert_allclose(found[:, 2], tracks.heading[at], atol=1e-5)
                np.testing.assert_allclose(found[:, 3], tracks.speed[at], atol=1e-4)
    centre = scene.current[..., :2].mean(1)
    torch.testing.assert_close(centre, torch.zeros_like(centre), rtol=0, atol=1e-4)
    assert scene.finite.all()


def test_goals_lie_on_the_lanes_that_an_agent_may_take():
    of = recording(vehicles=((1, 30.0, 0, 20.0, 2.0), (2, 20.0, 1, 20.0, None), (3, 10.0, 2, 20.0, None)))
    scene, _ = scenes_of(of, WindowConfig(agents=3, least_agents=3))
    goals = (scene.goal_candidates + scene.frame[:, None, None, :2])[0]
    now = (scene.current[..., :2] + scene.frame[:, None, :2])[0]
    line = scene.goal_reference[0, 0]
    for i in range(3):
        k = round(float(now[i, 1]) / WIDTH)
        left = WIDTH * (k + 1 if k < 2 else k + 0.5)  # the lane beside, or the boundary of one's own
        right = WIDTH * (k - 1 if k > 0 else k - 0.5)
        for number, y in enumerate((left, WIDTH * k, right)):
            ways = goals[i][line == number] - now[i]
            torch.testing.assert_close(goals[i][line == number][:, 1], torch.full((20,), y).double(), rtol=0, atol=1e-3)
            # Between braking with 4 and accelerating with 3 m/s^2 for four seconds from 20 m/s.
            assert float(ways[0, 0]) == pytest.approx(20 * 4 - 4 * 4**2 / 2, abs=0.05)
            assert float(ways[-1, 0]) == pytest.approx(20 * 4 + 3 * 4**2 / 2, abs=0.05)
    for i in range(3):
        lines = scene.references[0, i].double() + scene.frame[0, :2]
        for number in range(3):
            candidates = goals[i][line == number]
            height = np.interp(candidates[:, 0], lines[number, :, 0], lines[number, :, 1])
            np.testing.assert_allclose(height, candidates[:, 1], atol=1e-3)


def test_tracks_may_begin_and_end_at_any_time():
    of = recording(seconds=20.0, vehicles=[*FOUR, (12, 90.0, 2, 24.0, None)])
    lives = np.array([500, 500, 400, 350, 150])[of.tracks.agent]  # the last one leaves long before the others
    kept = of.tracks.frame <= lives
    parts = {n: getattr(of.tracks, n)[kept] for n in ("agent", "frame", "position", "heading", "velocity")}
    of = dataclasses.replace(of, tracks=dataclasses.replace(of.tracks, **parts))
    for agents, complete, lane_change in itertools.product((5, 3, 2), (True, False), (True, False)):
        config = WindowConfig(agents=agents, least_agents=1, radius=None, lane_change=lane_change, complete=complete)
        scene, data = scenes_of(of, config)
        for index, entry in enumerate(data.provenance(range(len(data)))):
            present = scene.agent_mask[index].sum()
            assert present == len(entry["tracks"])
            last = {7: 500, 3: 500, 9: 400, 4: 350, 12: 150}
            there = {track for track, frame in last.items() if entry["frame"] + (100 if complete else 0) <= frame}
            assert set(entry["tracks"]) <= there
            assert present == min(agents, len(there)), "nobody who is gone takes the place of a neighbour"
        assert scene.finite.all()


@pytest.mark.parametrize("complete", [True, False])
def test_the_focal_agent_is_observed_in_the_whole_window_from_the_first_moment_to_the_last(complete):
    of = recording(vehicles=(FOUR[0], FOUR[3]))  # 251 frames, every fifth is a step
    late = of.tracks.frame >= np.where(of.tracks.agent == 1, 75, 0)
    parts = {n: getattr(of.tracks, n)[late] for n in ("agent", "frame", "position", "heading", "velocity")}
    of = dataclasses.replace(of, tracks=dataclasses.replace(of.tracks, **parts))
    config = WindowConfig(agents=1, least_agents=1, radius=None, lane_change=False, complete=complete)
    scene, data = scenes_of(of, config)
    assert scene.history_mask.all()
    assert scene.future_mask.all()
    moments: dict[int, list[int]] = {}
    for entry in data.provenance(range(len(data))):
        moments.setdefault(entry["tracks"][0], []).append(entry["frame"] // 5)
    assert {track: sorted(at) for track, at in moments.items()} == {
        7: list(range(config.history - 1, 51 - config.horizon)),
        4: list(range(15 + config.history - 1, 51 - config.horizon)),
    }


def test_neighbours_may_be_observed_in_part():
    of = recording()
    late = of.tracks.frame >= np.where(of.tracks.agent == 1, 125, 0)
    tracks = dataclasses.replace(
        of.tracks, **{n: getattr(of.tracks, n)[late] for n in ("agent", "frame", "position", "heading", "velocity")}
    )
    of = dataclasses.replace(of, tracks=tracks)
    whole, _ = scenes_of(of, WindowConfig(agents=4, least_agents=1))
    assert not (whole.agent_mask.all(1)).any()
    part, data = scenes_of(of, WindowConfig(agents=4, least_agents=1, complete=False))
    seen = part.agent_mask.all(1)
    assert seen.any()
    observed = set()
    for index in seen.nonzero().flatten().tolist():
        entry = data.provenance([index])[0]
        steps = part.history_mask[index, entry["tracks"].index(3)].sum()
        assert int(steps) == min(10, (entry["frame"] - 125) // 5 + 1)
        observed.add(int(steps))
    assert min(observed) == 2, "at the current step and at the one before"
    assert (part.history[~part.history_mask] == 0).all()
    assert part.finite.all()


def test_a_vehicle_on_no_lane_is_counted_and_left_out():
    of = recording(vehicles=[*FOUR, (11, 90.0, 3, 24.0, None)])  # beside the road
    _, counts = extract(of, WindowConfig())
    assert counts["an agent on no lane"] > 0
    _, fewer = extract(of, WindowConfig(agents=5, least_agents=5))
    assert fewer["scenes"] == 0


@pytest.mark.parametrize(("lane", "kind"), [(3, "car"), (1, "pedestrian")])
def test_an_agent_on_no_lane_may_be_left_out_alone(lane, kind):
    config = WindowConfig(off_lane="agent")
    without, with_it = recording(), recording(vehicles=[*FOUR, (11, 90.0, lane, 24.0, None)])
    with_it.tracks.kind[-1] = KINDS.index(kind)
    expected, found = (scenes_of(of, config) for of in (without, with_it))
    assert len(expected[1]) == len(found[1]) > 0
    names = [[(e["frame"], e["tracks"]) for e in data.provenance(range(len(data)))] for _, data in (expected, found)]
    assert names[0] == names[1]
    # The recording's origin is the mean of all positions, which moves what is rounded.
    for name in ("history", "future", "goal_candidates", "lanes"):
        torch.testing.assert_close(getattr(expected[0], name), getattr(found[0], name), rtol=0, atol=1e-3)
    before, after = (extract(of, config)[1] for of in (without, with_it))
    assert after["windows"] - before["windows"] == after["an agent on no lane"] - before["an agent on no lane"] > 0


def test_parked_cars_do_not_make_a_map_that_of_another_place():
    parked = [(20 + k, 10.0 * k, 4, 0.0, None) for k in range(9)]
    scenes, _ = extract(recording(vehicles=[*FOUR, *parked]), WindowConfig(off_lane="agent"))
    assert scenes is not None


@pytest.mark.parametrize("smoothing", [None, 1.0])
@pytest.mark.parametrize(("dt", "rate", "frame"), [(0.2, 25.0, 100), (0.13, 25.0, 107), (0.2, 4.0, 16), (0.2, 3.0, 12)])
@given(st.integers(0, 10_000))
@settings(max_examples=5)
def test_inputs_do_not_depend_on_the_future(smoothing, dt, rate, frame, seed):
    config = WindowConfig(dt=dt, radius=None, lane_change=False, smoothing=smoothing, interpolate=True)
    of = recording(vehicles=crowd(seed, 6), rate=rate)
    random = np.random.default_rng(seed)
    later = of.tracks.frame > frame
    position = of.tracks.position + np.where(later, random.normal(size=len(later)), 0.0)[:, None]
    heading = of.tracks.heading + np.where(later, 0.3, 0.0)
    velocity = of.tracks.velocity * np.where(later, 1.2, 1.0)[:, None]
    other = dataclasses.replace(
        of, tracks=dataclasses.replace(of.tracks, position=position, heading=heading, velocity=velocity)
    )
    now, then = scenes_of(of, config), scenes_of(other, config)
    at = [
        [i for i, entry in enumerate(data.provenance(range(len(data)))) if entry["frame"] == frame]
        for _, data in (now, then)
    ]
    assert at[0]
    here, there = now[0][at[0]], then[0][at[1]]
    for name in ("history", "goal_candidates", "references", "reference_speed", "lanes", "frame", "size"):
        # A recording's origin is the mean of all its positions, which moves what is rounded.
        torch.testing.assert_close(getattr(here, name), getattr(there, name), rtol=0, atol=1e-4, msg=name)
    assert (here.future - there.future).abs().max() > 0.1


def test_a_map_of_another_place_is_refused():
    of = recording()
    with pytest.raises(RecordingError, match="road: 100% of the positions of moving vehicles lie on no lane"):
        extract(dataclasses.replace(of, lanes=recording(curve(None, 0.0, (0.0, 500.0))).lanes), WindowConfig())


@pytest.mark.parametrize(("shape", "frame"), [("box", "aligned"), ("disc", "fixed")])
def test_scenes_belong_to_the_subset_of_their_definition(shape, frame):
    # Vehicle 5 would hit vehicle 7, which is slower, if it did not brake in every scene.
    vehicles = [(3, 0.0, 0, 25.0, None), (5, 30.0, 1, 31.0, None), (7, 55.0, 1, 25.0, None), (9, 90.0, 0, 25.0, 2.0)]
    of = recording(vehicles=vehicles)
    found, _ = extract(of, WindowConfig())
    columns = tables(found)
    (rows,) = (columns["track"] == 5).nonzero(as_tuple=True)
    now, future = columns["history"][rows, -1:], columns["future"][rows]
    slower = now[..., :2] + 0.8 * (future - now)[..., :2]
    columns["future"][rows] = torch.cat((slower, future[..., 2:3], 0.8 * future[..., 3:]), -1)
    data = RecordedScenes(columns, 0.2, frame, [of.name], shape)
    whole = data[torch.arange(len(data))]
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    expected = [any(interact(whole.to(torch.double), row, i, j, shape) for i, j in pairs) for row in range(len(data))]
    assert whole.subset.tolist() == expected
    assert {*expected} == {False, True}
    again = RecordedScenes(columns, 0.2, frame, [of.name], shape)
    mixed = torch.arange(len(data)).flip(0)[::3]
    assert again[mixed].subset.tolist() == again[mixed].subset.tolist() == whole.subset[mixed].tolist()
    assert again[torch.arange(len(data))].subset.tolist() == expected, "some of the scenes were read before"
    assert RecordedScenes(columns, 0.2, frame, [of.name])[mixed].subset is None


def test_joined_scenes_are_the_same_scenes():
    one, two = (recording(curve(900.0, turn), name=f"{turn}") for turn in (0.0, 1.0))
    parts = [extract(of, WindowConfig())[0] for of in (one, two)]
    both = RecordedScenes(tables(joined(parts)), 0.2, "fixed", [one.name, two.name])
    first, second = (RecordedScenes(tables(part), 0.2, "fixed", ["?"]) for part in parts)
    assert len(both) == len(first) + len(second)
    index = torch.arange(len(second))
    ours, theirs = both[index + len(first)], second[index]
    for field in dataclasses.fields(ours):
        if isinstance(getattr(ours, field.name), torch.Tensor) and field.name != "id":
            assert torch.equal(getattr(ours, field.name), getattr(theirs, field.name)), field.name
    assert both.provenance([len(first)])[0]["recording"] == "1.0"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("agents", 65, "agents must be 64 or less"),
        ("lanes", 10**6, "lanes must be 4096 or less, or null for all that an agent may reach"),
        ("horizon", 1, "horizon must be a whole number, 2 or more"),
        ("smoothing", 1e9, "smoothing must be 10 s or less"),
        ("history", 1, "data.windows.history must be a whole number, 2 or more, not 1"),
        ("agents", 0, "data.windows.agents must be a whole number, 1 or more, not 0"),
        ("every", None, "data.windows.every must be a whole number, 1 or more, not None"),
        (
            "history",
            np.int64(10),
            "data.windows.history must be a whole number",
        ),  # JSON, which identifies data, has none
        ("history", 10.5, "data.windows.history must be a whole number, 2 or more, not 10.5"),
        ("least_agents", 5, "must not be more than"),
        ("radius", -1.0, "data.windows.radius must be a number, positive, and finite, or null, not -1.0"),
        ("dt", 0.0, "data.windows.dt must be a number, positive, and finite, not 0.0"),
    ],
)
def test_invalid_window_settings_are_refused(key, value, message):
    with pytest.raises(ConfigError, match=message):
        WindowConfig(**{key: value})


def test_a_lane_change_of_an_agent_elsewhere_does_not_count():
    """Two pairs of vehicles, 300 m apart; the last vehicle of the recording changes lane."""
    places = ((1, 0.0, 0), (2, 15.0, 1), (3, 300.0, 1), (4, 320.0, 0))
    of = recording(vehicles=[(*place, 20.0, 2.0 if place[0] == 4 else None) for place in places])
    _, data = scenes_of(of, WindowConfig(agents=3, least_agents=2))
    assert {frozenset(entry["tracks"]) for entry in data.provenance(range(len(data)))} == {frozenset((3, 4))}


@pytest.mark.parametrize(("radius", "found"), [(30.0, True), (29.99, False)])
def test_a_neighbour_may_be_as_far_away_as_the_radius(radius, found):
    """Two vehicles that stand 30 m apart."""
    of = recording(vehicles=[(1, 100.0, 0, 0.0, None), (2, 130.0, 0, 0.0, None)])
    scenes, _ = extract(of, WindowConfig(agents=2, least_agents=2, radius=radius, lane_change=False))
    assert (scenes is not None) == found
