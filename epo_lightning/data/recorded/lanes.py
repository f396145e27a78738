"""Lanes: their geometry, their successors and neighbours, and the positions of agents on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from epo_lightning.data.errors import RecordingError

Polyline = Float[np.ndarray, "n 2"]

LANE, SHOULDER = range(2)
"""Kinds of lanes: for driving, or for stopping in an emergency."""
FARTHEST = 1e7
"""Largest absolute coordinate [m] that a road map may have."""
BESIDE = 1.0
"""Largest distance [m] from the nearest lane at which a position is still assigned to it: maps have gaps between lanes."""
ALONG = np.pi / 2
"""Largest angle [rad] between an agent's heading and the direction of the lane that it drives on."""
ASTRAY = 5.0
"""Offset [m] from a centreline that counts as much as a heading error of one radian, where lanes overlap."""
HOPS = 6
"""Number of consecutive lanes that an agent may pass within a time step."""
ROUNDING = 1e-6
"""Difference of arc lengths [m] that rounding explains, kilometres from the origin."""


def without_repetitions(line: Polyline) -> Polyline:
    """The line without points that are equal to the one before them.

    Example:
        >>> without_repetitions(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]])).tolist()
        [[0.0, 0.0], [1.0, 0.0]]
    """
    return line[np.append(True, (np.diff(line, axis=0) != 0).any(1))]


class Polylines:
    """Many polylines with vectorised queries: projection of positions, and points at given arc lengths.

    Args:
        lines: each has at least two different points; consecutive equal points are ignored.
    """

    def __init__(self, lines: Sequence[Polyline]) -> None:
        kept = [without_repetitions(line) for line in lines]
        count = np.array([len(line) for line in kept], dtype=int)
        self.first = np.concatenate([[0], count.cumsum()])
        self.points = np.concatenate([np.empty((0, 2)), *kept])
        owner = np.repeat(np.arange(len(kept)), count)
        step = np.linalg.norm(np.diff(self.points, axis=0, prepend=self.points[:1]), axis=1)
        step[self.first[:-1]] = 0.0
        total = step.cumsum()
        self._along = total - total[self.first[:-1]][owner]
        self.length = self._along[self.first[1:] - 1]
        # Keys that increase over all polylines, so that one binary search finds the segment on any of them.
        self._base = np.concatenate([[0.0], (self.length + 1.0).cumsum()[:-1]])[: len(kept)]
        self._key = self._along + self._base[owner]
        self.geometry = shapely.linestrings(self.points, indices=owner) if len(kept) else np.empty(0, dtype=object)

    def __len__(self) -> int:
        return len(self.length)

    def at(
        self, line: Int[np.ndarray, " n"], along: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Points and unit tangents at the arc length ``along`` of a line; lines are extended straight at both ends."""
        inside = np.clip(along, 0.0, self.length[line])
        segment = np.searchsorted(self._key, self._base[line] + inside, side="right") - 1
        segment = np.clip(segment, self.first[line], self.first[line + 1] - 2)
        start = self.points[segment]
        way = self.points[segment + 1] - start
        tangent = way / np.linalg.norm(way, axis=-1, keepdims=True)
        return start + (along - self._along[segment])[..., None] * tangent, tangent

    def project(
        self, line: Int[np.ndarray, " n"], position: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Arc length of the point of a line that is nearest to a position, and the position's offset to the left of it [m].

        Where an end is nearest, the line goes straight on beyond it; there, the arc length is negative or more than the
        line's length.
        """
        along = shapely.line_locate_point(self.geometry[line], shapely.points(position))
        length = self.length[line]
        start, ahead = self.at(line, np.zeros_like(length))
        before = (ahead * (position - start)).sum(1)
        end, ahead = self.at(line, length)
        beyond = (ahead * (position - end)).sum(1)
        along = np.where((along <= 0) & (before < 0), before, along)
        # Shapely adds the segments up in another order: the arc length of a line's end may differ by its rounding.
        along = np.where((along >= length - ROUNDING) & (beyond > 0), length + beyond, along)
        nearest, tangent = self.at(line, along)
        way = position - nearest
        side = np.where(tangent[:, 0] * way[:, 1] - tangent[:, 1] * way[:, 0] < 0, -1.0, 1.0)
        return along, side * np.linalg.norm(way, axis=1)


@dataclass(frozen=True)
class Located:
    """Positions relative to the lanes of a map.

    Attributes:
        lane: index of the lane, -1 for none.
        along: arc length on its centreline [m].
        offset: distance to the left of its centreline [m].
    """

    lane: Int[np.ndarray, " T"]
    along: Float[np.ndarray, " T"]
    offset: Float[np.ndarray, " T"]


@dataclass(frozen=True)
class LaneGraph:
    """The lanes of a map. A lane is addressed by its index in these sequences; -1 stands for no lane.

    Attributes:
        ids: identifier of each lane in the map.
        left, right: boundaries of each lane, in driving direction [m].
        centre: centreline of each lane, in driving direction [m].
        successors: lanes that begin where a lane ends.
        left_of, right_of: the neighbour of each lane, in the same driving direction, that a vehicle may change to.
        adjacent_left, adjacent_right: the same, whether or not the marking between the lanes may be crossed.
        speed_limit: [m/s]; NaN if there is none or it is unknown.
        kind: LANE or SHOULDER.
    """

    ids: Int[np.ndarray, " W"]
    left: Sequence[Polyline]
    right: Sequence[Polyline]
    centre: Sequence[Polyline]
    successors: Sequence[tuple[int, ...]]
    left_of: Int[np.ndarray, " W"]
    right_of: Int[np.ndarray, " W"]
    adjacent_left: Int[np.ndarray, " W"]
    adjacent_right: Int[np.ndarray, " W"]
    speed_limit: Float[np.ndarray, " W"]
    kind: Int[np.ndarray, " W"]

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def from_centrelines(
        cls,
        centre: Sequence[Polyline],
        width: float,
        successors: Sequence[Sequence[int]] | None = None,
        left_of: Sequence[int] | None = None,
        speed_limit: float = np.nan,
    ) -> LaneGraph:
        """Lanes of one width around centrelines, for a map of one's own.

        Args:
            centre: points of each lane in driving direction [m].
            width: width of the lanes [m].
            successors: lanes that begin where a lane ends; None if lanes lead nowhere. A ring consists of several lanes.
            left_of: index of the left neighbour of each lane, to which vehicles may change, and -1 for none; None if no
                lane has a neighbour. Neighbours should begin and end beside each other: cut the lanes where one joins.
            speed_limit: [m/s]; NaN if it is unknown.

        Raises:
            RecordingError: lines without length, lanes that do not exist, a left neighbour that is not to the left, or a
                width or speed limit that is not positive.

        Example:
            >>> LaneGraph.from_centrelines([np.array([[0.0, 0.0], [50.0, 0.0]])], width=4.0).left[0].tolist()
            [[0.0, 2.0], [50.0, 2.0]]
        """
        lines = []
        for lane, line in enumerate(centre):
            points = np.asarray(line, dtype=float)
            if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.ptp(points, axis=0).any():
                raise RecordingError(
                    "the map",
                    f"the centreline of lane {lane} has shape {list(points.shape)}, expected [n, 2] with length",
                )
            lines.append(without_repetitions(points))
        count = len(lines)
        following = [()] * count if successors is None else [tuple(after) for after in successors]
        left = np.full(count, -1) if left_of is None else np.asarray(left_of, dtype=int)
        for name, given in (("successors", following), ("left_of", left)):
            if len(given) != count:
                raise RecordingError(
                    "the map", f"{name} has {len(given)} entries, expected one for each of {count} lanes"
                )
        for name, value in (("width", width), ("speed_limit", 1.0 if np.isnan(speed_limit) else speed_limit)):
            if not 0 < value < np.inf:
                raise RecordingError("the map", f"{name} is {value}, expected a positive number")
        right = _right_of(lines, left)
        aside = [width / 2 * _to_the_left(line) for line in lines]
        return cls(
            ids=np.arange(count),
            left=[line + way for line, way in zip(lines, aside, strict=True)],
            right=[line - way for line, way in zip(lines, aside, strict=True)],
            centre=lines,
            successors=following,
            left_of=left,
            right_of=right,
            adjacent_left=left,
            adjacent_right=right,
            speed_limit=np.full(count, speed_limit),
            kind=np.full(count, LANE),
        ).check("the map")

    def check(self, path: Path | str) -> LaneGraph:
        """This graph, after a check of its geometry and references.

        Args:
            path: path of the file, for error messages.

        Raises:
            RecordingError: no lanes, a line without length or with coordinates that cannot be right, or a reference to
                a lane that does not exist.
        """
        if not len(self):
            raise RecordingError(path, "the map has no lanes: is it a map of a road?")
        for name in ("left", "right", "centre"):
            for lane, line in zip(self.ids, getattr(self, name), strict=True):
                if not (np.abs(line) <= FARTHEST).all():
                    raise RecordingError(
                        path,
                        f"the {name} line of lane {lane} has coordinates that are not finite or beyond {FARTHEST:g} m: "
                        "are they in metres?",
                    )
                if len(line) < 2 or not np.ptp(line, axis=0).any():
                    raise RecordingError(
                        path, f"the {name} line of lane {lane} has no length: give it two points or more"
                    )
        for neighbours in (self.left_of, self.right_of, self.adjacent_left, self.adjacent_right):
            if not ((neighbours >= -1) & (neighbours < len(self))).all():
                raise RecordingError(path, "a lane names a neighbouring lane that does not exist")
        if not all(0 <= lane < len(self) for following in self.successors for lane in following):
            raise RecordingError(path, "a lane names a successor that does not exist")
        return self

    @cached_property
    def predecessors(self) -> tuple[tuple[int, ...], ...]:
        """For each lane, the lanes that end where it begins."""
        found: list[list[int]] = [[] for _ in range(len(self))]
        for lane, following in enumerate(self.successors):
            for successor in following:
                found[successor].append(lane)
        return tuple(tuple(lanes) for lanes in found)

    @cached_property
    def centrelines(self) -> Polylines:
        """All centrelines."""
        return Polylines(self.centre)

    @cached_property
    def areas(self) -> np.ndarray:
        """Area between the boundaries of each lane, as shapely geometries."""
        rings = [np.concatenate([left, right[::-1]]) for left, right in zip(self.left, self.right, strict=True)]
        return np.array([shapely.make_valid(shapely.Polygon(ring)) for ring in rings], dtype=object)

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(self.areas)

    def locate(self, position: Float[np.ndarray, "T 2"], heading: Float[np.ndarray, " T"]) -> Located:
        """The lane of every position: of the lanes that contain it, that with the least offset and heading error.

        The heading error is included because the centreline of a crossing road may be nearer. Positions within ``BESIDE`` of
        a lane are assigned to it if no lane contains them.
        """
        found = Located(np.full(len(position), -1), np.zeros(len(position)), np.full(len(position), np.inf))
        points = shapely.points(position)
        row, lane = self._tree.query(points, predicate="intersects")
        self._nearer(found, position, heading, row, lane)
        (beside,) = np.nonzero(found.lane < 0)
        if len(beside):
            row, lane = self._tree.query(points[beside], predicate="dwithin", distance=BESIDE)
            self._nearer(found, position, heading, beside[row], lane)
        found.offset[found.lane < 0] = 0.0
        return found

    def around(
        self, position: Float[np.ndarray, "T 2"], heading: Float[np.ndarray, " T"], distance: float, angle: float
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """All lanes near positions whose directions are similar to headings.

        Args:
            position, heading: positions [m] and headings [rad].
            distance: largest distance from a lane's area [m].
            angle: largest angle between the direction of a lane and the heading [rad].

        Returns:
            rows of the positions, lanes, arc lengths on their centrelines [m], and costs: the offset [m], plus ``ASTRAY``
            metres for every radian of heading error.
        """
        row, lane = self._tree.query(shapely.points(position), predicate="dwithin", distance=distance)
        along, offset = self.centrelines.project(lane, position[row])
        across = self._across(lane, along, heading[row])
        similar = across < angle
        cost = np.abs(offset) + ASTRAY * across
        return row[similar], lane[similar], along[similar], cost[similar]

    def _across(
        self, lane: Int[np.ndarray, " n"], along: Float[np.ndarray, " n"], heading: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Angle between headings and the directions of lanes [rad]."""
        _, tangent = self.centrelines.at(lane, along)
        turned = np.cos(heading) * tangent[:, 0] + np.sin(heading) * tangent[:, 1]
        return np.asarray(np.arccos(np.clip(turned, -1.0, 1.0)))

    def _nearer(
        self,
        found: Located,
        position: np.ndarray,
        heading: np.ndarray,
        row: Int[np.ndarray, " n"],
        lane: Int[np.ndarray, " n"],
    ) -> None:
        """Write the best lane of each row into ``found``; ``row`` and ``lane`` are pairs of rows and candidate lanes."""
        along, offset = self.centrelines.project(lane, position[row])
        across = self._across(lane, along, heading[row])
        (fits,) = np.nonzero(across < ALONG)
        # The best candidate is written last and stays; of equal ones, the lane with the lowest index.
        order = fits[np.lexsort((-lane[fits], -(np.abs(offset) + ASTRAY * across)[fits]))]
        found.lane[row[order]] = lane[order]
        found.along[row[order]] = along[order]
        found.offset[row[order]] = offset[order]

    def leads_to(self, lane: int, other: int) -> bool:
        """Whether ``other`` is reached from ``lane`` by following successors."""
        return other in _reached(lane, self.successors)

    def beside(self, lane: int, other: int) -> bool:
        """Whether two lanes, or lanes that precede or follow them, are neighbours."""
        around = _reached(lane, self.successors) | _reached(lane, self.predecessors)
        near = _reached(other, self.successors) | _reached(other, self.predecessors)
        return any(int(beside[each]) in near for each in around for beside in (self.adjacent_left, self.adjacent_right))


def _right_of(lines: Sequence[Polyline], left_of: Int[np.ndarray, " W"]) -> Int[np.ndarray, " W"]:
    """The right neighbour of each lane, of which it is the left one.

    Raises:
        RecordingError: a left neighbour that does not exist, is not to the left, or is that of two lanes.
    """
    right = np.full(len(lines), -1)
    for lane, other in enumerate(left_of.tolist()):
        if other < 0:
            continue
        if other >= len(lines):
            raise RecordingError("the map", f"left_of names lane {other}, but the last lane is {len(lines) - 1}")
        if right[other] >= 0:
            raise RecordingError(
                "the map",
                f"lanes {right[other]} and {lane} have the same left neighbour: cut it where one ends and the other begins",
            )
        middle = lines[lane][[len(lines[lane]) // 2]]
        _, offset = Polylines([lines[other]]).project(np.array([0]), middle)
        if offset[0] >= 0:
            raise RecordingError("the map", f"left_of of lane {lane} is {other}, which is not to its left")
        right[other] = lane
    return right


def _to_the_left(line: Polyline) -> Polyline:
    """Vectors from the points of a line to those of the parallel line one metre to its left; sharp corners are cut."""
    way = np.diff(line, axis=0)
    normal = np.stack([-way[:, 1], way[:, 0]], 1) / np.linalg.norm(way, axis=1, keepdims=True)
    before, after = np.concatenate([normal[:1], normal]), np.concatenate([normal, normal[-1:]])
    return (before + after) / np.maximum(1.0 + (before * after).sum(1, keepdims=True), 0.5)


def _reached(lane: int, following: Sequence[tuple[int, ...]]) -> set[int]:
    """A lane and all lanes that are reached from it within HOPS steps."""
    reached = {lane}
    for _ in range(HOPS):
        reached |= {other for each in reached for other in following[each]}
    return reached


def lane_changes(agent: Int[np.ndarray, " T"], located: Located, lanes: LaneGraph) -> Bool[np.ndarray, " T"]:
    """Mask [T] of the rows in which an agent is on a lane beside that of its previous row (exiD: ``laneChange``).

    Rows on no lane are ignored.
    """
    changed = np.zeros(len(agent), dtype=bool)
    (on,) = np.nonzero(located.lane >= 0)
    before, after = located.lane[on[:-1]], located.lane[on[1:]]
    (moved,) = np.nonzero((before != after) & (agent[on[:-1]] == agent[on[1:]]))
    pairs, which = np.unique(np.stack([before[moved], after[moved]], 1), axis=0, return_inverse=True)
    aside = np.array([not lanes.leads_to(a, b) and lanes.beside(a, b) for a, b in pairs.tolist()], dtype=bool)
    changed[on[1:][moved]] = aside[which.ravel()] if len(pairs) else False
    return changed
