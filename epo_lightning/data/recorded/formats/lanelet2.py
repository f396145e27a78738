"""Lanelet2 maps (.osm): lanes between a left and a right way, joined where they share nodes and ways.

The rules are those of the Lanelet2 library for vehicles (Poggenhans et al., "Lanelet2: A High-Definition Map Framework for
the Future of Automated Driving", ITSC 2018), with emergency lanes kept as shoulders. Nodes, ways and relations have ids of
their own, which may collide between these kinds.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float
from numba import njit
from pyproj import Transformer

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats import xml
from epo_lightning.data.recorded.lanes import FARTHEST, LANE, SHOULDER, LaneGraph, Polyline

EMERGENCY_LANE = "emergency_lane"
FOR_VEHICLES = frozenset({"", "road", "highway", "play_street", "bus_lane", "exit", EMERGENCY_LANE})
"""Subtypes of lanelets on which vehicles drive, if only in an emergency."""
WIDEST = 9.0
"""A node farther than this from the meridian of its UTM zone [deg] does not belong to a map in that zone."""
TO_LEFT, TO_RIGHT = 1, 2
CROSSABLE = {"dashed": TO_LEFT | TO_RIGHT, "dashed_solid": TO_RIGHT, "solid_dashed": TO_LEFT}
"""In which direction a painted line may be crossed, by its subtype, which names its two lines from left to right."""

Tags = dict[str, str]


class _Way(NamedTuple):
    """A line of nodes, and the same line as points without repetitions [m]."""

    id: int
    nodes: tuple[int, ...]
    points: Polyline
    tags: Tags


class _Bound(NamedTuple):
    """A way in the driving direction of a lanelet: as it is stored, or inverted."""

    way: _Way
    inverted: bool

    @property
    def line(self) -> Polyline:
        return self.way.points[::-1] if self.inverted else self.way.points

    @property
    def ends(self) -> tuple[int, int]:
        """First and last node."""
        first, last = self.way.nodes[0], self.way.nodes[-1]
        return (last, first) if self.inverted else (first, last)

    @property
    def key(self) -> tuple[int, bool]:
        """Equal for the two lanelets that lie beside this bound in the same direction."""
        return self.way.id, self.inverted

    @property
    def crossable(self) -> int:
        """In which direction vehicles may cross it: of TO_LEFT and TO_RIGHT, both, one or none.

        A virtual line is none that the library lets vehicles change lanes across; ``lane_change`` overrides the marking.
        """
        tags = self.way.tags
        if "lane_change" in tags:
            directions = (TO_LEFT | TO_RIGHT) * _yes(tags, "lane_change")
        elif _yes(tags, "lane_change:left") or "lane_change:right" in tags:
            directions = TO_LEFT * _yes(tags, "lane_change:left") | TO_RIGHT * _yes(tags, "lane_change:right")
        elif tags.get("type") in ("line_thin", "line_thick"):
            directions = CROSSABLE.get(tags.get("subtype", ""), 0)
        else:
            directions = 0
        one_way = {TO_LEFT: TO_RIGHT, TO_RIGHT: TO_LEFT}
        return one_way.get(directions, directions) if self.inverted else directions


@dataclass(frozen=True)
class _Lanelet:
    id: int
    left: _Bound
    right: _Bound
    centre: Polyline
    kind: int


def read_map(
    path: Path | str, origin: tuple[float, float], zone: int | None = None, dropped: Counter[str] | None = None
) -> LaneGraph:
    """The lanes for vehicles of a Lanelet2 map. A lanelet that is open both ways is a lane in the direction of its ways.

    Args:
        path: of the .osm file.
        origin: UTM coordinates of the local frame's origin [m].
        zone: of UTM, 1 .. 60; None takes that of the middle of the map.
        dropped: numbers of things left out, by reason, are added to these.

    Raises:
        RecordingError: no such file, no Lanelet2 map, numbers that are missing or none, an id of one kind used twice, or
            no lane in it.
    """
    root = xml.parse(path)
    if root.tag != "osm":
        raise RecordingError(path, f"the root element is <{root.tag}>; a Lanelet2 map has <osm>")
    ways = _ways(root, _positions(root, origin, zone, path), path)
    left_out: Counter[str] = Counter()
    lanelets = []
    for id, relation in _elements(root, "relation", path).items():
        tags = _tags(relation)
        if tags.get("type") != "lanelet":
            continue
        lanelet = _lanelet(id, relation, tags, ways, path)
        if isinstance(lanelet, str):
            left_out[lanelet] += 1
        else:
            lanelets.append(lanelet)
    if not lanelets:
        reasons = ", ".join(f"{number} {reason}" for reason, number in left_out.items())
        raise RecordingError(path, f"there is no lane in it ({reasons or 'no relation of type lanelet'})")
    if dropped is not None:
        dropped.update(left_out)
    return _graph(lanelets).check(path)


def _elements(root: Element, kind: str, path: Path | str) -> dict[int, Element]:
    """The nodes, ways or relations that are not deleted, by id."""
    found: dict[int, Element] = {}
    for element in root.iterfind(kind):
        if element.get("action") == "delete":
            continue
        id = xml.whole(element.get("id"), f"the id of a {kind}", path)
        if id in found:
            raise RecordingError(path, f"the id {id} belongs to two {kind}s: give one of them another id")
        found[id] = element
    return found


def _tags(element: Element) -> Tags:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iterfind("tag")}


def _yes(tags: Tags, key: str) -> bool:
    return tags.get(key) in ("yes", "true", "1")


@cache
def _projection(zone: int, north: bool) -> Transformer:
    return Transformer.from_crs("EPSG:4326", f"EPSG:{(32600 if north else 32700) + zone}")


def _positions(
    root: Element, origin: tuple[float, float], zone: int | None, path: Path | str
) -> dict[int, Float[np.ndarray, " 2"]]:
    """Where each node is in the local frame [m]."""
    nodes = _elements(root, "node", path)
    if not nodes:
        raise RecordingError(path, "there is no node in it: is it a Lanelet2 map?")
    degrees = np.array(
        [
            [xml.number(node.get(name), f"{name} of node {id}", path) for name in ("lat", "lon")]
            for id, node in nodes.items()
        ]
    )
    outside = (np.abs(degrees) > (84.0, 180.0)).any(1)
    latitude, longitude = np.median(degrees[~outside], axis=0) if not outside.all() else (0.0, 0.0)
    zone = int((longitude + 180) // 6) % 60 + 1 if zone is None else zone
    east, north = _projection(zone, bool(latitude >= 0)).transform(*degrees.T)
    positions = np.stack((east, north), 1) - np.asarray(origin)
    meridian = 6 * zone - 183
    outside |= np.abs((degrees[:, 1] - meridian + 180) % 360 - 180) > WIDEST
    outside |= ~(np.abs(positions) <= FARTHEST).all(1)
    if outside.any():
        bad = int(np.flatnonzero(outside)[0])
        raise RecordingError(
            path,
            f"node {list(nodes)[bad]} at latitude and longitude {degrees[bad].tolist()} was expected in degrees and near "
            f"UTM zone {zone}: is it a stray node?",
        )
    return dict(zip(nodes, positions, strict=True))


def _ways(root: Element, positions: dict[int, Float[np.ndarray, " 2"]], path: Path | str) -> dict[int, _Way]:
    """The ways all of whose nodes are there."""
    ways = {}
    for id, element in _elements(root, "way", path).items():
        nodes = tuple(xml.whole(node.get("ref"), f"a node of way {id}", path) for node in element.iterfind("nd"))
        if nodes and all(node in positions for node in nodes):
            points = np.array([positions[node] for node in nodes])
            ways[id] = _Way(id, nodes, _without_repetitions(points), _tags(element))
    return ways


def _without_repetitions(line: Polyline) -> Polyline:
    return line[np.append(True, (np.diff(line, axis=0) != 0).any(1))]


def _for_vehicles(tags: Tags) -> bool:
    """Whether the subtype is one for vehicles; tags that name participants decide where there are any."""
    participants = [key for key in tags if key.startswith("participant")]
    if participants:
        return any(key.startswith("participant:vehicle") and _yes(tags, key) for key in participants)
    return tags.get("subtype", "") in FOR_VEHICLES


def _lanelet(id: int, relation: Element, tags: Tags, ways: dict[int, _Way], path: Path | str) -> _Lanelet | str:
    """A lanelet, or why it is left out."""
    if not _for_vehicles(tags):
        return "lanelets that are not for vehicles"
    members = defaultdict(list)
    for member in relation.iterfind("member"):
        if member.get("type") == "way":
            way = xml.whole(member.get("ref"), f"a member of relation {id}", path)
            members[member.get("role")].append(ways.get(way))
    if len(members["left"]) != 1 or len(members["right"]) != 1:
        return "lanelets without exactly one left and one right way"
    (left,), (right,) = members["left"], members["right"]
    drawn = members["centerline"][:1]
    if left is None or right is None or None in drawn:
        return "lanelets whose ways or nodes are missing"
    if len(left.points) < 2 or len(right.points) < 2 or left.id == right.id:
        return "lanelets without length or width"
    left_bound, right_bound = _aligned(left, right)
    if drawn and drawn[0] is not None:
        centre = drawn[0].points
    else:
        touching = left_bound.ends[0] == right_bound.ends[0]
        centre = _without_repetitions(centreline(left_bound.line, right_bound.line, touching))
    if len(centre) < 2:
        return "lanelets without length or width"
    kind = SHOULDER if tags.get("subtype") == EMERGENCY_LANE else LANE
    return _Lanelet(id, left_bound, right_bound, centre, kind)


def _signed_distance(line: Polyline, point: Float[np.ndarray, " 2"]) -> float:
    """Distance of a point from a line, positive on the left [m]."""
    step = np.diff(line, axis=0)
    share = np.clip(((point - line[:-1]) * step).sum(1) / (step**2).sum(1), 0.0, 1.0)
    distance = np.hypot(*(point - line[:-1] - share[:, None] * step).T)
    nearest = int(distance.argmin())
    left = _cross(step[nearest], point - line[nearest]) > 0
    if share[nearest] == 1.0 and nearest + 1 < len(step):
        # Beside a corner, a point is left of the line if it is left of both its sides, or of one where it turns right.
        turn = _cross(step[nearest], step[nearest + 1]) > 0
        left_of_next = _cross(step[nearest + 1], point - line[nearest + 1]) > 0
        left = left_of_next if left == turn else left
    return float(distance[nearest]) if left else -float(distance[nearest])


def _cross(a: Float[np.ndarray, " 2"], b: Float[np.ndarray, " 2"]) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _aligned(left: _Way, right: _Way) -> tuple[_Bound, _Bound]:
    """Both boundaries in driving direction: each has the middle of the other one on the right side.

    The left one is turned first, until the right one lies to its right; then the right one, until the left one lies to its
    left (``lanelet::geometry::align`` in lanelet2_core).
    """

    def middle(line: Polyline) -> Float[np.ndarray, " 2"]:
        return line[len(line) // 2] if len(line) > 2 else line.mean(0)

    turned_left = _Bound(left, not _signed_distance(left.points, middle(right.points)) < 0)
    turned_right = _Bound(right, not _signed_distance(right.points, middle(turned_left.line)) > 0)
    return turned_left, turned_right


def _graph(lanelets: list[_Lanelet]) -> LaneGraph:
    starts: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
    for lane, lanelet in enumerate(lanelets):
        starts[lanelet.left.ends[0], lanelet.right.ends[0]].append(lane)
    # Where lanelets lie over one another, the first of the file is the neighbour.
    by_left = {lanelet.left.key: lane for lane, lanelet in reversed(list(enumerate(lanelets)))}
    by_right = {lanelet.right.key: lane for lane, lanelet in reversed(list(enumerate(lanelets)))}
    adjacent_left = np.array([by_right.get(lanelet.left.key, -1) for lanelet in lanelets])
    adjacent_right = np.array([by_left.get(lanelet.right.key, -1) for lanelet in lanelets])
    may_left = np.array([bool(lanelet.left.crossable & TO_LEFT) for lanelet in lanelets])
    may_right = np.array([bool(lanelet.right.crossable & TO_RIGHT) for lanelet in lanelets])
    return LaneGraph(
        ids=np.array([lanelet.id for lanelet in lanelets]),
        left=[lanelet.left.line for lanelet in lanelets],
        right=[lanelet.right.line for lanelet in lanelets],
        centre=[lanelet.centre for lanelet in lanelets],
        successors=[tuple(starts.get((lanelet.left.ends[1], lanelet.right.ends[1]), ())) for lanelet in lanelets],
        left_of=np.where(may_left, adjacent_left, -1),
        right_of=np.where(may_right, adjacent_right, -1),
        adjacent_left=adjacent_left,
        adjacent_right=adjacent_right,
        speed_limit=np.full(len(lanelets), np.nan),
        kind=np.array([lanelet.kind for lanelet in lanelets]),
    )


@njit(cache=True)
def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> float:
    """Positive where a point is left of the line from a to b."""
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])


@njit(cache=True)
def _between(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point of the line through a and b lies between them."""
    return min(a[0], b[0]) <= point[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= point[1] <= max(a[1], b[1])


@njit(cache=True)
def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """Whether the segments from a to b and from c to d have a point in common."""
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    c_side, d_side = _side(a, b, c), _side(a, b, d)
    a_side, b_side = _side(c, d, a), _side(c, d, b)
    if (
        (c_side == 0 and _between(a, b, c))
        or (d_side == 0 and _between(a, b, d))
        or (a_side == 0 and _between(c, d, a))
        or (b_side == 0 and _between(c, d, b))
    ):
        return True
    return (c_side > 0) != (d_side > 0) and (a_side > 0) != (b_side > 0) and c_side * d_side * a_side * b_side != 0


@njit(cache=True)
def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return a[0] == b[0] and a[1] == b[1]


@njit(cache=True)
def _clear(
    last: np.ndarray, middle: np.ndarray, near: np.ndarray, far: np.ndarray, foot: np.ndarray, line: np.ndarray
) -> bool:
    """Whether a boundary is crossed neither on the way from ``last`` to ``middle`` nor, but at its foot, by the rung."""
    for k in range(len(line) - 1):
        a, b = line[k], line[k + 1]
        if not _same(a, last) and _meet(last, middle, a, b):
            return False
        if not _same(a, foot) and not _same(b, foot) and _meet(near, far, a, b):
            return False
    return True


@njit(cache=True)
def _connects(last: np.ndarray, near: np.ndarray, far: np.ndarray, near_line: np.ndarray, far_line: np.ndarray) -> bool:
    """Whether a rung from ``near`` on one boundary to ``far`` on the other one crosses neither of them elsewhere, nor does
    the centreline on its way from its ``last`` point to the middle of the rung."""
    middle = 0.5 * (near + far)
    return _clear(last, middle, near, far, near, near_line) and _clear(last, middle, near, far, far, far_line)


@njit(cache=True)
def _next_rung(
    last: np.ndarray, near_line: np.ndarray, near: int, far_line: np.ndarray, far: int, gates: np.ndarray
) -> tuple[int, float]:
    """The nearest point after number ``far`` of one boundary that a rung can connect to point ``near`` of the other one,
    and the length of that rung; -1 where there is none. ``gates`` are entry and exit, each with the lanelet to its right."""
    lengths = np.empty(len(far_line))
    lengths[: far + 1] = np.inf
    for k in range(far + 1, len(far_line)):
        lengths[k] = np.hypot(far_line[k, 0] - near_line[near, 0], far_line[k, 1] - near_line[near, 1])
    for _ in range(far + 1, len(far_line)):
        k = int(lengths.argmin())
        middle = 0.5 * (near_line[near] + far_line[k])
        leaves = False
        for gate in range(2):
            if _side(gates[gate, 0], gates[gate, 1], middle) > 0 and _meet(
                last, middle, gates[gate, 0], gates[gate, 1]
            ):
                leaves = True
        if not leaves and _connects(last, near_line[near], far_line[k], near_line, far_line):
            return k, lengths[k]
        lengths[k] = np.inf
    return -1, np.inf


@njit(cache=True)
def _climb(left: np.ndarray, right: np.ndarray, touching: bool) -> np.ndarray:
    """The centreline; see :func:`centreline`."""
    gates = np.empty((2, 2, 2))
    gates[0, 0], gates[0, 1] = right[0], left[0]
    gates[1, 0], gates[1, 1] = left[-1], right[-1]
    centre = np.empty((len(left) + len(right), 2))
    centre[0] = 0.5 * (left[0] + right[0])
    count = 1
    at_left, at_right = int(touching), 0
    while True:
        last = centre[count - 1]
        next_left, left_length = _next_rung(last, right, at_right, left, at_left, gates)
        next_right, right_length = _next_rung(last, left, at_left, right, at_right, gates)
        if next_left < 0 and next_right < 0:
            break
        if left_length <= right_length:
            at_left = next_left
        else:
            at_right = next_right
        centre[count] = 0.5 * (left[at_left] + right[at_right])
        count += 1
    if at_left < len(left) - 1 or at_right < len(right) - 1:
        centre[count] = 0.5 * (left[-1] + right[-1])
        count += 1
    return centre[:count]


def centreline(left: Polyline, right: Polyline, touching: bool = False) -> Polyline:
    """The line midway between two boundaries, as the Lanelet2 library draws it (lanelet2_core, Lanelet.cpp).

    It climbs the lanelet like a ladder. From the rung between the current points of both boundaries, one foot steps on: to
    the nearest later point whose rung crosses no boundary, on the side where that rung is shorter. The middles of the
    rungs are the centreline.

    Args:
        left, right: boundaries in driving direction [m].
        touching: both begin at the same node.
    """
    return _climb(np.ascontiguousarray(left), np.ascontiguousarray(right), touching)
