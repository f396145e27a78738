"""Reader of Lanelet2 maps (.osm): lanes between a left and a right way, connected by shared nodes and ways.

The rules are those of the Lanelet2 library for vehicles (Poggenhans et al., "Lanelet2: A High-Definition Map Framework for
the Future of Automated Driving", ITSC 2018), with emergency lanes kept as shoulders. Ids are unique among nodes, among ways
and among relations, but not across these kinds.
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
from pyproj import Transformer

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats import xml
from epo_lightning.data.recorded.formats.centreline import centreline
from epo_lightning.data.recorded.lanes import FARTHEST, LANE, SHOULDER, LaneGraph, Polyline, without_repetitions

EMERGENCY_LANE = "emergency_lane"
FOR_VEHICLES = frozenset({"", "road", "highway", "play_street", "bus_lane", "exit", EMERGENCY_LANE})
"""Subtypes of lanelets on which vehicles drive, including emergency lanes."""
WIDEST = 9.0
"""Largest distance [deg] of a node from the meridian of its UTM zone."""
TO_LEFT, TO_RIGHT = 1, 2
CROSSABLE = {"dashed": TO_LEFT | TO_RIGHT, "dashed_solid": TO_RIGHT, "solid_dashed": TO_LEFT}
"""Directions in which a painted line may be crossed, by its subtype, which names double lines from left to right."""

Tags = dict[str, str]


class _Way(NamedTuple):
    """A way: its nodes, and their positions [m] without repetitions."""

    id: int
    nodes: tuple[int, ...]
    points: Polyline
    tags: Tags


class _Bound(NamedTuple):
    """A boundary of a lanelet: a way as it is stored, or inverted, so that it runs in driving direction."""

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
        """Identifier that is shared by the two lanelets beside this boundary if they have the same direction."""
        return self.way.id, self.inverted

    @property
    def crossable(self) -> int:
        """Directions in which vehicles may cross the boundary: a combination of the bits TO_LEFT and TO_RIGHT.

        As in the library, virtual lines may not be crossed, and the tag ``lane_change`` overrides the marking.
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
    path: Path | str,
    origin: tuple[float, float],
    zone: int | None = None,
    dropped: Counter[str] | None = None,
    north: bool | None = None,
) -> LaneGraph:
    """The lanes for vehicles of a Lanelet2 map. A lanelet for both directions becomes one lane in the direction of its ways.

    Args:
        path: path of the .osm file.
        origin: UTM coordinates of the local frame's origin [m]. Not used for a map whose nodes have x and y in metres
            instead of latitude and longitude: these are taken as they are.
        zone: UTM zone, 1 .. 60; None takes that of the middle of the map.
        dropped: the numbers of items that are left out are added to it, by reason.
        north: whether northings count from the equator; None for maps that lie north of it.

    Raises:
        RecordingError: there is no such file, it is not a Lanelet2 map, numbers are missing or invalid, an id is used
            twice, or there is no lane.
    """
    root = xml.parse(path)
    if root.tag not in ("osm", "osm_xy"):
        raise RecordingError(path, f"the root element is <{root.tag}>; a Lanelet2 map has <osm>")
    ways = _ways(root, _positions(root, origin, zone, north, path), path)
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
        raise RecordingError(path, f"the map has no lanes ({reasons or 'no relation of type lanelet'})")
    if dropped is not None:
        dropped.update(left_out)
    return _graph(lanelets).check(path)


def _elements(root: Element, kind: str, path: Path | str) -> dict[int, Element]:
    """Nodes, ways or relations by id, without deleted ones."""
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
    root: Element, origin: tuple[float, float], zone: int | None, north: bool | None, path: Path | str
) -> dict[int, Float[np.ndarray, " 2"]]:
    """Positions of all nodes in the local frame [m]."""
    nodes = _elements(root, "node", path)
    if not nodes:
        raise RecordingError(path, "there is no node in it: is it a Lanelet2 map?")
    if all("x" in node.attrib and "y" in node.attrib and "lat" not in node.attrib for node in nodes.values()):
        return _metres(nodes, path)
    degrees = np.array(
        [
            [xml.number(node.get(name), f"{name} of node {id}", path) for name in ("lat", "lon")]
            for id, node in nodes.items()
        ]
    )
    outside = (np.abs(degrees) > (84.0, 180.0)).any(1)
    latitude, longitude = np.median(degrees[~outside], axis=0) if not outside.all() else (0.0, 0.0)
    zone = int((longitude + 180) // 6) % 60 + 1 if zone is None else zone
    utm = _projection(zone, bool(latitude >= 0) if north is None else north)
    positions = np.stack(utm.transform(*degrees.T), 1) - np.asarray(origin)
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


def _metres(nodes: dict[int, Element], path: Path | str) -> dict[int, Float[np.ndarray, " 2"]]:
    """Positions [m] of nodes that have x and y in the local frame, as the files ``*.osm_xy`` of INTERACTION."""
    positions = {
        id: np.array([xml.number(node.get(name), f"{name} of node {id}", path) for name in ("x", "y")])
        for id, node in nodes.items()
    }
    for id, position in positions.items():
        if not (np.abs(position) <= FARTHEST).all():
            raise RecordingError(
                path, f"node {id} at {position.tolist()} was expected in metres, at most {FARTHEST:g} m away"
            )
    return positions


def _ways(root: Element, positions: dict[int, Float[np.ndarray, " 2"]], path: Path | str) -> dict[int, _Way]:
    """Ways by id, without those that have missing nodes."""
    ways = {}
    for id, element in _elements(root, "way", path).items():
        nodes = tuple(xml.whole(node.get("ref"), f"a node of way {id}", path) for node in element.iterfind("nd"))
        if nodes and all(node in positions for node in nodes):
            points = np.array([positions[node] for node in nodes])
            ways[id] = _Way(id, nodes, without_repetitions(points), _tags(element))
    return ways


def _for_vehicles(tags: Tags) -> bool:
    """Whether a lanelet is for vehicles: decided by its participant tags, or by its subtype if it has none."""
    participants = [key for key in tags if key.startswith("participant")]
    if participants:
        return any(key.startswith("participant:vehicle") and _yes(tags, key) for key in participants)
    return tags.get("subtype", "") in FOR_VEHICLES


def _lanelet(id: int, relation: Element, tags: Tags, ways: dict[int, _Way], path: Path | str) -> _Lanelet | str:
    """A lanelet, or the reason why it is left out."""
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
        centre = without_repetitions(centreline(left_bound.line, right_bound.line, touching))
    if len(centre) < 2:
        return "lanelets without length or width"
    kind = SHOULDER if tags.get("subtype") == EMERGENCY_LANE else LANE
    return _Lanelet(id, left_bound, right_bound, centre, kind)


def _signed_distance(line: Polyline, point: Float[np.ndarray, " 2"]) -> float:
    """Signed distance of a point from a line, positive on the left [m]."""
    step = np.diff(line, axis=0)
    share = np.clip(((point - line[:-1]) * step).sum(1) / (step**2).sum(1), 0.0, 1.0)
    distance = np.hypot(*(point - line[:-1] - share[:, None] * step).T)
    nearest = int(distance.argmin())
    left = _cross(step[nearest], point - line[nearest]) > 0
    if share[nearest] == 1.0 and nearest + 1 < len(step):
        # Next to a corner, a point is left of the line if it is left of both segments, or of one if the line turns right.
        turn = _cross(step[nearest], step[nearest + 1]) > 0
        left_of_next = _cross(step[nearest + 1], point - line[nearest + 1]) > 0
        left = left_of_next if left == turn else left
    return float(distance[nearest]) if left else -float(distance[nearest])


def _cross(a: Float[np.ndarray, " 2"], b: Float[np.ndarray, " 2"]) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _aligned(left: _Way, right: _Way) -> tuple[_Bound, _Bound]:
    """Both boundaries in driving direction.

    The left one is inverted if the middle of the right one is not to its right; then the right one is inverted if the middle
    of the left one is not to its left (``lanelet::geometry::align`` in lanelet2_core).
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
    # Where lanelets overlap, the first one in the file is the neighbour.
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
