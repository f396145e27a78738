"""Doubts about the tracks and lanes of a recording: values that are allowed, and nearly always a mistake.

Tracks may have another unit, other axes or other frames, and lines of lanes may have points in another order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.tracks import TrackTable
from epo_lightning.scene import KINDS

MOVING, CLEAR = 1.0, 0.5
"""Stated speed [m/s] above which a step counts, and speed of a displacement above which it has a clear direction."""
FEWEST = 20
"""Number of such steps from which on a recording is judged."""
RATIO, ANGLE = 1.25, 30.0
"""Largest ratio of speeds in positions and velocities, in either direction, and largest angle [degrees]; medians."""
RATIO_OF_KIND = 1.75
"""The same ratio for the agents of one kind: recorded speeds of a kind may lag behind (cars of DUT)."""
SMALL, BETTER = 1.0, 0.5
"""Angle [degrees] from which on other readings of headings are tried, and the share of it that shows a better one."""
MISREAD: Mapping[str, Callable[[Float[np.ndarray, " steps"]], Float[np.ndarray, " steps"]]] = {
    "degrees": np.deg2rad,
    "radians where degrees were expected": np.rad2deg,
    "clockwise": np.negative,
}
"""Other readings of headings, by their names."""
VEHICLES = [KINDS.index(kind) for kind in ("car", "van", "truck", "bus")]
"""Kinds that are longer than wide."""
AWAY, STILL = 5.0, 0.1
"""Way [m] from which on an agent has moved, and the share of it below which its velocities say that it stands."""
JUMP = 3.0
"""Largest distance [m] of the end of a step from where the velocities lead; 1.3 m occur in real recordings."""
TURNS, PIECE = 2, 0.1
"""Smallest number of turns by more than 90 degrees of a line that is doubted, and length [m] from which on a piece beside
such a turn counts. Lines in real maps have no such turn."""


def doubts_of_lanes(lanes: LaneGraph) -> list[str]:
    """A sentence on lines of lanes that turn back several times, as lines do whose points are in another order."""
    wrong = [
        f"the {name} line of lane {lane}"
        for name in ("left", "right", "centre")
        for lane, line in zip(lanes.ids, getattr(lanes, name), strict=True)
        if _turns_back(line) >= TURNS
    ]
    if not wrong:
        return []
    return [
        f"lines of lanes that turn back by more than 90 degrees {TURNS} times or more: {len(wrong)}, the first one is "
        f"{wrong[0]}: are their points in the order of driving?"
    ]


def _turns_back(line: Float[np.ndarray, "n 2"]) -> int:
    """Number of points at which a line turns by more than 90 degrees between two pieces that are not tiny."""
    step = np.diff(line, axis=0)
    clear = _length(step) > PIECE
    back = (step[1:] * step[:-1]).sum(-1) < 0
    return int((back & clear[1:] & clear[:-1]).sum())


def doubts(tracks: TrackTable) -> list[str]:
    """Sentences on frames that are apart, and on positions, velocities and headings that contradict each other."""
    same = np.diff(tracks.agent) == 0
    apart = np.diff(tracks.frame)[same]
    found = []
    if len(apart) and np.median(apart) > 1:
        frames = np.median(apart)
        found.append(
            f"the frames of a track are {frames:g} apart in the median, so that it has gaps nearly everywhere: is the frame "
            f"rate {tracks.rate / frames:g} Hz instead of {tracks.rate:g} Hz, with frames 0, 1, 2, ...?"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.diff(tracks.position, axis=0)[same] * (tracks.rate / apart)[:, None]
    stated = 0.5 * (tracks.velocity[1:] + tracks.velocity[:-1])[same]
    steps = _Steps(moved, stated, tracks.heading[1:][same])
    of_all = _contradictions(steps, "agents", RATIO)
    if not of_all:
        # Few agents of a kind, such as cars in a crowd, disappear in the median over all.
        kind = tracks.kind[tracks.agent[1:][same]]
        for index in np.unique(kind) if (kind != kind[:1]).any() else ():
            of_all += _contradictions(steps.of(kind == index), f"agents of the kind {KINDS[index]}", RATIO_OF_KIND)
    return [*found, *of_all, *_standing(tracks), *_broad(tracks), *([] if of_all else _jumps(tracks, same, steps))]


class _Steps(NamedTuple):
    """Steps from one row of an agent to the next: velocities [m/s] in positions and as stated, and headings [rad]."""

    moved: Float[np.ndarray, "steps 2"]
    stated: Float[np.ndarray, "steps 2"]
    heading: Float[np.ndarray, " steps"]

    def of(self, chosen: Bool[np.ndarray, " steps"]) -> _Steps:
        """Some of the steps."""
        return _Steps(*(values[chosen] for values in self))


def _contradictions(steps: _Steps, agents: str, most: float) -> list[str]:
    """Sentences on positions, velocities and headings of steps; ``most`` is the largest ratio of speeds.

    ``agents`` is the subject of the sentences, such as "agents".
    """
    steps = steps.of(_length(steps.stated) > MOVING)
    if len(steps.moved) < FEWEST:
        return []
    found = []
    clear = steps.of(_length(steps.moved) > CLEAR)
    enough = len(clear.moved) >= FEWEST
    if enough and (angle := _angle(clear.moved, clear.stated)) > ANGLE:
        return [
            f"{agents} move in another direction than that of their velocities, by {angle:.0f} degrees in the median: have "
            "positions and velocities the same axes, x and y?"
        ]
    # Along the velocity: noise of positions makes displacements longer, but not in this direction.
    ratio = float(np.median((steps.moved * steps.stated).sum(-1) / (steps.stated**2).sum(-1)))
    if not 1 / most <= ratio <= most:
        found.append(
            f"{agents} move {ratio:.2g} times as fast in their positions as their velocities say, in the median: are both "
            "in m and m/s, and is the frame rate right?"
        )
    if not enough:
        return found
    angle = _angle(clear.moved, _ahead(clear.heading))
    if angle > ANGLE:
        found.append(
            f"{agents} move in another direction than that of their headings, by {angle:.0f} degrees in the median: "
            "headings are in rad, counter-clockwise from x"
        )
    elif angle > SMALL:
        # On a straight road along x, headings in a wrong unit or sense are near the right ones.
        others = {name: _angle(clear.moved, _ahead(turn(clear.heading))) for name, turn in MISREAD.items()}
        name = min(others, key=lambda each: others[each])
        if others[name] < BETTER * angle:
            found.append(
                f"headings of {agents} fit the directions of motion better if they are taken as {name}: by "
                f"{others[name]:.2g} instead of {angle:.2g} degrees in the median; are unit and sense right?"
            )
    return found


def _standing(tracks: TrackTable) -> list[str]:
    """A sentence on agents that get somewhere although their velocities say that they stand."""
    if not len(tracks):
        return []
    first = np.flatnonzero(np.diff(tracks.agent, prepend=-1))
    last = np.append(first[1:], len(tracks)) - 1
    way = _length(tracks.position[last] - tracks.position[first])
    mean = np.add.reduceat(_length(tracks.velocity), first) / (last - first + 1)
    far = way > AWAY
    slow = far & (mean * (tracks.frame[last] - tracks.frame[first]) / tracks.rate < STILL * way)
    if 2 * slow.sum() <= far.sum():
        return []
    return [
        f"{slow.sum()} of {far.sum()} agents that move {AWAY:g} m or more have velocities near zero: are the velocities "
        "missing, or in another unit than m/s?"
    ]


def _broad(tracks: TrackTable) -> list[str]:
    """A sentence on vehicles that are wider than long."""
    length, width = tracks.size[np.isin(tracks.kind, VEHICLES)].T
    broad = int((width > length).sum())
    if 2 * broad <= len(length):
        return []
    return [f"{broad} of {len(length)} vehicles are wider than long: are lengths and widths exchanged?"]


def _jumps(tracks: TrackTable, same: Bool[np.ndarray, " n"], steps: _Steps) -> list[str]:
    """A sentence on single steps that are far longer than the velocities before and after them allow."""
    rows = np.flatnonzero(same)
    consecutive = np.diff(tracks.frame)[rows] == 1
    beyond = _length(steps.moved - steps.stated) / tracks.rate
    wrong = np.flatnonzero(consecutive & (beyond > JUMP))
    if not len(wrong):
        return []
    row = rows[wrong[0]]
    return [
        f"{len(wrong)} steps of tracks end more than {JUMP:g} m from where their velocities lead, the first one after frame "
        f"{tracks.frame[row]} of track {tracks.ids[tracks.agent[row]]}: is its id that of two agents, or a position wrong?"
    ]


def _ahead(heading: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "steps 2"]:
    return np.stack((np.cos(heading), np.sin(heading)), -1)


def _length(vectors: Float[np.ndarray, "steps 2"]) -> Float[np.ndarray, " steps"]:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _angle(one: Float[np.ndarray, "steps 2"], other: Float[np.ndarray, "steps 2"]) -> float:
    """The median angle between vectors [degrees]."""
    cosine = (one * other).sum(-1) / (_length(one) * _length(other))
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))
