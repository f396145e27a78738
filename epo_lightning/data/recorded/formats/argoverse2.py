"""Reader of Argoverse 2 motion forecasting: one folder per scenario, with its tracks as parquet and its map as JSON.

Wilson et al., "Argoverse 2: Next Generation Datasets for Self-Driving Perception and Forecasting", NeurIPS Datasets and
Benchmarks 2021. A scenario has 110 frames at 10 Hz, 5 s observed and 6 s to forecast; in the publisher's test split, only
the first 50. Positions are in metres in the frame of a city, headings in radians. Sizes are not given: typical ones of the
type are used.
"""

from __future__ import annotations

import json
import os
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import shapely

from epo_lightning.data.recorded.formats.onboard import References, refuse, tracks_of, without_tiny
from epo_lightning.data.recorded.kinds import kinds_of, typical_sizes
from epo_lightning.data.recorded.lanes import FARTHEST, LANE, SHOULDER, LaneGraph, Polyline
from epo_lightning.data.recorded.tracks import Recording, RecordingError, RecordingSource, TrackTable
from epo_lightning.registry import one_line, register

SPLITS = ("train", "val", "test")
"""Names of the folders of the publisher's splits."""
KIND_OF = {
    "vehicle": "car",
    "bus": "bus",
    "motorcyclist": "motorcycle",
    "cyclist": "bicycle",
    "pedestrian": "pedestrian",
    "unknown": "other",
}
"""Agent kinds by object type."""
LEFT_OUT = ("static", "background", "construction", "riderless_bicycle")
"""Object types that are no agents."""
EGO, EGO_ID = "AV", -1
"""Identifier of the recording car: in the files, and the number that stands for it; all others are numbers."""
NUMBERS = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
COLUMNS = ("track_id", "object_type", "timestep", *NUMBERS)
LATEST = 10_000
"""Largest time step."""
UNCROSSABLE = ("SOLID_WHITE", "SOLID_YELLOW", "SOLID_BLUE", "DOUBLE_SOLID_WHITE", "DOUBLE_SOLID_YELLOW")
"""Markings that may not be crossed. Of those with one dashed line, which side it is on is not documented: they may be."""
SPACING = 2.0
"""Largest distance of points of a centreline [m]."""
MOST = 500
"""Largest number of pieces of a centreline."""


@register("format", "argoverse2")
def argoverse2(folder: Path) -> list[RecordingSource]:
    """The scenarios below a folder, in its folders ``train`` and ``val``, or in any other folders.

    Scenarios in ``train`` and ``val`` have these names as their group, so that ``data.test=["val"]`` keeps the publisher's
    validation split for testing. Any other scenario is a group of its own. The publisher's ``test`` is left out if other
    splits are there: its scenarios end at the current time, without futures. Only names of files are read. A scenario that
    lacks one of its two files is listed, and refused when it is read.

    Raises:
        RecordingError: there is no scenario, or two have the same name.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(folder, "there is no such folder: name the one with train/ and val/, or with scenarios")
    provided = {split: folder / split for split in SPLITS if (folder / split).is_dir()}
    if set(provided) - {"test"}:
        if "test" in provided:
            warnings.warn(f"{provided.pop('test')} is left out: its scenarios have no futures", stacklevel=2)
        places: list[tuple[str | None, Path]] = list(provided.items())
    else:
        places = [(None, folder)]
    found = [source for split, home in places for source in _sources(home, split)]
    if not found:
        raise RecordingError(
            folder, "there is no Argoverse 2 scenario in it: folders called ID with scenario_ID.parquet were expected"
        )
    first: dict[str, RecordingSource] = {}
    for source in found:
        if (other := first.setdefault(source.name, source)) is not source:
            raise RecordingError(
                source.files[0].parent, f"{other.files[0].parent} has the same name: remove one of the two"
            )
    return found


def _sources(home: Path, split: str | None) -> Iterator[RecordingSource]:
    """The scenarios of a folder and of those below it, sorted by folder."""
    for place, folders, names in os.walk(home):
        folders.sort()
        here = Path(place)
        parts = [
            {
                name.removeprefix(begin).removesuffix(end)
                for name in names
                if name.startswith(begin) and name.endswith(end)
            }
            for begin, end in (("scenario_", ".parquet"), ("log_map_archive_", ".json"))
        ]
        for name in sorted(parts[0] | parts[1]):
            tracks, lanes = here / f"scenario_{name}.parquet", here / f"log_map_archive_{name}.json"
            files = tuple(file for file, known in zip((tracks, lanes), parts, strict=True) if name in known)
            group = split or name
            if len(files) == 2:
                yield RecordingSource(name, group, files, partial(_read_recording, name, group, tracks, lanes))
            else:
                (missing,) = {tracks, lanes} - set(files)
                error = RecordingError(missing, f"there is no such file, but {files[0].name} is there: fetch it again")
                yield RecordingSource(name, group, files, partial(refuse, error))


def _read_recording(name: str, group: str, tracks: Path, lanes: Path) -> Recording:
    dropped: Counter[str] = Counter()
    table = _tracks(tracks, dropped)
    return Recording(name, group, table, read_map(lanes, dropped), dict(dropped))


def _tracks(path: Path, dropped: Counter[str]) -> TrackTable:
    rows = _table(path)
    kinds = rows["object_type"].to_numpy()
    agents = np.isin(kinds, LEFT_OUT, invert=True)
    if not agents.all():
        things = rows.filter(~agents)["track_id"].n_unique()
        dropped["tracks of things that are no agents (static, construction, ...)"] += things
        rows, kinds = rows.filter(agents), kinds[agents]
    ids, first, agent = np.unique(rows["id"].to_numpy(), return_index=True, return_inverse=True)
    other = np.flatnonzero(kinds != kinds[first][agent])
    if len(other):
        at = int(other[0])
        raise RecordingError(
            path,
            f"track {ids[agent[at]]} is of the types {kinds[first][agent][at]!r} and {kinds[at]!r}: an id must belong to "
            "one object",
        )
    kind = kinds_of(kinds[first], dropped, KIND_OF)
    return tracks_of(
        path,
        rows["timestep"].to_numpy(),
        agent,
        rows.select(NUMBERS).to_numpy(),
        ids,
        typical_sizes(kind),
        kind,
        dropped,
    )


def _table(path: Path) -> pl.DataFrame:
    """The rows of a scenario: its columns ``COLUMNS``, and the tracks' identifiers as numbers, ``id``.

    Raises:
        RecordingError: the file is no parquet, lacks a column, or has a column of another type or an empty cell.
    """
    try:
        with path.open("rb") as file:
            rows = pl.read_parquet(file, columns=list(COLUMNS))
    except pl.exceptions.ColumnNotFoundError as error:
        raise RecordingError(
            path, f"the columns {', '.join(COLUMNS)} were expected, but {str(error).partition(';')[0]}"
        ) from None
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        reason = one_line(error, 200) or type(error).__name__
        raise RecordingError(path, f"it cannot be read as parquet ({reason}): fetch the file again") from None
    for name in COLUMNS:
        kind = rows.schema[name]
        fits = (
            kind == pl.String
            if name in ("track_id", "object_type")
            else kind.is_integer()
            if name == "timestep"
            else kind.is_numeric()
        )
        if not fits:
            raise RecordingError(
                path, f"the column {name} is of the type {kind}, which does not fit: fetch the file again"
            )
        if rows[name].null_count():
            raise RecordingError(path, f"there is no {name}", row=int(rows[name].is_null().arg_max() or 0) + 1)
    step = rows["timestep"]
    if len(wrong := (~step.is_between(0, LATEST)).arg_true()):
        raise RecordingError(path, f"timestep is {step[wrong[0]]}; 0 to {LATEST} was expected", row=wrong[0] + 1)
    text = rows["track_id"]
    number = text.str.extract(r"^(\d{1,18})$").cast(pl.Int64)
    rows = rows.with_columns(id=pl.when(text == EGO).then(EGO_ID).otherwise(number), timestep=step.cast(pl.Int64))
    if len(wrong := rows["id"].is_null().arg_true()):
        raise RecordingError(
            path, f"track_id is {text[wrong[0]][:40]!r}; a number or {EGO} was expected", row=wrong[0] + 1
        )
    return rows.with_columns(pl.col(name).cast(pl.Float64) for name in NUMBERS)


def read_map(path: Path, dropped: Counter[str]) -> LaneGraph | None:
    """The lane graph of a map; None without lanes.

    Centrelines are midway between the boundaries. Lanes for bicycles are not offered as neighbours to change to.

    Args:
        path: ``log_map_archive_*.json``.
        dropped: counts of items that are left out.

    Raises:
        RecordingError: the file is no JSON, or not a map in this format.
    """
    segments = _segments(path)
    if not segments:
        return None
    lanes: list[dict[str, Any]] = []
    left: list[Polyline] = []
    right: list[Polyline] = []
    ids: set[int] = set()
    for segment in segments:
        identity = _whole(segment.get("id"), "the id of a lane", path)
        if identity in ids:
            raise RecordingError(path, f"there are two lanes with the id {identity}: give each its own")
        ids.add(identity)
        sides = [
            _line(segment.get(name), f"{name} of lane {identity}", path)
            for name in ("left_lane_boundary", "right_lane_boundary")
        ]
        if not all((line != line[:1]).any() for line in sides):
            dropped["lanes without length"] += 1
            continue
        lanes.append(segment)
        for lines, line in zip((left, right), sides, strict=True):
            lines.append(line)
    if not lanes:
        raise RecordingError(path, "none of its lanes has a length: fetch the file again")
    centre = midways(left, right)
    references = References((segment["id"] for segment in lanes), dropped)
    exits, entries = (
        [_wholes(lane.get(name), f"{name} of lane {lane['id']}", path) for lane in lanes]
        for name in ("successors", "predecessors")
    )
    beside, change = np.full((2, len(lanes)), -1), np.full((2, len(lanes)), -1)
    chord = [line[-1] - line[0] for line in centre]
    for at, lane in enumerate(lanes):
        for number, side in enumerate(("left", "right")):
            neighbour = lane.get(f"{side}_neighbor_id")
            what = f"{side}_neighbor_id of lane {lane['id']}"
            to = references.lane(None if neighbour is None else _whole(neighbour, what, path))
            if to == at:
                raise RecordingError(path, f"lane {lane['id']} lies beside itself: correct its {side}_neighbor_id")
            # Lanes of oncoming traffic are neighbours in these maps too.
            if to >= 0 and chord[at] @ chord[to] > 0:
                beside[number, at] = to
                if lane.get(f"{side}_lane_mark_type") not in UNCROSSABLE:
                    change[number, at] = to
    return LaneGraph(
        ids=np.array([lane["id"] for lane in lanes], dtype=int),
        left=left,
        right=right,
        centre=centre,
        successors=references.successors(exits, entries),
        left_of=change[0],
        right_of=change[1],
        adjacent_left=beside[0],
        adjacent_right=beside[1],
        speed_limit=np.full(len(lanes), np.nan),
        kind=np.array([SHOULDER if lane.get("lane_type") == "BIKE" else LANE for lane in lanes]),
    ).check(path)


def midways(left: Sequence[Polyline], right: Sequence[Polyline]) -> list[Polyline]:
    """The lines of the midpoints of pairs of boundaries at equal shares of their lengths, at most ``SPACING`` apart."""
    sides = []
    for lines in (left, right):
        owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
        sides.append(shapely.linestrings(np.concatenate(lines), indices=owner))
    length = np.maximum(*(shapely.length(side) for side in sides))
    pieces = np.clip(np.ceil(length / SPACING), 1, MOST).astype(int)
    lane = np.repeat(np.arange(len(left)), pieces + 1)
    first = np.append(0, (pieces + 1).cumsum())
    share = (np.arange(len(lane)) - first[lane]) / pieces[lane]
    points = [
        shapely.get_coordinates(shapely.line_interpolate_point(side[lane], share, normalized=True)) for side in sides
    ]
    return np.split((points[0] + points[1]) / 2, first[1:-1])


def _segments(path: Path) -> list[dict[str, Any]]:
    """The lane segments of a map."""
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise RecordingError(path, f"it is no JSON ({error}): fetch the file again") from None
    segments = content.get("lane_segments") if isinstance(content, dict) else None
    if not isinstance(segments, dict) or not all(isinstance(segment, dict) for segment in segments.values()):
        raise RecordingError(path, "lane_segments was expected to be an object with one object per lane")
    return list(segments.values())


def _whole(value: Any, what: str, path: Path) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**63:
        raise RecordingError(path, f"{what} is {str(value)[:40]!r}; a whole number was expected")
    return value


def _wholes(value: Any, what: str, path: Path) -> list[int]:
    if not isinstance(value, list):
        raise RecordingError(path, f"{what} is {str(value)[:40]!r}; a list of whole numbers was expected")
    return [_whole(each, what, path) for each in value]


def _line(points: Any, what: str, path: Path) -> Polyline:
    """The points x, y of a boundary."""
    try:
        line = np.array([(point["x"], point["y"]) for point in points], dtype=float).reshape(-1, 2)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise RecordingError(path, f"{what} was expected to be a list of points with numbers x and y") from None
    if not (np.abs(line) <= FARTHEST).all():
        raise RecordingError(path, f"{what} has coordinates that are not finite or beyond {FARTHEST:g} m")
    return without_tiny(line)
