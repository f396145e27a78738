"""Reader of Waymo Open Motion: shards of scenarios, protocol buffers in tfrecord files, with their tracks and maps.

Ettinger et al., "Large Scale Interactive Motion Forecasting for Autonomous Driving", ICCV 2021. A scenario has 91 frames at
10 Hz: 1 s of history, the current one, and 8 s to forecast; in the publisher's testing split, only the first 11. Positions
are in metres from an arbitrary origin, headings in radians. The map has centrelines of lanes; boundaries follow from the
road lines and edges beside them.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from google.protobuf.message import DecodeError
from jaxtyping import Bool, Float
from numba import njit

from epo_lightning.data.recorded.formats.onboard import RATE, References, refuse, tracks_of, without_tiny
from epo_lightning.data.recorded.formats.tfrecord import Place, content_of, places
from epo_lightning.data.recorded.formats.waymo_messages import (
    BIKE_LANE,
    CYCLIST,
    OTHER,
    PEDESTRIAN,
    SOLID,
    VEHICLE,
    scenario_class,
)
from epo_lightning.data.recorded.kinds import TYPICAL_SIZE, kinds_of
from epo_lightning.data.recorded.lanes import FARTHEST, LANE, SHOULDER, LaneGraph, Polyline
from epo_lightning.data.recorded.tracks import FASTEST, LONGEST, Recording, RecordingError, RecordingSource, TrackTable
from epo_lightning.registry import register

SPLIT_OF = {
    "training": "training",
    "training_20s": "training",
    "validation": "validation",
    "validation_interactive": "validation",
    "testing": "testing",
    "testing_interactive": "testing",
}
"""Splits by the name of a folder of the publisher. Two folders of one split hold the same drives."""
KIND_OF = {VEHICLE: "car", PEDESTRIAN: "pedestrian", CYCLIST: "bicycle", OTHER: "other"}
"""Agent kinds by object type."""
TRUCK = 7.0
"""Length [m] from which a vehicle counts as a truck; the data set does not tell cars, trucks and buses apart."""
JITTER = 0.5
"""Largest deviation of the time between two frames, as a share of it."""
MILES_PER_HOUR = 0.44704
"""[m/s]"""
HALF, HALF_BIKE = 1.8, 0.75
"""Distance [m] from a centreline to the boundary of its lane where the map has none."""
FLAT = 0.02
"""Largest distance [m] of a simplified line from the line in the map."""
SAME = 1e-6
"""Largest distance [m] of points of a line that are the same."""
NARROWEST, WIDEST = 0.5, 3.0
"""Smallest and largest distance [m] from a centreline to a boundary: road edges of other lanes may be named too."""


@register("format", "waymo")
def waymo(folder: Path) -> list[RecordingSource]:
    """The scenarios of all shards (``*.tfrecord*``) below a folder.

    Scenarios in folders ``training`` and ``validation`` have these names as their group, so that
    ``data.test=["validation"]`` keeps the publisher's validation split for testing. Otherwise, each shard is a group.
    The publisher's ``testing`` is left out if other splits are there: its scenarios end at the current time. A scenario is
    named after its shard and its number in it. Only the headers of the records are read. A damaged shard is listed up to
    the damage, and one recording more, which is refused when it is read.

    Raises:
        RecordingError: there is no shard, two have the same name, or two folders hold the same drives.
    """
    folder = Path(folder)
    # Links to nowhere are kept: a shard that is not there must not be left out in silence.
    shards = sorted(path for path in folder.rglob("*tfrecord*") if path.name[0] != "." and not path.is_dir())
    if not shards:
        raise RecordingError(folder, "there is no shard in it: files called *.tfrecord-00000-of-01000 were expected")
    homes = {shard: _home(folder, shard) for shard in shards}
    known = {home for home in homes.values() if home}
    if len({SPLIT_OF[home] for home in known} - {"testing"}) and (
        without := {h for h in known if SPLIT_OF[h] == "testing"}
    ):
        warnings.warn(
            f"{', '.join(sorted(without))} in {folder}: left out, its scenarios have no futures", stacklevel=2
        )
        shards = [shard for shard in shards if homes[shard] not in without]
        known -= without
    for home in sorted(known):
        for other in sorted(known - {home}):
            if SPLIT_OF[home] == SPLIT_OF[other]:
                raise RecordingError(folder, f"{home} and {other} hold the same drives: move one of them elsewhere")
    first: dict[str, Path] = {}
    found = []
    for shard in shards:
        if (same := first.setdefault(shard.name, shard)) != shard:
            raise RecordingError(shard, f"{same} has the same name: rename or remove one of the two")
        found += _sources(shard, SPLIT_OF.get(homes[shard] or "", shard.name))
    return found


def _home(folder: Path, shard: Path) -> str | None:
    """The publisher's folder below ``folder`` that a shard lies in; None for any other place."""
    parts = [part for part in shard.relative_to(folder).parts[:-1] if part in SPLIT_OF]
    return parts[-1] if parts else None


def _sources(shard: Path, group: str) -> list[RecordingSource]:
    """The scenarios of a shard."""
    found, error = places(shard)
    named = [(f"{shard.name}-{number:04d}", place) for number, place in enumerate(found)]
    sources = [
        RecordingSource(name, group, (shard,), partial(_read_recording, name, group, shard, place))
        for name, place in named
    ]
    if error is not None:
        sources.append(RecordingSource(f"{shard.name}-{len(found):04d}", group, (shard,), partial(refuse, error)))
    return sources


def scenario(shard: Path, place: Place) -> Any:
    """The message ``Scenario`` of a record, with the fields in :mod:`~epo_lightning.data.recorded.formats.waymo_messages`.

    Raises:
        RecordingError: the record is damaged, or is no scenario.
    """
    message = scenario_class()()
    try:
        message.ParseFromString(content_of(shard, place))
    except DecodeError as error:
        raise RecordingError(shard, f"the record at byte {place.offset} is no Scenario ({error})") from None
    if not message.timestamps_seconds or not message.tracks:
        raise RecordingError(
            shard, f"the record at byte {place.offset} has no timestamps or no tracks: is it of Waymo Open Motion?"
        )
    return message


def _read_recording(name: str, group: str, shard: Path, place: Place) -> Recording:
    message = scenario(shard, place)
    dropped: Counter[str] = Counter()
    where = Path(f"{shard}:{place.offset}")
    return Recording(name, group, _tracks(message, where, dropped), _lanes(message, where, dropped), dict(dropped))


def _tracks(message: Any, path: Path, dropped: Counter[str]) -> TrackTable:
    with np.errstate(invalid="ignore", over="ignore"):
        steps = np.diff(np.array(message.timestamps_seconds)) * RATE
        uneven = ~(np.abs(steps - 1) <= JITTER)
    if uneven.any():
        at = int(np.flatnonzero(uneven)[0])
        raise RecordingError(
            path, f"{steps[at] / RATE:.3g} s between the frames {at} and {at + 1}; {1 / RATE:g} s were expected"
        )
    count = len(message.timestamps_seconds)
    ids: list[int] = []
    kinds, sizes, frames, agents, rows = [], [], [], [], []
    for track in message.tracks:
        if len(track.states) != count:
            raise RecordingError(path, f"track {track.id} has {len(track.states)} states, but there are {count} frames")
        seen = [
            (k, s.center_x, s.center_y, s.heading, s.velocity_x, s.velocity_y, s.length, s.width)
            for k, s in enumerate(track.states)
            if s.valid
        ]
        if not seen:
            dropped["tracks without a valid state"] += 1
            continue
        table = np.array(seen)
        # Sizes change from frame to frame. The first one is known whenever the agent is.
        size, kind = table[0, 6:], KIND_OF.get(track.object_type, "unknown")
        if not ((size > 0) & (size <= LONGEST)).all():
            dropped["agents whose size cannot be right, taken as one typical for their type"] += 1
            size = np.array(TYPICAL_SIZE.get(kind, TYPICAL_SIZE["other"]))
        frames.append(table[:, 0].astype(int))
        agents.append(np.full(len(table), len(ids)))
        rows.append(table[:, 1:6])
        ids.append(track.id)
        sizes.append(size)
        kinds.append("truck" if kind == "car" and size[0] >= TRUCK else kind)
    if len(set(ids)) < len(ids):
        (twice, _), *_ = Counter(ids).most_common(1)
        raise RecordingError(path, f"there are two tracks with the id {twice}: an id must belong to one object")
    return tracks_of(
        path,
        np.concatenate([np.empty(0, dtype=int), *frames]),
        np.concatenate([np.empty(0, dtype=int), *agents]),
        np.concatenate([np.empty((0, 5)), *rows]),
        np.array(ids, dtype=int),
        np.array(sizes).reshape(-1, 2),
        kinds_of(kinds, dropped),
        dropped,
    )


def _lanes(message: Any, path: Path, dropped: Counter[str]) -> LaneGraph | None:
    """The lane graph of a scenario; None without lanes."""
    lanes: dict[int, Any] = {}
    centre: dict[int, Polyline] = {}
    beside: dict[int, Polyline] = {}
    for feature in message.map_features:
        if feature.HasField("lane"):
            if feature.id in lanes:
                raise RecordingError(path, f"there are two lanes with the id {feature.id}: give each its own")
            line = _points(feature.lane.polyline, f"lane {feature.id}", path)
            if _moved(line).sum() < 2:
                dropped["lanes without length"] += 1
                continue
            lanes[feature.id], centre[feature.id] = feature.lane, line
        for kind in ("road_line", "road_edge"):
            if feature.HasField(kind):
                line = _points(getattr(feature, kind).polyline, f"{kind} {feature.id}", path)
                if len(line) > 1:
                    beside[feature.id] = line
    if not lanes:
        return None
    references = References(lanes, dropped)
    adjacent, change = np.full((2, len(lanes)), -1), np.full((2, len(lanes)), -1)
    sides: tuple[list[Polyline], list[Polyline]] = ([], [])
    lines: list[Polyline] = []
    limit = np.full(len(lanes), np.nan)
    for at, (identity, lane) in enumerate(lanes.items()):
        moved = _moved(centre[identity])
        lines.append(centre[identity][moved])
        normal = _normals(lines[-1])
        for side, (neighbours, boundaries, sign) in enumerate(
            ((lane.left_neighbors, lane.left_boundaries, 1), (lane.right_neighbors, lane.right_boundaries, -1))
        ):
            half = _half_width(centre[identity], lane, neighbours, boundaries, beside, centre)[moved]
            sides[side].append(lines[-1] + sign * half[:, None] * normal)
            # A lane may have several neighbours one after the other: the one along most of it counts.
            best = max(neighbours, key=lambda each: each.self_end_index - each.self_start_index, default=None)
            to = -1 if best is None else references.lane(best.feature_id)
            if to == at:
                raise RecordingError(path, f"lane {identity} lies beside itself")
            adjacent[side, at] = to
            kinds = {boundary.boundary_type for boundary in best.boundaries} if best is not None else set()
            change[side, at] = -1 if kinds and kinds <= SOLID else to
        if lane.speed_limit_mph:
            limit[at] = lane.speed_limit_mph * MILES_PER_HOUR
            if not 0 < limit[at] <= FASTEST:
                dropped["speed limits that cannot be right"] += 1
                limit[at] = np.nan
    return LaneGraph(
        ids=np.array(list(lanes), dtype=int),
        left=_simplified(sides[0]),
        right=_simplified(sides[1]),
        centre=_simplified(lines),
        successors=references.successors(
            [lane.exit_lanes for lane in lanes.values()], [lane.entry_lanes for lane in lanes.values()]
        ),
        left_of=change[0],
        right_of=change[1],
        adjacent_left=adjacent[0],
        adjacent_right=adjacent[1],
        speed_limit=limit,
        kind=np.array([SHOULDER if lane.type == BIKE_LANE else LANE for lane in lanes.values()]),
    ).check(path)


def _points(points: Any, what: str, path: Path) -> Polyline:
    line = np.array([(point.x, point.y) for point in points], dtype=float).reshape(-1, 2)
    if not (np.abs(line) <= FARTHEST).all():
        raise RecordingError(path, f"{what} has coordinates that are not finite or beyond {FARTHEST:g} m")
    return without_tiny(line)


def _moved(line: Polyline) -> Bool[np.ndarray, " n"]:
    """Mask of the points of a line that differ from the point before."""
    return np.append(np.ones(min(len(line), 1), dtype=bool), np.hypot(*np.diff(line, axis=0).T) > SAME)


def _normals(line: Polyline) -> Polyline:
    """Unit vectors to the left at the points of a line without equal consecutive points."""
    way = np.diff(line, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    along = np.concatenate([way[:1], way[:-1] + way[1:], way[-1:]])
    # Where a line turns back on itself, the direction before the turn is taken.
    back = np.linalg.norm(along, axis=1) < 1e-6
    along[back] = np.concatenate([way[:1], way])[back]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], 1)


def _simplified(lines: Sequence[Polyline]) -> list[Polyline]:
    """Lines with fewer points, at most ``FLAT`` from the given ones: the maps have a point every half metre."""
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    simple = shapely.simplify(shapely.linestrings(np.concatenate(lines), indices=owner), FLAT, preserve_topology=False)
    found = [shapely.get_coordinates(line) for line in simple]
    # A loop that is smaller than the tolerance would have no length.
    return [line if (line != line[:1]).any() else given for line, given in zip(found, lines, strict=True)]


@njit(cache=True)
def _distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance of each point from a polyline."""
    found = np.empty(len(points))
    for k in range(len(points)):
        x, y = points[k]
        best = np.inf
        for j in range(len(line) - 1):
            along_x, along_y = line[j + 1, 0] - line[j, 0], line[j + 1, 1] - line[j, 1]
            to_x, to_y = x - line[j, 0], y - line[j, 1]
            square = along_x * along_x + along_y * along_y
            share = 0.0
            if square > 0:
                share = min(1.0, max(0.0, (to_x * along_x + to_y * along_y) / square))
            best = min(best, (to_x - share * along_x) ** 2 + (to_y - share * along_y) ** 2)
        found[k] = np.sqrt(best)
    return found


def _half_width(
    line: Polyline,
    lane: Any,
    neighbours: Sequence[Any],
    boundaries: Sequence[Any],
    beside: dict[int, Polyline],
    centre: dict[int, Polyline],
) -> Float[np.ndarray, " n"]:
    """Distance [m] from each point of a centreline to the boundary on one side.

    It is the distance to the road line or edge that the map names there, or else half of that to the neighbouring lane.
    """
    half = np.full(len(line), np.nan)

    def measure(first: int, last: int, other: Polyline, share: float) -> None:
        part = slice(max(first, 0), max(last, 0) + 1)
        way = share * _distance(line[part], other)
        half[part] = np.fmin(half[part], np.clip(way, NARROWEST, WIDEST))

    for boundary in boundaries:
        if boundary.boundary_feature_id in beside:
            measure(boundary.lane_start_index, boundary.lane_end_index, beside[boundary.boundary_feature_id], 1.0)
    known = ~np.isnan(half)
    for neighbour in neighbours:
        if neighbour.feature_id in centre and not known.all():
            named = half.copy()
            measure(neighbour.self_start_index, neighbour.self_end_index, centre[neighbour.feature_id], 0.5)
            half = np.where(known, named, half)
    return np.where(np.isnan(half), HALF_BIKE if lane.type == BIKE_LANE else HALF, half)
