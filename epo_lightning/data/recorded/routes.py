"""Routes: reference lines that an agent may follow, and goal candidates on them (Appendix E.1).

An agent on a lane may keep to it or change to a neighbouring lane. Its goal candidates are points on the centrelines of
these three lanes; on a side without a neighbouring lane, they lie on the boundary of its own lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.lanes import SHOULDER, LaneGraph, Located, Polyline, Polylines, without_repetitions

LINES = 3
"""Reference lines R per agent: left, own, right."""
PER_LINE = 20
"""Goal candidates per reference line: with three lines, G = 60 candidates per agent."""
POINTS = 24
"""Points Q of a reference line."""
BRAKING, ACCELERATING = 4.0, 3.0
"""Largest deceleration and acceleration of agents [m/s^2]: they bound the range of the goal candidates."""
BEHIND, BEYOND = 5.0, 10.0
"""Lengths [m] of reference lines behind an agent and beyond its farthest candidate."""
BACKWARDS, FORWARDS = 100.0, 500.0
"""Distances [m] over which the lanes before and after a lane are followed."""
SHORTEST = 10.0
"""Smallest length [m] of the range of goal candidates."""
VECTORS, SPACING = 10, 6.0
"""Vectors V of a lane polyline and their largest length [m]."""


@dataclass(frozen=True)
class Route:
    """Reference lines and goal candidates of n agents.

    Attributes:
        references: points of the reference lines [m].
        candidates: goal candidates [m].
        line: index of the reference line of each candidate; the same for all agents.
        count: number of lines of each agent, the first ones; the others repeat the first. None if every agent has all.
    """

    references: Float[np.ndarray, "n R Q 2"]
    candidates: Float[np.ndarray, "n G 2"]
    line: Int[np.ndarray, " G"]
    count: Int[np.ndarray, " n"] | None = None


def reach(speed: Float[np.ndarray, " n"], time: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Arc lengths [m] from agents to their nearest and farthest candidates: braking or accelerating for ``time`` [s]."""
    speed = np.maximum(speed, 0.0)
    far = speed * time + ACCELERATING * time**2 / 2
    stopping = np.minimum(speed / BRAKING, time)
    return np.minimum(speed * stopping - BRAKING * stopping**2 / 2, far - SHORTEST), far


class Routes:
    """Lines that continue every lane of a map forwards and backwards: its centreline and both boundaries."""

    def __init__(self, lanes: LaneGraph) -> None:
        self.lanes = lanes
        straight = straightest(lanes.successors, lanes, forwards=True)
        back = straightest(lanes.predecessors, lanes, forwards=False)
        length = lanes.centrelines.length
        chains = []
        for lane in range(len(lanes)):
            before = follow(lane, back, length, BACKWARDS)[:0:-1]
            chains.append((before, follow(lane, straight, length, FORWARDS)))
        sides = (lanes.centre, lanes.left, lanes.right)
        self.lines = Polylines(
            [np.concatenate([side[lane] for lane in (*before, *after)]) for side in sides for before, after in chains]
        )
        # A line may pass an agent twice, on a loop or a roundabout: agents are projected on the piece of their own lane.
        self.parts = Polylines([line for side in sides for line in side])
        self.begin = np.array(
            [
                polyline_length(np.concatenate([*(side[each] for each in before), side[lane][:1]]))
                for side in sides
                for lane, (before, _) in enumerate(chains)
            ]
        )
        self.beside = tuple(
            _first_beside([after for _, after in chains], neighbour, lanes, length)
            for neighbour in (lanes.left_of, lanes.right_of)
        )

    def of(
        self, position: Float[np.ndarray, "n 2"], speed: Float[np.ndarray, " n"], located: Located, time: float
    ) -> Route:
        """Reference lines and goal candidates of agents.

        Args:
            position, speed: positions [m] and speeds [m/s] of the agents.
            located: lanes of the agents; every agent must be on a lane.
            time: horizon within which goals are reached [s].
        """
        near, far = reach(speed, time)
        count, lane = len(self.lanes), located.lane
        chosen = []
        for side, (neighbour, distance) in enumerate(self.beside):
            reachable = (neighbour[lane] >= 0) & (distance[lane] - located.along < far)
            chosen.append(np.where(reachable, neighbour[lane], (1 + side) * count + lane))
        left, right = chosen
        lines = np.stack([left, lane, right], 1)  # [n, R]
        on_part, _ = self.parts.project(lines.ravel(), np.repeat(position, LINES, axis=0))
        along = self.begin[lines.ravel()] + on_part

        def sample(start: np.ndarray, end: np.ndarray, points: int) -> np.ndarray:
            way = np.linspace(start, end, points, axis=1)  # [n, points]
            at = along[:, None] + np.repeat(way, LINES, axis=0)
            found, _ = self.lines.at(np.repeat(lines.ravel(), points), at.ravel())
            return found.reshape(len(position), LINES, points, 2)

        candidates = sample(near, far, PER_LINE).reshape(len(position), LINES * PER_LINE, 2)
        references = sample(np.full_like(far, -BEHIND), far + BEYOND, POINTS)
        return Route(references, candidates, np.repeat(np.arange(LINES), PER_LINE))


def straightest(following: Sequence[tuple[int, ...]], lanes: LaneGraph, forwards: bool) -> Int[np.ndarray, " W"]:
    """For each lane the successor (or predecessor) with the smallest change of direction; -1 for none."""
    found = np.full(len(lanes), -1)
    for lane, others in enumerate(following):
        if others:
            here = direction(lanes.centre[lane], at_end=forwards)
            turns = [float(here @ direction(lanes.centre[other], at_end=not forwards)) for other in others]
            found[lane] = others[int(np.argmax(turns))]
    return found


def direction(line: Polyline, at_end: bool) -> Float[np.ndarray, " 2"]:
    """Unit vector of a line's direction at its beginning or end."""
    points = without_repetitions(line)
    way = points[-1] - points[-2] if at_end else points[1] - points[0]
    return way / np.linalg.norm(way)


def polyline_length(line: Polyline) -> float:
    """Length [m] along a line."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def follow(lane: int, following: Int[np.ndarray, " W"], length: Float[np.ndarray, " W"], distance: float) -> list[int]:
    """A lane and the lanes that follow it, up to ``distance`` [m] beyond its end or until a lane repeats."""
    chain, gone = [lane], 0.0
    while gone < distance:
        lane = int(following[lane])
        if lane < 0 or lane in chain:
            break
        chain.append(lane)
        gone += length[lane]
    return chain


def _first_beside(
    chains: list[list[int]], neighbour: np.ndarray, lanes: LaneGraph, length: np.ndarray
) -> tuple[Int[np.ndarray, " W"], Float[np.ndarray, " W"]]:
    """The first driving lane beside each lane or its continuation, and the distance [m] from the lane's start to it."""
    found, distance = np.full(len(lanes), -1), np.full(len(lanes), np.inf)
    for lane, chain in enumerate(chains):
        gone = 0.0
        for each in chain:
            other = int(neighbour[each])
            if other >= 0 and lanes.kind[other] != SHOULDER:
                found[lane], distance[lane] = other, gone
                break
            gone += length[each]
    return found, distance


def pieces(lanes: LaneGraph, vectors: int = VECTORS, spacing: float = SPACING) -> Float[np.ndarray, "T V+1 2"]:
    """Lane polylines for the network: all centrelines cut into pieces of V ``vectors`` of at most ``spacing`` [m] each."""
    longest = vectors * spacing
    length = lanes.centrelines.length
    parts = np.maximum(np.ceil(length / longest - 1e-9), 1).astype(int)
    lane = np.repeat(np.arange(len(lanes)), parts)
    which = np.arange(parts.sum()) - np.repeat(parts.cumsum() - parts, parts)
    share = (which[:, None] + np.linspace(0, 1, vectors + 1)) / parts[lane][:, None]
    points, _ = lanes.centrelines.at(np.repeat(lane, vectors + 1), (share * length[lane][:, None]).ravel())
    return points.reshape(len(lane), vectors + 1, 2)
