"""One clock for all agents: against scipy's filter and plain interpolation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from epo_lightning.data.recorded.clock import stretches
from epo_lightning.data.recorded.tracks import TrackTable
from epo_lightning.registry import ConfigError

from .roads import FOUR, curve, traffic


def walk(seed: int, rate: float, lengths: list[int], gap: int = 3) -> TrackTable:
    """Agents that wander and turn, each seen in one stretch or in two with a gap between them."""
    random = np.random.default_rng(seed)
    agent, frame = [], []
    for number, length in enumerate(lengths):
        steps = np.arange(length) + int(random.integers(0, 30))
        steps[length // 2 :] += gap * (number % 2)
        agent.append(np.full(length, number))
        frame.append(steps)
    rows = sum(lengths)
    heading = np.concatenate([np.cumsum(random.normal(size=length) * 0.3) for length in lengths])
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    return TrackTable(
        rate=rate,
        agent=np.concatenate(agent),
        frame=np.concatenate(frame),
        position=random.normal(size=(rows, 2)).cumsum(0),
        heading=wrapped,
        velocity=random.normal(size=(rows, 2)),
        ids=np.arange(len(lengths)),
        size=np.ones((len(lengths), 2)),
        kind=np.zeros(len(lengths), int),
    )


def pieces(tracks: TrackTable):
    """Rows of every uninterrupted stretch, by a loop."""
    found, rows = [], [0]
    for row in range(1, len(tracks)):
        if tracks.agent[row] != tracks.agent[row - 1] or tracks.frame[row] != tracks.frame[row - 1] + 1:
            found.append(rows)
            rows = []
        rows.append(row)
    return [*found, rows]


@given(st.integers(0, 10_000), st.sampled_from([(25.0, 0.2), (10.0, 0.2), (30.0, 0.2), (7.0, 0.5), (2.5, 0.4)]))
@settings(max_examples=40)
def test_states_are_interpolated_on_a_common_clock(seed, times):
    rate, dt = times
    tracks = walk(seed, rate, [40, 61, 83])
    clock, dropped = stretches(tracks, dt, None, shortest=1)
    assert dropped["gaps in tracks"] == 1
    expected = []
    for rows in pieces(tracks):
        time = tracks.frame[rows] / rate
        steps = np.arange(np.ceil(time[0] / dt - 1e-6), np.floor(time[-1] / dt + 1e-6) + 1)
        heading = np.unwrap(tracks.heading[rows])
        columns = [*tracks.position[rows].T, heading, *tracks.velocity[rows].T]
        x, y, angle, vx, vy = (np.interp(steps * dt, time, column) for column in columns)
        expected.append(np.stack([x, y, angle, vx * np.cos(angle) + vy * np.sin(angle)], 1))
    assert clock.count.tolist() == [len(part) for part in expected]
    np.testing.assert_allclose(clock.state, np.concatenate(expected), atol=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_smoothing_equals_a_savitzky_golay_filter(seed):
    tracks = walk(seed, 10.0, [40, 61, 83, 12])
    clock, dropped = stretches(tracks, 0.1, 1.0, shortest=1)  # windows of eleven rows; every row is a step
    kept = [rows for rows in pieces(tracks) if len(rows) >= 11]
    assert dropped["tracks shorter than a window"] == len(pieces(tracks)) - len(kept)
    smooth = lambda values, **how: savgol_filter(values, 11, 2, axis=0, **how)  # noqa: E731
    expected = []
    for rows in kept:
        angle = smooth(np.unwrap(tracks.heading[rows]))
        velocity = smooth(tracks.position[rows], deriv=1, delta=0.1)
        along = velocity[:, 0] * np.cos(angle) + velocity[:, 1] * np.sin(angle)
        expected.append(np.column_stack([smooth(tracks.position[rows]), angle, along]))
    np.testing.assert_allclose(clock.state, np.concatenate(expected), atol=1e-8)


def test_states_without_later_frames_are_those_of_their_own_times_also_between_frames():
    def states(time):
        heading = 0.2 + 0.3 * time
        along = (2.0 + time) * np.cos(heading) + (0.6 * time - 1.0) * np.sin(heading)
        return np.stack([2.0 * time + 0.5 * time**2, 0.3 * time**2 - time, heading, along], -1)

    rate, dt, frame = 25.0, 0.1, np.arange(5, 105)
    motion = states(frame / rate)
    tracks = TrackTable(
        rate=rate,
        agent=np.zeros(100, int),
        frame=frame,
        position=motion[:, :2],
        heading=motion[:, 2],
        velocity=np.zeros((100, 2)),
        ids=np.array([0]),
        size=np.ones((1, 2)),
        kind=np.array([0]),
    )
    clock, _ = stretches(tracks, dt, 1.0, shortest=1)
    assert clock.ending is not None
    time = dt * (clock.first[0] + np.arange(clock.count[0]))
    whole = time * rate >= frame[24]  # 25 frames until then
    assert 0 < whole.sum() < len(time)
    assert clock.ending.shape[1] == 5, "steps that the centred window of a second would smooth with later frames"
    for before in range(5):
        np.testing.assert_allclose(clock.ending[whole, before], states(time[whole] - before * dt), atol=1e-9)


def test_a_clock_faster_than_the_recording_is_refused():
    with pytest.raises(ConfigError, match=r"data\.windows\.dt=0\.02 .* 25 frames per second: use 0\.04"):
        stretches(traffic(curve(None), FOUR), 0.02, None, 1)


def test_a_clock_that_is_much_faster_than_the_recording_is_refused_before_it_fills_the_memory():
    with pytest.raises(
        ConfigError, match=r"more than 20 steps between two of the recording's 7 frames .* use 0\.0072 or"
    ):
        stretches(walk(0, 7.0, [40]), 1e-6, None, 1, interpolate=True)
    assert len(stretches(walk(0, 7.0, [40]), 0.0072, None, 1, interpolate=True)[0].state)


@given(
    st.integers(0, 10_000),
    st.sampled_from([(2.5, 0.2), (2.5, 0.1), (2.5, 0.25), (23.98, 0.2), (7.0, 0.5), (25.0, 0.1)]),
)
@settings(max_examples=30)
def test_clocks_between_frames_interpolate_the_past_and_continue_the_present(seed, times):
    """Against a loop over the frames that are known at each step: those up to it."""
    rate, dt = times
    tracks = walk(seed, rate, [40, 61, 83])
    clock, _ = stretches(tracks, dt, None, shortest=1, interpolate=True)
    assert clock.ending is not None
    deep = clock.ending.shape[1]
    assert deep == max(1, np.ceil(1 / (dt * rate) - 1e-6))
    for stretch, rows in enumerate(pieces(tracks)):
        time, heading = tracks.frame[rows] / rate, np.unwrap(tracks.heading[rows])
        motion = np.column_stack([tracks.position[rows], heading, tracks.velocity[rows]])
        for step in range(0, clock.count[stretch], 7):
            now = (clock.first[stretch] + step) * dt
            known = time <= now + 1e-9
            last = motion[known][-1]
            for before in range(min(deep, step + 1)):
                at = now - before * dt
                if at > time[known][-1] + 1e-9:
                    x, y = last[:2] + last[3:] * (at - time[known][-1])
                    angle, vx, vy = last[2:]
                else:
                    x, y, angle, vx, vy = (np.interp(at, time[known], column) for column in motion[known].T)
                wanted = [x, y, angle, vx * np.cos(angle) + vy * np.sin(angle)]
                found = clock.ending[clock.start[stretch] + step, before]
                np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_clocks_on_frames_need_no_estimate():
    for rate, dt in ((25.0, 0.2), (10.0, 0.2), (2.5, 0.4)):
        assert stretches(walk(0, rate, [40, 61]), dt, None, shortest=1)[0].ending is None


def test_a_recording_without_traffic_has_no_tracks():
    tracks = traffic(curve(None), FOUR)
    empty = {f.name: getattr(tracks, f.name)[:0] for f in dataclasses.fields(tracks) if f.name != "rate"}
    clock, _ = stretches(TrackTable(rate=10.0, **empty), 0.2, 1.0, 1)
    assert len(clock.count) == len(clock.state) == 0


@pytest.mark.parametrize("smoothing", [0.01, 0.2])
def test_the_shortest_window_of_the_filter_has_three_frames(smoothing):
    """A parabola through three points keeps them; its derivative is the slope of a chord."""
    tracks = dataclasses.replace(walk(1, 10.0, [40]), heading=np.zeros(40))
    clock, _ = stretches(tracks, 0.1, smoothing, shortest=1)
    np.testing.assert_allclose(clock.state[:, :2], tracks.position, atol=1e-9)
    np.testing.assert_allclose(clock.state[1:-1, 3], (tracks.position[2:, 0] - tracks.position[:-2, 0]) * 5, atol=1e-9)


def test_the_first_complete_window_of_the_filter_ends_at_its_last_frame():
    """Positions move on although recorded velocities are zero; 25 frames of a second show it."""
    frame = np.arange(1, 61)
    tracks = dataclasses.replace(
        walk(0, 25.0, [60]),
        frame=frame,
        position=np.stack([frame / 25.0, 0.0 * frame], 1),
        heading=np.zeros(60),
        velocity=np.zeros((60, 2)),
    )
    clock, _ = stretches(tracks, 0.2, 1.0, shortest=1)
    assert clock.first.tolist() == [1]
    np.testing.assert_allclose(clock.ending[:, 0, 3], [0.0] * 4 + [1.0] * 8, atol=1e-9)
