"""Routes through junctions: reference lines along all successors within reach, and goal candidates on them.

An agent may follow any successor of its lane, and may change once to a neighbouring lane of its way. Where lanes overlap, as
on a junction, it may be on any lane near it whose direction is similar to its heading. Of all centrelines that differ within
its reach, the R most reachable ones are kept, see :func:`choose_lines`; if there are fewer, the boundaries of the same lanes
follow, because vehicles cut bends or swing wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from epo_lightning.data.recorded.lanes import SHOULDER, LaneGraph, Located, Polylines
from epo_lightning.data.recorded.routes import (
    BACKWARDS,
    BEHIND,
    BEYOND,
    BRAKING,
    PER_LINE,
    POINTS,
    SHORTEST,
    Route,
    direction,
    follow,
    polyline_length,
    reach,
    straightest,
)

NEAR = 2.0
"""Largest distance [m] from a lane to an agent that may be on it."""
ASKEW = np.pi / 3
"""Largest angle [rad] between the direction of such a lane and the agent's heading."""
CHANGE = 4.0
"""Cost [m] of a lane change, as much as such an offset from the line."""
SIDEWAYS = 5.0
"""Largest lateral acceleration [m/s^2]: a bend that an agent cannot take with it, though it brakes, is out of reach."""
BESIDES = 500.0
"""Cost [m] of a lane's boundary: boundaries are used after all centrelines that are in reach."""
UNREACHABLE = 1000.0
"""Cost [m] of a line with such a bend: it is used only if there are lines to spare."""
APART = 1.0
"""Lines whose points differ by less than this [m] within an agent's reach are the same."""
MOST_WAYS = 64
"""Largest number of ways of an agent that are compared."""


class Way(NamedTuple):
    """A way from an agent over lanes.

    Attributes:
        lanes: lanes of the way, in driving order; the agent is projected on the first one.
        cost: how far the agent is from the way: offset, difference in direction and lane changes [m].
    """

    lanes: tuple[int, ...]
    cost: float


@dataclass(frozen=True)
class _Lines:
    """Lines of ways: whole geometry, that of the first lane, and the arc length at which this lane begins [m]."""

    whole: Polylines
    parts: Polylines
    begin: Float[np.ndarray, " n"]


def ways(
    starts: Sequence[tuple[int, float, float]], far: float, lanes: LaneGraph, length: Sequence[float]
) -> list[Way]:
    """All ways of an agent within its reach, cheapest first.

    Args:
        starts: lane, arc length on it [m] and cost [m] of every lane on which the agent may be.
        far: arc length [m] within which lanes are followed.
        lanes: the lane graph.
        length: length of every lane [m].
    """
    found: list[Way] = []
    changes: list[tuple[float, int, int, tuple[int, ...], float, float]] = []
    for lane, along, cost in starts:
        for path, begins in _followed(lane, -along, far, lanes, length):
            found.append(Way(path, cost))
            for place, (each, gone) in enumerate(zip(path, begins, strict=True)):
                for neighbour in (int(lanes.left_of[each]), int(lanes.right_of[each])):
                    if neighbour < 0 or lanes.kind[neighbour] == SHOULDER:
                        continue
                    if place == 0 or not _begins_behind(neighbour, each, lanes):
                        changes.append((max(gone, 0.0), len(changes), neighbour, path[:place], gone, cost + CHANGE))
    seen = {lane for way in found for lane in way.lanes}
    for _, _, neighbour, before, gone, cost in sorted(changes):
        if neighbour in seen or len(found) >= MOST_WAYS:
            continue
        # A lane that begins ahead (a turning bay, or a road that joins from another direction) is reached over the lanes
        # of the agent's way before it, because its own predecessors may be far from the agent.
        for path, _ in _followed(neighbour, gone, far, lanes, length):
            found.append(Way((*before, *path), cost))
            seen |= set(path)
    return sorted(found, key=lambda way: way.cost)[:MOST_WAYS]


def _begins_behind(lane: int, beside: int, lanes: LaneGraph) -> bool:
    """Whether a lane begins more than ``BEHIND`` behind the lane beside it: a way from there onto it would lead back."""
    start = lanes.centre[beside][0]
    ahead = (lanes.centre[lane][0] - start) @ direction(lanes.centre[beside], at_end=False)
    return bool(ahead < -BEHIND)


def _followed(
    lane: int, begin: float, far: float, lanes: LaneGraph, length: Sequence[float]
) -> list[tuple[tuple[int, ...], tuple[float, ...]]]:
    """Paths from a lane along all successors until the arc length ``far`` or the end of the map, without loops.

    Args:
        begin: arc length from the agent to the beginning of the lane, negative if it lies behind [m].

    Returns:
        lanes of each path, and the arc lengths from the agent to their beginnings [m].
    """
    found: list[tuple[tuple[int, ...], tuple[float, ...]]] = []
    waiting: list[tuple[tuple[int, ...], tuple[float, ...]]] = [((lane,), (begin,))]
    while waiting and len(found) < MOST_WAYS:
        path, begins = waiting.pop()
        end = begins[-1] + length[path[-1]]
        following = [other for other in lanes.successors[path[-1]] if other not in path] if end < far else []
        if not following:
            found.append((path, begins))
        waiting += [((*path, other), (*begins, end)) for other in reversed(following)]
    return found


class Junctions:
    """Reference lines and goal candidates along all successors of a map.

    Args:
        lanes: the lane graph.
        most: largest number R of lines per agent.
    """

    def __init__(self, lanes: LaneGraph, most: int) -> None:
        self.lanes, self.most = lanes, most
        self.ahead = straightest(lanes.successors, lanes, forwards=True)
        self.back = straightest(lanes.predecessors, lanes, forwards=False)

    def of(
        self,
        position: Float[np.ndarray, "n 2"],
        heading: Float[np.ndarray, " n"],
        speed: Float[np.ndarray, " n"],
        located: Located,
        time: float,
    ) -> Route:
        """Reference lines and goal candidates of agents.

        Args:
            position, heading, speed: positions [m], headings [rad] and speeds [m/s] of the agents.
            located: lanes of the agents; every agent must be on a lane.
            time: horizon within which goals are reached [s].
        """
        near, far = reach(speed, time)
        found = self._ways(position, heading, located, far)
        number: dict[tuple[int, ...], int] = {}
        line = np.full((len(found), max(map(len, found), default=1)), -1)
        cost = np.full(line.shape, np.inf)
        for row, of_agent in enumerate(found):
            for place, way in enumerate(of_agent):
                line[row, place] = number.setdefault(way.lanes, len(number))
                cost[row, place] = way.cost
        lines = self._lines(list(number))
        # Centrelines, then left and right boundaries.
        line = np.concatenate([np.where(line < 0, -1, line + side * len(number)) for side in range(3)], 1)
        cost = np.concatenate([cost, cost + BESIDES, cost + BESIDES], 1)
        agent, column = np.nonzero(line >= 0)
        of = line[agent, column]
        on_part, _ = lines.parts.project(of, position[agent])
        along = np.full(line.shape, np.nan)
        along[agent, column] = lines.begin[of] + on_part

        def sample(lane: np.ndarray, at: np.ndarray, start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
            """Points [m, count, 2] of lines between two arc lengths from the agents' projections."""
            way = at[:, None] + np.linspace(start, end, count, axis=1)
            points, _ = lines.whole.at(np.repeat(lane, count), way.ravel())
            return points.reshape(len(lane), count, 2)

        points = np.full((*line.shape, PER_LINE, 2), np.nan)
        points[agent, column] = sample(of, along[agent, column], np.zeros(len(of)), far[agent], PER_LINE)
        cost = cost + UNREACHABLE * too_sharp(points, np.maximum(speed, 0.0), far)
        order, count = choose_lines(points, cost, self.most)
        # Absent lines repeat the first one, so that every number is finite; ``count`` says which exist.
        order = np.where(np.arange(self.most) < count[:, None], order, order[:, :1])
        chosen, start = (np.take_along_axis(values, order, 1).ravel() for values in (line, along))

        def all_lines(one: np.ndarray, other: np.ndarray, points_per_line: int) -> np.ndarray:
            begin, end = np.repeat(one, self.most), np.repeat(other, self.most)
            return sample(chosen, start, begin, end, points_per_line)

        candidates = all_lines(near, far, PER_LINE).reshape(len(found), self.most * PER_LINE, 2)
        references = all_lines(np.full_like(far, -BEHIND), far + BEYOND, POINTS)
        references = references.reshape(len(found), self.most, POINTS, 2)
        return Route(references, candidates, np.repeat(np.arange(self.most), PER_LINE), count)

    def _ways(
        self, position: np.ndarray, heading: np.ndarray, located: Located, far: Float[np.ndarray, " n"]
    ) -> list[list[Way]]:
        """The ways of every agent."""
        row, lane, along, cost = self.lanes.around(position, heading, NEAR, ASKEW)
        driving = self.lanes.kind[lane] != SHOULDER
        row, lane, along, cost = row[driving], lane[driving], along[driving], cost[driving]
        # The lane on which the agent is located comes first, in any case.
        own = np.arange(len(position))
        others = lane != located.lane[row]
        row = np.concatenate([own, row[others]])
        lane = np.concatenate([located.lane, lane[others]])
        along = np.concatenate([located.along, along[others]])
        cost = np.concatenate([np.zeros(len(own)), cost[others]])
        order = np.lexsort((cost, row))
        ends = np.searchsorted(row[order], np.arange(len(position) + 1))
        starts = list(zip(lane[order].tolist(), along[order].tolist(), cost[order].tolist(), strict=True))
        length = self.lanes.centrelines.length.tolist()
        return [
            ways(starts[ends[agent] : ends[agent + 1]], float(far[agent]), self.lanes, length) for agent in own.tolist()
        ]

    def _lines(self, paths: Sequence[tuple[int, ...]]) -> _Lines:
        """Centrelines, left and right boundaries of ways: their lanes, continued straight ahead and back."""
        length = self.lanes.centrelines.length
        whole, parts, begin = [], [], []
        for side in (self.lanes.centre, self.lanes.left, self.lanes.right):
            for path in paths:
                before = [lane for lane in follow(path[0], self.back, length, BACKWARDS)[:0:-1] if lane not in path]
                after = [
                    lane for lane in follow(path[-1], self.ahead, length, BEYOND + SHORTEST)[1:] if lane not in path
                ]
                whole.append(np.concatenate([side[lane] for lane in (*before, *path, *after)]))
                begin.append(polyline_length(np.concatenate([*(side[lane] for lane in before), side[path[0]][:1]])))
                parts.append(side[path[0]])
        return _Lines(Polylines(whole), Polylines(parts), np.array(begin))


def too_sharp(
    points: Float[np.ndarray, "n C P 2"], speed: Float[np.ndarray, " n"], far: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, "n C"]:
    """Mask of the lines with a bend that the agent cannot take with ``SIDEWAYS``, even if it brakes from now on.

    Args:
        points: points at even distances on each line, the first one beside the agent and the last one at ``far``.
        speed: speeds of the agents [m/s].
        far: arc length of the last points [m].
    """
    way = np.diff(points, axis=2)
    turn = way[:, :, :-1, 0] * way[:, :, 1:, 1] - way[:, :, :-1, 1] * way[:, :, 1:, 0]
    angle = np.abs(np.arctan2(turn, (way[:, :, :-1] * way[:, :, 1:]).sum(-1)))
    gap = far / (points.shape[2] - 1)
    curvature = angle / gap[:, None, None]
    gone = gap[:, None] * np.arange(1, points.shape[2] - 1)
    slowest = np.maximum(speed[:, None] ** 2 - 2 * BRAKING * gone, 0.0)
    return (slowest[:, None] * curvature > SIDEWAYS).any(-1)


def choose_lines(
    points: Float[np.ndarray, "n C P 2"], cost: Float[np.ndarray, "n C"], most: int
) -> tuple[Int[np.ndarray, "n R"], Int[np.ndarray, " n"]]:
    """Indices of the cheapest lines that differ from each other by ``APART`` at some point, and their number.

    Args:
        points: points of each line, NaN for absent lines.
        cost: cost of each line, infinite for absent lines.
        most: largest number R of lines; indices beyond an agent's number are 0.
    """
    rows = np.arange(len(cost))
    chosen = np.zeros((len(cost), most), dtype=int)
    count = np.zeros(len(cost), dtype=int)
    for column in np.argsort(cost, axis=1, kind="stable").T:
        candidate = points[rows, column]
        kept = np.isfinite(cost[rows, column]) & (count < most)
        for number in range(most):
            other = points[rows, chosen[:, number]]
            same = np.linalg.norm(candidate - other, axis=-1).max(-1) < APART
            kept &= ~(same & (number < count))
        chosen[rows[kept], count[kept]] = column[kept]
        count[kept] += 1
    return chosen, count
