"""The record of an episode in traffic: neighbours, histories, tracks, and contacts from all sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.drive.ride import RADIUS, SEEN, WINDOWS, Moment, Position, Ride, Simulation, contacts

LENGTH, WIDTH = 4.0, 2.0


def moment(*states: Sequence[float], names: Sequence[str] = ()) -> Moment:
    """Vehicles at one moment, by default with the names 0, 1, ..."""
    count = len(states)
    return Moment(
        names=names or [str(number) for number in range(count)],
        states=np.array(states, dtype=float),
        size=np.tile([LENGTH, WIDTH], (count, 1)),
        kind=np.zeros(count, dtype=int),
    )


class Replay:
    """A simulation whose first moments are given; the planned vehicle never arrives."""

    lanes = cast(LaneGraph, None)

    def __init__(self, *moments: Moment) -> None:
        self.moments, self.ended = list(moments), 0

    def history(self) -> list[Moment]:
        return list(self.moments)

    def position(self, state: np.ndarray) -> Position:
        return Position(progress=float(state[0]), arrived=False, off_road=False, line=1)

    def step(self, way: Any) -> None:
        raise AssertionError("no step is simulated")

    def moment(self) -> Moment:
        raise AssertionError("no step is simulated")

    def end(self) -> None:
        self.ended += 1


def ride(*moments: Moment, steps: int = 10) -> Ride:
    return Ride(cast(Simulation, Replay(*moments)), steps)


def test_a_contact_is_from_behind_if_all_vehicles_that_touch_are_behind() -> None:
    """The planned vehicle drives along y."""
    ego, rest = (0.0, 0.0, math.pi / 2, 10.0), (math.pi / 2, 10.0)
    behind, ahead = (0.0, -3.5, *rest), (0.0, 3.5, *rest)
    beside = (1.5, -0.25 * LENGTH + 0.1, *rest)  # its centre is not far enough behind
    far = (0.0, -5.0, *rest)
    sides = ([behind], [ahead], [beside], [behind, ahead], [far], [behind, far])
    found = contacts([moment(ego, *others) for others in sides])
    assert [contact.touches for contact in found] == [True, True, True, True, False, True]
    assert [contact.from_behind for contact in found] == [True, False, False, False, False, True]


def test_neighbours_are_near_where_the_vehicle_is_or_will_be() -> None:
    ego = (0.0, 0.0, math.pi / 2, 20.0)  # in a second it is at (0, 20)
    places = [(0.0, -25.0), (15.0, 0.0), (0.0, 30.0), (0.0, 20.0 + 0.9 * RADIUS), (-1.1 * RADIUS, 0.0)]
    near = ride(moment(ego, *((x, y, 0.0, 0.0) for x, y in places))).near()
    assert near.tolist() == [3, 2, 1, 4]


def test_the_nearest_vehicles_are_shown_and_keep_their_places() -> None:
    """A forecaster knows the first ones of a scene."""
    known = WINDOWS.agents
    states = [(10.0 * number, 0.0, 0.0, 0.0) for number in range(SEEN + 2)]
    driving = ride(moment(*states))

    def shown() -> list[float]:
        history, seen, there, _, _ = driving.history()
        assert (seen[:, -1] == there).all()
        return [float(x) / 10 for x in history[there, -1, 0]]

    driving.choose(np.arange(1, SEEN + 2))
    assert shown() == list(range(SEEN))
    nearest = [*reversed(range(1, known)), *range(known + 1, SEEN + 2)]
    driving.choose(np.array(nearest))
    assert shown() == [*range(known), SEEN, *range(known + 1, SEEN)], "one vehicle has taken the place of another"
    driving.choose(np.array([2]))
    assert shown() == [0, 2]


def test_histories_end_at_present_and_headings_are_continuous() -> None:
    """Three moments are known; the second vehicle appears in the last two of them."""
    turning = [(float(step), 0.0, heading, 1.0) for step, heading in enumerate((3.1, -3.1, -3.0))]
    there = (5.0, 5.0, 0.0, 2.0)
    driving = ride(moment(turning[0]), *(moment(state, there) for state in turning[1:]))
    driving.choose(np.array([1]))
    history, seen, present, size, _ = driving.history()
    assert present.tolist() == [True, True] + [False] * (SEEN - 2)
    assert seen[:2].sum(1).tolist() == [3, 2]
    assert seen[0, -3:].all()
    assert seen[1, -2:].all()
    assert history[0, -3:, 0].tolist() == [0.0, 1.0, 2.0]
    assert np.diff(history[0, -3:, 2]) == pytest.approx([2 * math.pi - 6.2, 0.1])
    assert size[:2].tolist() == [[LENGTH, WIDTH]] * 2


def test_tracks_are_those_of_all_vehicles_that_were_among_the_nearest() -> None:
    ego = (0.0, 0.0, 0.0, 1.0)
    rows = [(number * 10.0, 0.0, 0.0, float(number)) for number in range(1, 5)]
    driving = ride(moment(ego, *rows), steps=2)
    # Two vehicles have left, and the last one came near.
    later = moment(ego, (5.0, 0.0, 0.0, 4.0), rows[0], names=["0", "4", "1"])
    for recorded in range(2):
        assert not driving.over
        driving.record(later, contacts([later])[0])
        assert cast(Replay, driving.simulation).ended == recorded
    assert driving.over, "its two steps are made"
    states, mask, _ = driving.tracks(near=2)
    assert states[:, 0, 3].tolist() == [1.0, 1.0, 2.0, 4.0], "the vehicles 0, 1, 2 and 4"
    assert mask.tolist() == [[True] * 3, [True] * 3, [True, False, False], [True] * 3]
    assert states[3, :, 0].tolist() == [40.0, 5.0, 5.0]
