"""Reader of the levelXdata family: exiD (versions 2.0 and 2.1), highD, inD, rounD and uniD.

Moers et al., "The exiD Dataset", IV 2022; Krajewski et al., "The highD Dataset", ITSC 2018, and "The rounD Dataset", ITSC
2020; Bock et al., "The inD Dataset", IV 2020. A data set is a folder with ``data/NN_tracks.csv``, ``NN_tracksMeta.csv`` and
``NN_recordingMeta.csv`` for each recording, and in all but highD with a Lanelet2 map for each location. Lengths are in
metres, times in seconds, angles in degrees; x points east and y north from an origin in UTM zone 32. What differs between
the data sets is the table of :mod:`~epo_lightning.data.recorded.formats.levelx_dialects`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import shapely
from jaxtyping import Float, Int

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats import lanelet2
from epo_lightning.data.recorded.formats.exid_tables import (
    RECORDING_META,
    TRACKS,
    TRACKS_META,
    USED,
    read_table,
)
from epo_lightning.data.recorded.formats.highd_lanes import highd_lanes
from epo_lightning.data.recorded.formats.levelx_dialects import DIALECTS, LANELET2, MARKINGS, Dialect
from epo_lightning.data.recorded.formats.motion import check_motion
from epo_lightning.data.recorded.formats.tables import FLOATS, INT, Types, raise_first
from epo_lightning.data.recorded.kinds import completed_sizes, kinds_of
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.tracks import FASTEST, Recording, RecordingSource, TrackTable, unwrapped
from epo_lightning.registry import register

MARKING_COLUMNS = ("upperLaneMarkings", "lowerLaneMarkings")
"""Columns of recordingMeta with the positions of lane markings (highD)."""
SLOWEST = 2.0
"""Speed [m/s] from which on a vehicle's velocity points where the vehicle does, if headings are not recorded."""
LATEST = 10**9
"""Largest frame number."""
ZONE = 32
"""UTM zone of all locations."""
FAR = 10.0
"""Distance [m] from the nearest line of a lane beyond which a position does not lie on the map."""
SAMPLE = 5000
"""Largest number of positions that are compared with the map."""


@register("format", "exid")
def exid(folder: Path) -> list[RecordingSource]:
    """The recordings in a folder of exiD files, or in its folder ``data``.

    Raises:
        RecordingError: there is no recording, or one of them lacks a file, has broken metadata or has no map.
    """
    return _sources("exid", Path(folder))


@register("format", "highd")
def highd(folder: Path) -> list[RecordingSource]:
    """The recordings in a folder of highD files, as :func:`exid`. Lanes are those between the recorded lane markings."""
    return _sources("highd", Path(folder))


@register("format", "ind")
def ind(folder: Path) -> list[RecordingSource]:
    """The recordings in a folder of inD files, as :func:`exid`; recordings without a map have no lanes."""
    return _sources("ind", Path(folder))


@register("format", "round")
def round_(folder: Path) -> list[RecordingSource]:
    """The recordings in a folder of rounD files, as :func:`ind`; most are of one place, so each is its own group."""
    return _sources("round", Path(folder))


@register("format", "unid")
def unid(folder: Path) -> list[RecordingSource]:
    """The recordings in a folder of uniD files, as :func:`ind`; they are all of one place, and each is its own group."""
    return _sources("unid", Path(folder))


class _Files(NamedTuple):
    """The files of a recording; the last one is its map, if it has one."""

    tracks: Path
    tracks_meta: Path
    recording_meta: Path
    map: Path | None


class _Setting(NamedTuple):
    """The metadata of a whole recording."""

    recording: int
    location: int
    rate: float
    speed_limit: float
    duration: float
    origin: tuple[float, float]
    markings: tuple[tuple[float, ...], tuple[float, ...]]


def _sources(dialect: str, folder: Path) -> list[RecordingSource]:
    """The recordings of a data set of the family, in the order of their numbers."""
    title, folders = DIALECTS[dialect].title, DIALECTS[dialect].map_folders
    home = folder / "data" if (folder / "data").is_dir() else folder
    if not home.is_dir():
        raise RecordingError(
            folder, f"there is no such folder: unzip {title} there, or name the folder with its data/ and maps/"
        )
    names = {
        match[1]
        for file in home.iterdir()
        if (match := re.fullmatch(r"(\d+)_(?:tracks|tracksMeta|recordings?Meta)\.csv", file.name, re.ASCII))
    }
    if not names:
        raise RecordingError(home, "there is no recording in it: files called NN_tracks.csv were expected")
    roots = [*(folder / place for place in folders), home]
    if folder.name == "data":
        roots += [folder.parent / place for place in folders]
    ordered = sorted(names, key=lambda name: (int(name), name))
    for one, other in pairwise(ordered):
        if int(one) == int(other):
            raise RecordingError(home, f"{one}_* and {other}_* are the same recording: remove one of them")
    return [_source(dialect, home, name, roots) for name in ordered]


def _source(dialect: str, home: Path, name: str, roots: Sequence[Path]) -> RecordingSource:
    tracks, tracks_meta = home / f"{name}_tracks.csv", home / f"{name}_tracksMeta.csv"
    recording_meta = home / f"{name}_recordingMeta.csv"
    if not recording_meta.is_file() and (home / f"{name}_recordingsMeta.csv").is_file():
        recording_meta = home / f"{name}_recordingsMeta.csv"
    for file in (tracks, tracks_meta, recording_meta):
        if not file.is_file():
            raise RecordingError(
                file, f"there is no such file, but others of recording {name} are there: copy it as well"
            )
    setting = _setting(DIALECTS[dialect], recording_meta)
    osm = None
    if DIALECTS[dialect].lanes == LANELET2:
        osm = _map_of(setting.location, roots, recording_meta, DIALECTS[dialect].map_needed)
    files = _Files(tracks, tracks_meta, recording_meta, osm)
    group = str(setting.location) if DIALECTS[dialect].by_location else name
    present = tuple(file for file in files if file is not None)
    return RecordingSource(name, group, present, partial(_read_recording, dialect, name, group, setting, files))


def _map_of(location: int, roots: Sequence[Path], path: Path, needed: bool) -> Path | None:
    """Path of a location's map: ``0_cologne_butzweiler/location0.osm``, or a flat ``0_cologne_butzweiler.osm``.

    None if there is none and none is needed.
    """
    begins = re.compile(rf"(?:location)?0*{location}(?!\d)", re.ASCII)
    for root in roots:
        here = sorted(file for file in root.glob("*") if begins.match(file.name))
        inside = [file for place in here if place.is_dir() for file in sorted(place.glob("*.osm"))]
        found = [file for file in here if file.suffix == ".osm" and file.is_file()] + inside
        named = [file for file in found if file.name == f"location{location}.osm"]
        if len(found) == 1 or len(named) == 1:
            return (named or found)[0]
        if found:
            names = ", ".join(str(file.relative_to(root)) for file in found)
            raise RecordingError(root, f"there are several maps of location {location} ({names}): keep one of them")
    if not needed:
        return None
    raise RecordingError(
        path,
        f"there is no map of its locationId {location}: maps/lanelet2/{location}_*/location{location}.osm or "
        f"maps/lanelet2/{location}*.osm was expected under {roots[0].parent.parent}",
    )


def _setting(dialect: Dialect, path: Path) -> _Setting:
    required = ["recordingId", "locationId", "frameRate"]
    types: Types = {**RECORDING_META}
    if dialect.lanes == MARKINGS:
        required += MARKING_COLUMNS
        types = {name: types[name] for name in (*required[:3], "speedLimit", "duration")}
        types |= dict.fromkeys(MARKING_COLUMNS, FLOATS)
        types = {"id" if name == "recordingId" else name: type for name, type in types.items()}
        required[0] = "id"
    else:
        required += ["xUtmOrigin", "yUtmOrigin"]
    always = {*required, "speedLimit"} if dialect.limit_needed else set(required)
    table = read_table(path, types, required, optional=set(types) - always)
    if len(table) != 1:
        raise RecordingError(path, f"there are {len(table)} rows in it; one was expected: a recording has one setting")
    row = table.row(0, named=True)
    for name in required:
        if isinstance(row[name], float) and not np.isfinite(row[name]):
            raise RecordingError(path, f"{name} is {row[name]}; a finite number was expected", row=2)
    if row["locationId"] < 0:
        raise RecordingError(path, f"locationId is {row['locationId']}; it was expected to be 0 or more", row=2)
    limit = row.get("speedLimit")
    if limit is not None and not 0 < limit <= FASTEST / 2:
        raise RecordingError(
            path, f"speedLimit is {limit}; metres per second or -1 were expected: is it in km/h?", row=2
        )
    upper, lower = (tuple(row.get(name) or ()) for name in MARKING_COLUMNS)
    return _Setting(
        recording=row[required[0]],
        location=row["locationId"],
        rate=row["frameRate"],
        speed_limit=np.nan if limit is None else limit,
        duration=np.inf if row.get("duration") is None else row["duration"],
        origin=(row.get("xUtmOrigin", 0.0), row.get("yUtmOrigin", 0.0)),
        markings=(upper, lower),
    )


def _read_recording(name_of_dialect: str, name: str, group: str, setting: _Setting, files: _Files) -> Recording:
    dialect, dropped = DIALECTS[name_of_dialect], Counter[str]()
    tracks = _tracks(dialect, setting, files, dropped)
    _check_motion(tracks, setting, files)
    lanes = _lanes(dialect, setting, files, tracks, dropped)
    return Recording(name, group, tracks, lanes, dict(dropped))


def _lanes(
    dialect: Dialect, setting: _Setting, files: _Files, tracks: TrackTable, dropped: Counter[str]
) -> LaneGraph | None:
    if dialect.lanes == MARKINGS:
        reach = float(tracks.position[:, 0].min()), float(tracks.position[:, 0].max())
        lanes = highd_lanes(*setting.markings, reach, setting.speed_limit, files.recording_meta)
    elif files.map is None:
        return None
    else:
        lanes = lanelet2.read_map(files.map, setting.origin, zone=ZONE, dropped=dropped)
    _check_fit(tracks, lanes, files)
    return replace(lanes, speed_limit=np.full(len(lanes), setting.speed_limit))


def _tracks(dialect: Dialect, setting: _Setting, files: _Files, dropped: Counter[str]) -> TrackTable:
    rows = _renamed(dialect, files.tracks, {column: TRACKS[column] for column in _used(dialect)})
    meta = _renamed(
        dialect, files.tracks_meta, {**TRACKS_META, **({"drivingDirection": INT} if dialect.directed else {})}
    )
    for path, table in ((files.tracks, rows), (files.tracks_meta, meta)):
        if "recordingId" in table.columns:
            raise_first(
                path,
                table["recordingId"].to_numpy() != setting.recording,
                f"recordingId is not {setting.recording} as in {files.recording_meta.name}: files of several "
                "recordings were mixed up: copy the recording's files again",
            )
    id_column = dialect.column("trackId")
    meta = meta.sort("trackId")
    ids, frame = meta["trackId"].to_numpy(), rows["frame"].to_numpy()
    if (twice := ids[1:][np.diff(ids) == 0]).size:
        raise RecordingError(files.tracks_meta, f"{id_column} {twice[0]} has two rows: an id must belong to one track")
    track = rows["trackId"].to_numpy()
    agent = np.clip(np.searchsorted(ids, track), 0, len(ids) - 1)
    raise_first(
        files.tracks,
        ids[agent] != track,
        lambda row: f"{id_column} {track[row]} is not in {files.tracks_meta.name}: copy both files again",
    )
    if len(unseen := np.setdiff1d(np.arange(len(ids)), agent)):
        raise RecordingError(
            files.tracks,
            f"{id_column} {ids[unseen[0]]} of {files.tracks_meta.name} is not in it ({len(unseen)} of {len(ids)} are not): "
            "was the file cut off? Copy it again",
        )
    raise_first(
        files.tracks, (frame < 0) | (frame > LATEST), lambda row: f"frame {frame[row]} was expected in 0 .. {LATEST}"
    )
    if "heading" in rows.columns:
        heading = rows["heading"].to_numpy()
        raise_first(
            files.tracks,
            ~(np.abs(heading) <= 360.0),
            lambda row: f"heading is {heading[row]}; degrees from 0 to 360 were expected",
        )
    unknown: Counter[str] = Counter()
    kind = kinds_of(meta["class"], unknown, dialect.kinds)
    size = completed_sizes(meta.select("length", "width").to_numpy(), kind, dropped, of=dialect.sizeless)
    dropped.update(unknown)
    order = np.argsort(agent, kind="stable")
    rows, agent = rows[order], agent[order]
    position = rows.select("xCenter", "yCenter").to_numpy()
    velocity = rows.select("xVelocity", "yVelocity").to_numpy()
    if dialect.corner:
        position = position + 0.5 * size[agent]
    if dialect.y_down:
        position, velocity = position * (1, -1), velocity * (1, -1)
    if dialect.directed:
        heading = _directed(meta["drivingDirection"].to_numpy()[agent], velocity, ids[agent], files.tracks_meta)
    else:
        heading = np.deg2rad(rows["heading"].to_numpy())
    tracks = TrackTable(
        rate=setting.rate,
        agent=agent,
        frame=rows["frame"].to_numpy(),
        position=position,
        heading=unwrapped(heading, np.flatnonzero(np.diff(agent, prepend=-1))),
        velocity=velocity,
        ids=ids,
        size=size,
        kind=kind,
    ).check(files.tracks, sizes=files.tracks_meta)
    _check_frames(tracks, meta, files, dropped)
    return tracks


def _used(dialect: Dialect) -> list[str]:
    """The columns of a tracks file that are read, by their names in exiD."""
    return [column for column in USED if dialect.column(column)]


def _renamed(dialect: Dialect, path: Path, types: Types) -> pl.DataFrame:
    """The columns of a file that its data set has, under their names in exiD; all values are required."""
    columns = {name: dialect.column(name) for name in types}
    read = {column: types[name] for name, column in columns.items() if column}
    table = read_table(path, read, tuple(read))
    return table.select(pl.col(column).alias(name) for name, column in columns.items() if column)


def _directed(
    direction: Int[np.ndarray, " T"], velocity: Float[np.ndarray, "T 2"], id: Int[np.ndarray, " T"], path: Path
) -> Float[np.ndarray, " T"]:
    """Headings of vehicles that are recorded without: along the road, and turned by the angle of their velocity.

    Below SLOWEST the angle is that of the lateral velocity at SLOWEST, because the direction of a small velocity is noise.
    """
    along = np.where(direction == 2, 1.0, -1.0)
    ahead, left = along * velocity[:, 0], along * velocity[:, 1]
    for wrong, problem in (
        (~np.isin(direction, (1, 2)), "1 (towards smaller x) or 2 (towards larger x) was expected"),
        (ahead < -SLOWEST, "it drives the other way: was 1 (towards smaller x) confused with 2 (towards larger x)?"),
    ):
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise RecordingError(path, f"drivingDirection of vehicle {id[row]} is {direction[row]}; {problem}")
    heading: Float[np.ndarray, " T"] = np.where(direction == 2, 0.0, np.pi) + np.arctan2(
        left, np.maximum(ahead, SLOWEST)
    )
    return heading


def _check_frames(table: TrackTable, meta: pl.DataFrame, files: _Files, dropped: Counter[str]) -> None:
    """Check that each track has the frames stated in its metadata; frames missing in between are counted."""
    first = np.flatnonzero(np.diff(table.agent, prepend=-1))
    last = np.append(first[1:], len(table)) - 1
    count = last - first + 1
    initial, final, number = (meta[name].to_numpy() for name in ("initialFrame", "finalFrame", "numFrames"))
    span = table.frame[last] - table.frame[first] + 1
    wrong = (table.frame[first] != initial) | (table.frame[last] != final) | ((number != count) & (number != span))
    if wrong.any():
        agent = int(np.flatnonzero(wrong)[0])
        raise RecordingError(
            files.tracks,
            f"track {table.ids[agent]} has {count[agent]} frames from {table.frame[first[agent]]} to "
            f"{table.frame[last[agent]]}, but {files.tracks_meta.name} promises {number[agent]} from {initial[agent]} to "
            f"{final[agent]}: was the file cut off? Copy both files again",
        )
    if gaps := int((span - count).sum()):
        dropped["frames missing inside tracks"] = gaps


def _check_motion(table: TrackTable, setting: _Setting, files: _Files) -> None:
    """Check that frames, positions, velocities and headings are consistent in rate and unit."""
    if table.frame.max() > 1.05 * setting.duration * setting.rate + setting.rate:
        raise RecordingError(
            files.tracks,
            f"frame {table.frame.max()} lies after the duration of {setting.duration} s at the frameRate of "
            f"{setting.rate} Hz in {files.recording_meta.name}: is one of them wrong?",
        )
    check_motion(
        table,
        files.tracks,
        "xVelocity and yVelocity",
        f"the frameRate of {setting.rate:g} Hz in {files.recording_meta.name}",
    )


def _check_fit(table: TrackTable, lanes: LaneGraph, files: _Files) -> None:
    """Check that most positions are near a lane."""
    position = table.position[:: -(-len(table) // SAMPLE)]
    lines = [shapely.LineString(line) for line in (*lanes.left, *lanes.centre, *lanes.right)]
    near, _ = shapely.STRtree(lines).query(shapely.points(position), predicate="dwithin", distance=FAR)
    off = 1.0 - len(np.unique(near)) / len(position)
    if off > 0.5:
        raise RecordingError(
            files.map or files.recording_meta,
            f"{off:.0%} of the positions of {files.tracks.name} are more than {FAR:g} m from all of its lanes: the map or "
            f"xUtmOrigin, yUtmOrigin of {files.recording_meta.name} do not belong to the recording",
        )
