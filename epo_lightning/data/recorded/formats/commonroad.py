"""Reader of CommonRoad scenarios (.xml, 2018b and 2020a): recorded or simulated traffic on a map of lanelets.

Althoff, Koschi and Manzinger, "CommonRoad: Composable Benchmarks for Motion Planning on Roads", IV 2017; the XML format is
described at commonroad.in.tum.de. Time is in steps of ``timeStepSize`` [s]; metres, radians and m/s throughout.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from epo_lightning.data.recorded.formats import xml
from epo_lightning.data.recorded.lanes import LANE, SHOULDER, LaneGraph, Polyline
from epo_lightning.data.recorded.tracks import FASTEST, Recording, RecordingError, RecordingSource, TrackTable
from epo_lightning.registry import register
from epo_lightning.scene import KINDS

KIND_OF = {kind: kind for kind in KINDS} | {"taxi": "car"}
"""Agent kinds by obstacle type; every other type is ``other``."""
LEFT_OUT = {
    "staticObstacle": "static obstacles",
    "environmentObstacle": "environment obstacles",
    "phantomObstacle": "phantom obstacles",
}
SHOULDERS = {"shoulder", "border"}
"""Types of lanelets that are not driven on regularly."""
SOLID = {"solid", "broad_solid", "solid_solid", "curb", "lowered_curb"}
"""Line markings that may not be crossed from either side. Double markings are named from left to right."""
SPEED_SIGNS = {"274", "274.1", "R2-1", "r301", "3.24", "R15", "C43", "B14", "Ρ-32", "B31"}  # noqa: RUF001
"""Identifiers of speed-limit signs in all countries of the format; their additional value is in m/s."""
LATEST = 10_000_000
"""Largest time step."""
ALIKE_BY_ID, ALIKE = 12, 40
"""Numbers of consecutive identical speeds (as text) after which two obstacles count as the same vehicle: if their ids are
the same, and whatever their ids are."""


@register("format", "commonroad")
def commonroad(folder: Path) -> list[RecordingSource]:
    """All scenarios below a folder.

    Scenarios are cut out of longer recordings, and some overlap. Scenarios that contain the same part of a vehicle's
    trajectory are one group with the name of the first of them; every other scenario is a group of its own.

    Raises:
        RecordingError: there is no scenario, two have the same name, or a file cannot be read.
    """
    # Links to nowhere are kept: a recording that is not there must not be left out in silence.
    paths = sorted(path for path in Path(folder).rglob("[!.]*.xml") if not path.is_dir())
    if not paths:
        raise RecordingError(folder, "there is no CommonRoad scenario (*.xml) in this folder")
    first: dict[str, Path] = {}
    for path in paths:
        if first.setdefault(path.stem, path) != path:
            raise RecordingError(path, f"{first[path.stem]} has the same name: rename or remove one of the two")
    return [
        RecordingSource(path.stem, paths[group].stem, (path,), partial(_read_recording, path, paths[group].stem))
        for path, group in zip(paths, _groups(paths), strict=True)
    ]


def _groups(paths: Sequence[Path]) -> list[int]:
    """For each file, the index of the first file of its group. Files that share part of a trajectory are in one group."""
    groups = list(range(len(paths)))
    seen: dict[int, int] = {}
    for index, path in enumerate(paths):
        for vehicle, speeds in _drives(path):
            for key, length in ((vehicle, ALIKE_BY_ID), (None, ALIKE)):
                for start in range(len(speeds) - length + 1):
                    run = speeds[start : start + length]
                    # Constant speeds do not identify a vehicle.
                    if 2 * len(set(run)) >= length:
                        here, there = groups[index], groups[seen.setdefault(hash((key, *run)), index)]
                        if here != there:
                            groups = [min(here, there) if group in (here, there) else group for group in groups]
    return groups


def _drives(path: Path) -> list[tuple[bytes, list[bytes]]]:
    """The id and the speeds of each obstacle as text, found without parsing, so that listing is cheap."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    drives: list[tuple[bytes, list[bytes]]] = []
    for match in re.finditer(
        rb"<(?:dynamicO|o)bstacle\b[^<>]*\bid\s*=\s*[\"'](\d+)[\"']|<velocity>\s*<exact>([^<]*)|<planningProblem",
        content,
    ):
        if match[1]:
            drives.append((match[1], []))
        elif not match[2]:
            break
        elif drives:
            drives[-1][1].append(match[2])
    return drives


def _read_recording(path: Path, group: str) -> Recording:
    """The recording of one scenario. A scenario without traffic has no rows and is counted in ``dropped``."""
    root = xml.parse(path)
    known = {"lanelet", "dynamicObstacle", "obstacle", "planningProblem"}
    if root.tag != "commonRoad" or not known & {element.tag for element in root}:
        raise RecordingError(
            path,
            f"a commonRoad element of version 2018b or 2020a was expected, with any of {', '.join(sorted(known))} in it, "
            f"but there is {root.tag[:40]!r} of version {root.get('commonRoadVersion')!r}",
        )
    dropped: Counter[str] = Counter()
    lanes = _lanes(root, path, dropped)
    tracks = _tracks(root, path, dropped)
    if len(tracks):
        tracks.check(path)
    else:
        dropped["recordings without traffic"] += 1
    return Recording(path.stem, group, tracks, lanes, dict(dropped))


def _tracks(root: Element, path: Path, dropped: Counter[str]) -> TrackTable:
    """Tracks of the moving obstacles; unsupported ones are left out and counted."""
    step = xml.number(root.get("timeStepSize"), "timeStepSize of commonRoad", path)
    if step <= 0:
        raise RecordingError(path, f"timeStepSize of commonRoad is {step}; a positive number of seconds was expected")
    rows: list[tuple[float, ...]] = []
    counts, kinds, extents = [], [], []
    ids: dict[int, bool] = {}
    for obstacle in _moving(root, path, dropped):
        identity = xml.whole(obstacle.get("id"), f"the id of a {obstacle.tag}", path)
        name = f"{obstacle.tag} {identity}"
        if identity in ids:
            raise RecordingError(path, f"there are two obstacles with the id {identity}: give each its own")
        ids[identity] = False
        shapes = list(_child(obstacle, "shape", name, path))
        states = obstacle.findall("trajectory/state")
        if len(shapes) != 1 or shapes[0].tag not in ("rectangle", "circle", "polygon"):
            dropped["obstacles whose shape is not one rectangle, circle or polygon"] += 1
            continue
        if not states:
            dropped["obstacles without a trajectory"] += 1
            continue
        track = [_state(_child(obstacle, "initialState", name, path), f"the initial state of {name}", path)]
        track += [_state(state, f"state {index} of {name}", path) for index, state in enumerate(states, 1)]
        if any(np.isnan(speed) for *_, speed in track):
            dropped["obstacles without velocities"] += 1
            continue
        ids[identity] = True
        rows += track
        counts.append(len(track))
        extents.append(_extent(shapes[0], f"the shape of {name}", path))
        kinds.append(KINDS.index(KIND_OF.get(_text(_child(obstacle, "type", name, path)), "other")))
    agent = np.repeat(np.arange(len(counts)), counts)
    time, x, y, heading, speed = np.array(rows, dtype=float).reshape(-1, 5).T
    low, high = np.array(extents, dtype=float).reshape(-1, 2, 2).transpose(1, 0, 2)
    # Positions refer to a point of the obstacle that need not be the centre of its shape.
    ahead, left = ((low + high) / 2)[agent].T
    cosine, sine = np.cos(heading), np.sin(heading)
    return TrackTable(
        rate=1.0 / step,
        agent=agent,
        frame=time.astype(int),
        position=np.stack([x + cosine * ahead - sine * left, y + sine * ahead + cosine * left], 1),
        heading=heading,
        velocity=speed[:, None] * np.stack([cosine, sine], 1),
        ids=np.array([identity for identity, kept in ids.items() if kept], dtype=int),
        size=high - low,
        kind=np.array(kinds, dtype=int),
    )


def _moving(root: Element, path: Path, dropped: Counter[str]) -> Iterator[Element]:
    """The moving obstacles: by their tag since 2020a, by their role before."""
    for element in root:
        if element.tag == "dynamicObstacle":
            yield element
        elif element.tag == "obstacle":
            role = _text(element.find("role"))
            if role == "dynamic":
                yield element
            elif role == "static":
                dropped[LEFT_OUT["staticObstacle"]] += 1
            else:
                raise RecordingError(
                    path, f"the role of obstacle {element.get('id')} is {role!r}, not static or dynamic"
                )
        elif element.tag in LEFT_OUT:
            dropped[LEFT_OUT[element.tag]] += 1


def _state(state: Element, name: str, path: Path) -> tuple[float, float, float, float, float]:
    """Time step, x, y, orientation and speed; the speed is NaN if it is missing.

    For intervals and areas, the middle is used; times are rounded down to whole steps.
    """
    time = _middle(_child(state, "time", name, path), f"time of {name}", path)
    if not 0 <= time <= LATEST:
        raise RecordingError(path, f"time of {name} is {time:g}; a step between 0 and {LATEST} was expected")
    areas = list(_child(state, "position", name, path))
    if len(areas) != 1 or areas[0].tag not in ("point", "rectangle", "circle", "polygon"):
        raise RecordingError(path, f"position of {name} must be one point, rectangle, circle or polygon")
    (area,) = areas
    if area.tag == "point":
        x, y = _point(area, f"position of {name}", path)
    else:
        if area.tag != "polygon":
            _child(area, "center", f"position of {name}", path)
        x, y = np.mean(_extent(area, f"position of {name}", path), axis=0)
    heading = _middle(_child(state, "orientation", name, path), f"orientation of {name}", path)
    velocity = state.find("velocity")
    speed = np.nan if velocity is None else _middle(velocity, f"velocity of {name}", path)
    return time // 1, x, y, heading, speed


def _extent(area: Element, name: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of x and y of a rectangle, circle or polygon."""
    if area.tag == "polygon":
        corners = _points(area, name, path)
        if len(corners) < 3:
            raise RecordingError(path, f"{name} is a polygon of {len(corners)} points; at least three were expected")
        return corners.min(0), corners.max(0)
    centre = area.find("center")
    middle = np.zeros(2) if centre is None else np.array(_point(centre, f"center of {name}", path))
    if area.tag == "circle":
        half = np.full(2, xml.number(area.findtext("radius"), f"radius of {name}", path))
    else:
        length = xml.number(area.findtext("length"), f"length of {name}", path)
        width = xml.number(area.findtext("width"), f"width of {name}", path)
        turn = xml.number(area.findtext("orientation", "0"), f"orientation of {name}", path)
        shift = xml.number(area.findtext("originXShift", "0"), f"originXShift of {name}", path)
        cosine, sine = np.cos(turn), np.sin(turn)
        middle = middle - shift * np.array([cosine, sine])
        half = np.array([[abs(cosine), abs(sine)], [abs(sine), abs(cosine)]]) @ np.array([length, width]) / 2
    return middle - half, middle + half


def _lanes(root: Element, path: Path, dropped: Counter[str]) -> LaneGraph | None:
    """The lane graph of a scenario; None without lanelets. References to missing elements are left out and counted."""
    lanelets: dict[int, Element] = {}
    left: list[Polyline] = []
    right: list[Polyline] = []
    centre: list[Polyline] = []
    elements = root.findall("lanelet")
    for element in elements:
        identity = xml.whole(element.get("id"), "the id of a lanelet", path)
        name = f"lanelet {identity}"
        if identity in lanelets:
            raise RecordingError(path, f"there are two lanelets with the id {identity}: give each its own")
        lines = [
            _points(_child(element, bound, name, path), f"{bound} of {name}", path)
            for bound in ("leftBound", "rightBound")
        ]
        if len(lines[0]) != len(lines[1]):
            raise RecordingError(
                path,
                f"the bounds of {name} have {len(lines[0])} and {len(lines[1])} points; the format wants them in pairs",
            )
        lines.append((lines[0] + lines[1]) / 2)
        if not all(len(line) and np.ptp(line, axis=0).any() for line in lines):
            dropped["lanes without length"] += 1
            continue
        lanelets[identity] = element
        for lists, line in zip((left, right, centre), lines, strict=True):
            lists.append(line)
    if not elements:
        return None
    index = {identity: lane for lane, identity in enumerate(lanelets)}
    signs = _speed_signs(root, path)

    def lane(reference: Element, identity: int) -> int:
        """Index of the lane that an element of a lanelet refers to; -1 if it does not exist."""
        to = index.get(xml.whole(reference.get("ref"), f"ref of {reference.tag} of lanelet {identity}", path), -1)
        if to < 0:
            dropped["lane references to lanes that do not exist"] += 1
        return to

    successors: list[dict[int, None]] = [{} for _ in lanelets]
    beside = {side: np.full(len(lanelets), -1) for side in ("Left", "Right")}
    change = {side: np.full(len(lanelets), -1) for side in ("Left", "Right")}
    limit, kind = np.full(len(lanelets), np.nan), np.full(len(lanelets), LANE)
    for at, (identity, element) in enumerate(lanelets.items()):
        for reference in element.findall("successor"):
            successors[at][lane(reference, identity)] = None
        for reference in element.findall("predecessor"):
            before = lane(reference, identity)
            if before >= 0:
                successors[before][at] = None
        for side, solid in (("Left", SOLID | {"dashed_solid"}), ("Right", SOLID | {"solid_dashed"})):
            neighbour = element.find(f"adjacent{side}")
            if neighbour is None:
                continue
            direction = neighbour.get("drivingDir")
            if direction not in ("same", "opposite"):
                raise RecordingError(
                    path, f"drivingDir of adjacent{side} of lanelet {identity} is {direction!r}, not same or opposite"
                )
            to = lane(neighbour, identity)
            if to == at:
                raise RecordingError(path, f"lanelet {identity} lies beside itself: correct its adjacent{side}")
            if direction == "same":
                beside[side][at] = to
                if _text(element.find(f"{side.lower()}Bound/lineMarking")) not in solid:
                    change[side][at] = to
        limits = [
            _speed(given.text, f"speedLimit of lanelet {identity}", path) for given in element.findall("speedLimit")
        ]
        for reference in element.findall("trafficSignRef"):
            sign = xml.whole(reference.get("ref"), f"ref of trafficSignRef of lanelet {identity}", path)
            if sign not in signs:
                dropped["lane references to traffic signs that do not exist"] += 1
            limits += signs.get(sign, [])
        limit[at] = min(limits, default=np.nan)
        if SHOULDERS & {_text(given) for given in element.findall("laneletType")}:
            kind[at] = SHOULDER
    return LaneGraph(
        ids=np.array(list(lanelets), dtype=int),
        left=left,
        right=right,
        centre=centre,
        successors=[tuple(to for to in following if to >= 0) for following in successors],
        left_of=change["Left"],
        right_of=change["Right"],
        adjacent_left=beside["Left"],
        adjacent_right=beside["Right"],
        speed_limit=limit,
        kind=kind,
    ).check(path)


def _speed_signs(root: Element, path: Path) -> dict[int, list[float]]:
    """Speed limits [m/s] of each traffic sign (2020a)."""
    return {
        xml.whole(sign.get("id"), "the id of a trafficSign", path): [
            _speed(element.findtext("additionalValue"), f"additionalValue of trafficSign {sign.get('id')}", path)
            for element in sign.findall("trafficSignElement")
            if _text(element.find("trafficSignID")) in SPEED_SIGNS and element.find("additionalValue") is not None
        ]
        for sign in root.findall("trafficSign")
    }


def _speed(text: str | None, what: str, path: Path) -> float:
    speed = xml.number(text, what, path)
    if not 0 < speed <= FASTEST:
        raise RecordingError(path, f"{what} is {speed:g}; a positive speed in m/s was expected")
    return speed


def _child(element: Element, tag: str, name: str, path: Path) -> Element:
    child = element.find(tag)
    if child is None:
        raise RecordingError(path, f"{name} has no {tag} element, which the format demands")
    return child


def _text(element: Element | None) -> str:
    return "" if element is None or element.text is None else element.text.strip()


def _middle(element: Element, name: str, path: Path) -> float:
    """The number in an element: exact, or the middle of an interval."""
    exact = element.find("exact")
    if exact is not None:
        return xml.number(exact.text, name, path)
    low = xml.number(element.findtext("intervalStart"), f"exact or intervalStart in {name}", path)
    high = xml.number(element.findtext("intervalEnd"), f"intervalEnd in {name}", path)
    return low / 2 + high / 2


def _point(element: Element, name: str, path: Path) -> tuple[float, float]:
    return (
        xml.number(element.findtext("x"), f"x of {name}", path),
        xml.number(element.findtext("y"), f"y of {name}", path),
    )


def _points(element: Element, name: str, path: Path) -> Polyline:
    points = [_point(point, name, path) for point in element.findall("point")]
    return np.array(points, dtype=float).reshape(-1, 2)
