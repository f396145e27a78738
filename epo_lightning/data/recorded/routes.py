"""Routes: the lines that an agent may follow, and the places on them that it may be heading for (Appendix C.2).

An agent on a lane may keep to it or change to the lane beside. Its goal candidates are points on the centrelines of these
three lanes; where there is no lane beside, on the boundary of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.lanes import SHOULDER, LaneGraph, Located, Polyline, Polylines

LINES = 3
"""Lines per agent R: left, own, right."""
PER_LINE = 20
"""Goal candidates on each of them: G = 60 in all."""
POINTS = 24
"""Points of a reference line Q."""
BRAKING, ACCELERATING = 4.0, 3.0
"""What agents can do [m/s^2]: between these lies what they reach within the horizon."""
BEHIND, BEYOND = 5.0, 10.0
"""How far reference lines go on behind an agent and beyond its farthest candidate [m]."""
BACKWARDS, FORWARDS = 100.0, 500.0
"""How far a lane is followed [m]."""
SHORTEST = 10.0
"""Least length [m] of the piece of road on which candidates lie."""


@dataclass(frozen=True)
class Route:
    """Where some agents may be going.

    Attributes:
        references: the lines that they may follow.
        candidates: positions that they may be heading for.
        line: index of the line that each candidate lies on; the same for all agents.
    """

    references: Float[np.ndarray, "n R Q 2"]
    candidates: Float[np.ndarray, "n G 2"]
    line: Int[np.ndarray, " G"]


class Routes:
    """The lines that lead on from every lane of a map."""

    def __init__(self, lanes: LaneGraph) -> None:
        self.lanes = lanes
        straight = _straightest(lanes.successors, lanes, forwards=True)
        back = _straightest(lanes.predecessors, lanes, forwards=False)
        length = lanes.centrelines.length
        chains = []
        for lane in range(len(lanes)):
            before = _follow(lane, back, length, BACKWARDS)[:0:-1]
            chains.append((before, _follow(lane, straight, length, FORWARDS)))
        sides = (lanes.centre, lanes.left, lanes.right)
        self.lines = Polylines(
            [np.concatenate([side[lane] for lane in (*before, *after)]) for side in sides for before, after in chains]
        )
        # A line may come by twice, on a loop or a ring: agents are looked for on the piece that they are on or beside.
        self.parts = Polylines([line for side in sides for line in side])
        self.begin = np.array(
            [
                _length(np.concatenate([*(side[each] for each in before), side[lane][:1]]))
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
        """Where agents may be going.

        Args:
            position, speed: of the agents.
            located: where they are; every one on a lane.
            time: within which goals are to be reached [s].
        """
        speed = np.maximum(speed, 0.0)
        far = speed * time + ACCELERATING * time**2 / 2
        stopping = np.minimum(speed / BRAKING, time)
        near = np.minimum(speed * stopping - BRAKING * stopping**2 / 2, far - SHORTEST)
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


def _straightest(following: Sequence[tuple[int, ...]], lanes: LaneGraph, forwards: bool) -> Int[np.ndarray, " W"]:
    """Of the lanes that follow each lane (or lead to it), the one that goes on most nearly straight; -1 for none."""
    found = np.full(len(lanes), -1)
    for lane, others in enumerate(following):
        if others:
            here = _direction(lanes.centre[lane], at_end=forwards)
            turns = [float(here @ _direction(lanes.centre[other], at_end=not forwards)) for other in others]
            found[lane] = others[int(np.argmax(turns))]
    return found


def _direction(line: Polyline, at_end: bool) -> Float[np.ndarray, " 2"]:
    points = line[np.append(True, (np.diff(line, axis=0) != 0).any(1))]
    way = points[-1] - points[-2] if at_end else points[1] - points[0]
    return way / np.linalg.norm(way)


def _length(line: Polyline) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _follow(lane: int, following: np.ndarray, length: np.ndarray, distance: float) -> list[int]:
    """A lane and those that follow, until ``distance`` beyond its end, or until one comes again."""
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
    """The first driving lane that comes to lie beside each lane or what follows it, and how far from the lane's start."""
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


def pieces(lanes: LaneGraph, vectors: int, spacing: float) -> Float[np.ndarray, "T V+1 2"]:
    """The map for the network: every centreline cut into pieces of so many vectors, each of at most ``spacing`` [m]."""
    longest = vectors * spacing
    length = lanes.centrelines.length
    parts = np.maximum(np.ceil(length / longest - 1e-9), 1).astype(int)
    lane = np.repeat(np.arange(len(lanes)), parts)
    which = np.arange(parts.sum()) - np.repeat(parts.cumsum() - parts, parts)
    share = (which[:, None] + np.linspace(0, 1, vectors + 1)) / parts[lane][:, None]
    points, _ = lanes.centrelines.at(np.repeat(lane, vectors + 1), (share * length[lane][:, None]).ravel())
    return points.reshape(len(lane), vectors + 1, 2)
