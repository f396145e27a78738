"""Reader of exiD recordings (Moers et al., "The exiD Dataset", IV 2022), versions 2.0 and 2.1.

A data set is a folder with ``data/NN_tracks.csv``, ``NN_tracksMeta.csv`` and ``NN_recordingMeta.csv`` for each recording,
and with a Lanelet2 map for each location under ``maps/lanelet2``. Lengths are in metres, times in seconds, angles in
degrees; x points east and y north from an origin in UTM zone 32.
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

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats import lanelet2
from epo_lightning.data.recorded.formats.exid_tables import (
    RECORDING_META,
    TRACKS,
    TRACKS_META,
    USED,
    raise_first,
    read_table,
)
from epo_lightning.data.recorded.formats.motion import check_motion, unwrapped
from epo_lightning.data.recorded.kinds import completed_sizes, kinds_of
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.tracks import FASTEST, Recording, RecordingSource, TrackTable
from epo_lightning.registry import register

SIZELESS = ("motorcycle", "bicycle", "pedestrian")
"""Kinds of agents whose size may not be annotated (0, 0)."""
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
    folder = Path(folder)
    home = folder / "data" if (folder / "data").is_dir() else folder
    if not home.is_dir():
        raise RecordingError(
            folder, "there is no such folder: unzip exiD there, or name the folder with its data/ and maps/"
        )
    names = {
        match[1]
        for file in home.iterdir()
        if (match := re.fullmatch(r"(\d+)_(?:tracks|tracksMeta|recordings?Meta)\.csv", file.name, re.ASCII))
    }
    if not names:
        raise RecordingError(home, "there is no recording in it: files called NN_tracks.csv were expected")
    roots = [folder / "maps" / "lanelet2", home]
    if folder.name == "data":
        roots.append(folder.parent / "maps" / "lanelet2")
    ordered = sorted(names, key=lambda name: (int(name), name))
    for one, other in pairwise(ordered):
        if int(one) == int(other):
            raise RecordingError(home, f"{one}_* and {other}_* are the same recording: remove one of them")
    return [_source(home, name, roots) for name in ordered]


class _Files(NamedTuple):
    """The files of a recording."""

    tracks: Path
    tracks_meta: Path
    recording_meta: Path
    map: Path


class _Setting(NamedTuple):
    """The metadata of a whole recording."""

    recording: int
    location: int
    rate: float
    speed_limit: float
    duration: float
    origin: tuple[float, float]


def _source(home: Path, name: str, roots: Sequence[Path]) -> RecordingSource:
    tracks, tracks_meta = home / f"{name}_tracks.csv", home / f"{name}_tracksMeta.csv"
    recording_meta = home / f"{name}_recordingMeta.csv"
    if not recording_meta.is_file() and (home / f"{name}_recordingsMeta.csv").is_file():
        recording_meta = home / f"{name}_recordingsMeta.csv"
    for file in (tracks, tracks_meta, recording_meta):
        if not file.is_file():
            raise RecordingError(
                file, f"there is no such file, but others of recording {name} are there: copy it as well"
            )
    setting = _setting(recording_meta)
    files = _Files(tracks, tracks_meta, recording_meta, _map_of(setting.location, roots, recording_meta))
    return RecordingSource(name, str(setting.location), tuple(files), partial(_read_recording, name, setting, files))


def _map_of(location: int, roots: Sequence[Path], path: Path) -> Path:
    """Path of a location's map: ``0_cologne_butzweiler/location0.osm``, or a flat ``0_cologne_butzweiler.osm``."""
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
    raise RecordingError(
        path,
        f"there is no map of its locationId {location}: maps/lanelet2/{location}_*/location{location}.osm or "
        f"maps/lanelet2/{location}*.osm was expected under {roots[0].parent.parent}",
    )


def _setting(path: Path) -> _Setting:
    required = ("recordingId", "locationId", "frameRate", "xUtmOrigin", "yUtmOrigin")
    table = read_table(path, RECORDING_META, required, optional=set(RECORDING_META) - set(required) - {"speedLimit"})
    if len(table) != 1:
        raise RecordingError(path, f"there are {len(table)} rows in it; one was expected: a recording has one setting")
    row = table.row(0, named=True)
    for name in ("frameRate", "xUtmOrigin", "yUtmOrigin"):
        if not np.isfinite(row[name]):
            raise RecordingError(path, f"{name} is {row[name]}; a finite number was expected", row=2)
    if row["locationId"] < 0:
        raise RecordingError(path, f"locationId is {row['locationId']}; it was expected to be 0 or more", row=2)
    limit = row["speedLimit"]
    if limit is not None and not 0 < limit <= FASTEST / 2:
        raise RecordingError(
            path, f"speedLimit is {limit}; metres per second or -1 were expected: is it in km/h?", row=2
        )
    return _Setting(
        recording=row["recordingId"],
        location=row["locationId"],
        rate=row["frameRate"],
        speed_limit=np.nan if limit is None else limit,
        duration=np.inf if row.get("duration") is None else row["duration"],
        origin=(row["xUtmOrigin"], row["yUtmOrigin"]),
    )


def _read_recording(name: str, setting: _Setting, files: _Files) -> Recording:
    dropped: Counter[str] = Counter()
    tracks = _tracks(setting, files, dropped)
    _check_motion(tracks, setting, files)
    lanes = lanelet2.read_map(files.map, setting.origin, zone=ZONE, dropped=dropped)
    _check_fit(tracks, lanes, files)
    lanes = replace(lanes, speed_limit=np.full(len(lanes), setting.speed_limit))
    return Recording(name, str(setting.location), tracks, lanes, dict(dropped))


def _tracks(setting: _Setting, files: _Files, dropped: Counter[str]) -> TrackTable:
    rows = read_table(files.tracks, {column: TRACKS[column] for column in USED}, USED)
    meta = read_table(files.tracks_meta, TRACKS_META, tuple(TRACKS_META))
    for path, recording in ((files.tracks, rows["recordingId"]), (files.tracks_meta, meta["recordingId"])):
        raise_first(
            path,
            recording.to_numpy() != setting.recording,
            f"recordingId is not {setting.recording} as in {files.recording_meta.name}: files of several "
            "recordings were mixed up: copy the recording's files again",
        )
    meta = meta.sort("trackId")
    ids, frame, heading = meta["trackId"].to_numpy(), rows["frame"].to_numpy(), rows["heading"].to_numpy()
    if (twice := ids[1:][np.diff(ids) == 0]).size:
        raise RecordingError(files.tracks_meta, f"trackId {twice[0]} has two rows: an id must belong to one track")
    track = rows["trackId"].to_numpy()
    agent = np.clip(np.searchsorted(ids, track), 0, len(ids) - 1)
    raise_first(
        files.tracks,
        ids[agent] != track,
        lambda row: f"trackId {track[row]} is not in {files.tracks_meta.name}: copy both files again",
    )
    if len(unseen := np.setdiff1d(np.arange(len(ids)), agent)):
        raise RecordingError(
            files.tracks,
            f"trackId {ids[unseen[0]]} of {files.tracks_meta.name} is not in it ({len(unseen)} of {len(ids)} are not): was "
            "the file cut off? Copy it again",
        )
    raise_first(
        files.tracks, (frame < 0) | (frame > LATEST), lambda row: f"frame {frame[row]} was expected in 0 .. {LATEST}"
    )
    raise_first(
        files.tracks,
        ~(np.abs(heading) <= 360.0),
        lambda row: f"heading is {heading[row]}; degrees from 0 to 360 were expected",
    )
    unknown: Counter[str] = Counter()
    kind = kinds_of(meta["class"], unknown)
    size = completed_sizes(meta.select("length", "width").to_numpy(), kind, dropped, of=SIZELESS)
    dropped.update(unknown)
    order = np.argsort(agent, kind="stable")
    rows, agent = rows[order], agent[order]
    tracks = TrackTable(
        rate=setting.rate,
        agent=agent,
        frame=rows["frame"].to_numpy(),
        position=rows.select("xCenter", "yCenter").to_numpy(),
        heading=unwrapped(np.deg2rad(rows["heading"].to_numpy()), agent),
        velocity=rows.select("xVelocity", "yVelocity").to_numpy(),
        ids=ids,
        size=size,
        kind=kind,
    ).check(files.tracks)
    _check_frames(tracks, meta, files, dropped)
    return tracks


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
            files.map,
            f"{off:.0%} of the positions of {files.tracks.name} are more than {FAR:g} m from all of its lanes: the map or "
            f"xUtmOrigin, yUtmOrigin of {files.recording_meta.name} do not belong to the recording",
        )
