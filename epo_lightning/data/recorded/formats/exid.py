"""exiD recordings (Moers et al., "The exiD Dataset", IV 2022), as its versions 2.0 and 2.1 lay them out.

A data set is a folder with ``data/NN_tracks.csv``, ``NN_tracksMeta.csv`` and ``NN_recordingMeta.csv`` for each recording,
and with a Lanelet2 map for each location under ``maps/lanelet2``. Lengths are in metres, times in seconds, angles in
degrees; x points east and y north from an origin in UTM zone 32.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
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
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.tracks import FASTEST, Recording, RecordingSource, TrackTable
from epo_lightning.registry import register
from epo_lightning.scene import KINDS

Types = Mapping[str, pl.DataType]

INT, FLOAT, FLAG, TEXT = pl.Int64(), pl.Float64(), pl.Boolean(), pl.String()
INTS, FLOATS = pl.List(INT), pl.List(FLOAT)

TRACKS: Types = (
    dict.fromkeys(("recordingId", "trackId", "frame", "trackLifetime"), INT)
    | dict.fromkeys(("xCenter", "yCenter", "heading", "width", "length"), FLOAT)
    | dict.fromkeys(("xVelocity", "yVelocity", "xAcceleration", "yAcceleration"), FLOAT)
    | dict.fromkeys(("lonVelocity", "latVelocity", "lonAcceleration", "latAcceleration", "traveledDistance"), FLOAT)
    | {"latLaneCenterOffset": FLOATS, "laneWidth": FLOATS, "laneletId": INTS, "laneChange": FLAG}
    | {"lonLaneletPos": FLOATS, "laneletLength": FLOATS}
    | dict.fromkeys(("leadDHW", "leadDV", "leadTHW", "leadTTC"), FLOAT)
    | {"leadId": INT, "rearId": INT, "leftLeadId": INT, "leftRearId": INT, "leftAlongsideId": INTS}
    | {"rightLeadId": INT, "rightRearId": INT, "rightAlongsideId": INTS}
    | dict.fromkeys(("odrRoadId", "odrSectionNo", "odrLaneId"), INT)
)
"""Columns of a tracks file; lists, separated by semicolons, run over an agent's lanelets or the vehicles beside it."""
TRACKS_META: Types = dict.fromkeys(("recordingId", "trackId", "initialFrame", "finalFrame", "numFrames"), INT) | {
    "width": FLOAT,
    "length": FLOAT,
    "class": TEXT,
}
RECORDING_META: Types = (
    {"recordingId": INT, "locationId": INT, "frameRate": FLOAT, "speedLimit": FLOAT, "weekday": TEXT, "startTime": TEXT}
    | {"duration": FLOAT, "numTracks": INT, "numVehicles": INT, "numVrus": INT, "latLocation": FLOAT}
    | {"lonLocation": FLOAT, "xUtmOrigin": FLOAT, "yUtmOrigin": FLOAT, "orthoPxToMeter": FLOAT, "exportVersion": TEXT}
)
OPTIONAL = {"odrRoadId", "odrSectionNo", "odrLaneId", "exportVersion"}
"""Columns that some copies lack."""
MISSING = (
    dict.fromkeys(("leadDHW", "leadTHW", "leadTTC", "leadId", "rearId", "leftLeadId", "leftRearId"), -1)
    | dict.fromkeys(("rightLeadId", "rightRearId", "leftAlongsideId", "rightAlongsideId", "laneletId"), -1)
    | dict.fromkeys(("laneWidth", "lonLaneletPos", "laneletLength", "odrRoadId", "odrSectionNo"), -1)
    | {"leadDV": -1000, "speedLimit": -1}
)
"""The number that stands for a missing value; where there is none, as for a lane offset of -1 m, another column tells."""
TOLD_BY = {"latLaneCenterOffset": "laneletId", "odrLaneId": "odrRoadId"}
"""Columns in which -1 is a value, and is missing where the other column is."""

USED = ("recordingId", "trackId", "frame", "xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
"""What a :class:`TrackTable` is made of, beside the metadata."""
TYPICAL = {"motorcycle": (2.2, 0.9), "bicycle": (1.8, 0.7), "pedestrian": (0.5, 0.5)}
"""Length and width [m] of those whose size is not annotated (0, 0)."""
LATEST = 10**9
"""Frames beyond this are no frames."""
ZONE = 32
FAR = 10.0
"""A position farther than this from every line of every lane [m] is not on the map."""
SAMPLE = 5000
"""So many positions tell whether a map fits."""


@register("format", "exid")
def exid(folder: Path) -> list[RecordingSource]:
    """The recordings in a folder of exiD files, or in its folder ``data``.

    Raises:
        RecordingError: no recording, a file of a recording is missing, its metadata is broken, or there is no map for it.
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
    """What a recording is read from."""

    tracks: Path
    tracks_meta: Path
    recording_meta: Path
    map: Path


class _Setting(NamedTuple):
    """What the metadata of a recording say about all of it."""

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
    return RecordingSource(name, str(setting.location), tuple(files), partial(_read, name, setting, files))


def _map_of(location: int, roots: Sequence[Path], path: Path) -> Path:
    """The map of a location: ``0_cologne_butzweiler/location0.osm``, or a flat ``0_cologne_butzweiler.osm``."""
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
    table = _table(path, RECORDING_META, required, optional=set(RECORDING_META) - set(required) - {"speedLimit"})
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


def _read(name: str, setting: _Setting, files: _Files) -> Recording:
    dropped: Counter[str] = Counter()
    tracks = _tracks(setting, files, dropped)
    _check_motion(tracks, setting, files)
    lanes = lanelet2.read_map(files.map, setting.origin, zone=ZONE, dropped=dropped)
    _check_fit(tracks, lanes, files)
    lanes = replace(lanes, speed_limit=np.full(len(lanes), setting.speed_limit))
    return Recording(name, str(setting.location), tracks, lanes, dict(dropped))


def _tracks(setting: _Setting, files: _Files, dropped: Counter[str]) -> TrackTable:
    rows = _table(files.tracks, {column: TRACKS[column] for column in USED}, USED)
    meta = _table(files.tracks_meta, TRACKS_META, tuple(TRACKS_META))
    for path, recording in ((files.tracks, rows["recordingId"]), (files.tracks_meta, meta["recordingId"])):
        _first(
            path,
            recording.to_numpy() != setting.recording,
            f"recordingId is not {setting.recording} as in {files.recording_meta.name}: files of several recordings are "
            "mixed up",
        )
    meta = meta.sort("trackId")
    ids, frame, heading = meta["trackId"].to_numpy(), rows["frame"].to_numpy(), rows["heading"].to_numpy()
    if (twice := ids[1:][np.diff(ids) == 0]).size:
        raise RecordingError(files.tracks_meta, f"trackId {twice[0]} has two rows: an id must belong to one track")
    track = rows["trackId"].to_numpy()
    agent = np.clip(np.searchsorted(ids, track), 0, len(ids) - 1)
    _first(
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
    _first(
        files.tracks, (frame < 0) | (frame > LATEST), lambda row: f"frame {frame[row]} was expected in 0 .. {LATEST}"
    )
    _first(
        files.tracks,
        ~(np.abs(heading) <= 360.0),
        lambda row: f"heading is {heading[row]}; degrees from 0 to 360 were expected",
    )
    order = np.argsort(agent, kind="stable")
    rows, agent = rows[order], agent[order]
    tracks = TrackTable(
        rate=setting.rate,
        agent=agent,
        frame=rows["frame"].to_numpy(),
        position=rows.select("xCenter", "yCenter").to_numpy(),
        heading=_unwrapped(np.deg2rad(rows["heading"].to_numpy()), agent),
        velocity=rows.select("xVelocity", "yVelocity").to_numpy(),
        ids=ids,
        size=_sizes(meta, dropped),
        kind=_kinds(meta, dropped),
    ).check(files.tracks)
    _check_frames(tracks, meta, files, dropped)
    return tracks


def _unwrapped(heading: Float[np.ndarray, " T"], agent: Int[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """The same headings without jumps inside a track; each track begins where it did."""
    step = np.diff(heading, prepend=heading[:1])
    turns = -np.round(step / (2 * np.pi))
    first = np.flatnonzero(np.diff(agent, prepend=-1))
    turns[first] = 0.0
    turns = turns.cumsum()
    return heading + 2 * np.pi * (turns - np.repeat(turns[first], np.diff(np.append(first, len(agent)))))


def _kinds(meta: pl.DataFrame, dropped: Counter[str]) -> Int[np.ndarray, " A"]:
    number = {kind: index for index, kind in enumerate(KINDS)}
    kinds = [number.get(name.strip().lower(), -1) for name in meta["class"]]
    if unknown := kinds.count(-1):
        dropped["agents of a class that is unknown, taken as 'other'"] = unknown
    return np.array([number["other"] if kind < 0 else kind for kind in kinds])


def _sizes(meta: pl.DataFrame, dropped: Counter[str]) -> Float[np.ndarray, "A 2"]:
    size = meta.select("length", "width").to_numpy(writable=True)
    for kind, typical in TYPICAL.items():
        without = (size == 0).all(1) & (meta["class"].str.strip_chars().str.to_lowercase() == kind).to_numpy()
        size[without] = typical
        if without.any():
            dropped[f"{kind}s without a size, taken as {typical[0]} x {typical[1]} m"] = int(without.sum())
    return size


def _check_frames(table: TrackTable, meta: pl.DataFrame, files: _Files, dropped: Counter[str]) -> None:
    """Whether each track has the frames that its metadata promise; frames missing in between are counted."""
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
    """Whether frames, positions, velocities and headings are of one rate and unit."""
    if table.frame.max() > 1.05 * setting.duration * setting.rate + setting.rate:
        raise RecordingError(
            files.tracks,
            f"frame {table.frame.max()} lies after the duration of {setting.duration} s at the frameRate of "
            f"{setting.rate} Hz in {files.recording_meta.name}: is one of them wrong?",
        )
    within = np.flatnonzero(np.diff(table.agent) == 0)
    elapsed = np.diff(table.frame)[within] / setting.rate
    travelled = np.linalg.norm(table.position[within + 1] - table.position[within], axis=1) / elapsed
    speed = np.linalg.norm(table.velocity, axis=1)
    if (jumps := travelled > FASTEST).any():
        row = within[jumps][0]
        raise RecordingError(
            files.tracks,
            f"track {table.ids[table.agent[row]]} jumps from {table.position[row].tolist()} to "
            f"{table.position[row + 1].tolist()} m after its frame {table.frame[row]}: vehicles stay below {FASTEST:g} m/s",
        )
    stated = 0.5 * (speed[within] + speed[within + 1])
    moving = np.maximum(travelled, stated) > 2.0
    ratio = float(np.median(travelled[moving] / np.maximum(stated[moving], 1e-3))) if moving.any() else 1.0
    if not 0.8 < ratio < 1.25:
        raise RecordingError(
            files.tracks,
            f"positions move {ratio:.3g} times as fast as xVelocity and yVelocity say: they were expected in m and m/s, at "
            f"the frameRate of {setting.rate:g} Hz in {files.recording_meta.name}",
        )
    fast = speed > 5.0
    if fast.any():
        course = np.arctan2(table.velocity[fast, 1], table.velocity[fast, 0])
        aside = float(np.median(np.abs((table.heading[fast] - course + np.pi) % (2 * np.pi) - np.pi)))
        if aside > np.pi / 4:
            raise RecordingError(
                files.tracks,
                f"headings differ by {np.rad2deg(aside):.0f} degrees from where agents move: degrees counter-clockwise from "
                "x were expected",
            )


def _check_fit(table: TrackTable, lanes: LaneGraph, files: _Files) -> None:
    """Whether most positions are near a lane."""
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


def read_tracks(path: Path) -> pl.DataFrame:
    """All columns of a tracks file in the types of :data:`TRACKS`, in that order; missing values are null.

    Raises:
        RecordingError: no such file, a missing or repeated column, a row that is cut off, or text that is no number.
    """
    return _table(path, TRACKS, USED)


def read_tracks_meta(path: Path) -> pl.DataFrame:
    """All columns of a tracksMeta file, as :func:`read_tracks`."""
    return _table(path, TRACKS_META, tuple(TRACKS_META))


def read_recording_meta(path: Path) -> pl.DataFrame:
    """All columns of a recordingMeta file, as :func:`read_tracks`."""
    return _table(path, RECORDING_META, ("recordingId", "locationId", "frameRate", "xUtmOrigin", "yUtmOrigin"))


def _table(
    path: Path, types: Types, required: Iterable[str], optional: Iterable[str] = frozenset(OPTIONAL)
) -> pl.DataFrame:
    """Columns of a CSV file, in any order in the file, by name and type.

    Args:
        required: columns whose values must not be missing.
        optional: columns that may be absent.
    """
    try:
        data = path.read_bytes().rstrip(b"\r\n")
    except OSError as error:
        raise RecordingError(path, f"the file cannot be read: {error.strerror}") from error
    header, _, body = data.partition(b"\n")
    names = [name.strip(' \r"') for name in header.decode("utf-8-sig", errors="replace").split(",")]
    if not body:
        raise RecordingError(path, "there are no rows in it: was the file cut off? Copy it again")
    for name in types:
        if names.count(name) > 1:
            raise RecordingError(path, f"there are {names.count(name)} columns called {name}: keep one of them")
        if name not in names and name not in optional:
            close = difflib.get_close_matches(name, set(names) - set(types), n=1)
            raise RecordingError(path, f"there is no column {name}" + (f"; is it {close[0]!r}?" if close else ""))
    _check_fields(path, data, body, len(names))
    present = [name for name in types if name in names]
    flat = {name: types[name] if types[name] in (INT, FLOAT) else TEXT for name in present}
    try:
        table = _parsed(body, names, flat)
    except pl.exceptions.PolarsError as error:
        try:
            table = _parsed(body, names, dict.fromkeys(present, TEXT))
        except pl.exceptions.PolarsError:
            raise RecordingError(path, f"the file is no CSV table ({str(error).splitlines()[0]})") from error
    table = pl.DataFrame([_typed(path, table[name], types[name]) for name in present])
    for name in set(required) & set(present):
        _first(path, table[name].is_null().to_numpy(), f"there is no {name}")
    return table.with_columns(
        pl.when(pl.col(other).is_null()).then(None).otherwise(pl.col(name)).alias(name)
        for name, other in TOLD_BY.items()
        if name in present and other in present
    )


def _check_fields(path: Path, data: bytes, body: bytes, expected: int) -> None:
    """Whether all rows have as many fields as the header."""
    characters = np.frombuffer(data, dtype=np.uint8)
    rows = np.count_nonzero(characters == ord("\n")) + 1
    if np.count_nonzero(characters == ord(",")) == rows * (expected - 1):
        return
    for row, line in enumerate(body.split(b"\n"), start=2):
        if (fields := line.count(b",") + 1) != expected:
            raise RecordingError(
                path, f"{fields} fields where the header has {expected}: was the file cut off? Copy it again", row=row
            )


def _parsed(body: bytes, names: list[str], types: Types) -> pl.DataFrame:
    """Columns of the rows of a CSV file, in these types."""
    # Numbers as a header of our own: unlike the file's, they differ.
    places = {name: str(names.index(name)) for name in types}
    header = ",".join(map(str, range(len(names)))).encode()
    table = pl.read_csv(
        b"\n".join((header, body)),
        columns=list(places.values()),
        schema_overrides={places[name]: type for name, type in types.items()},
        quote_char=None,
    )
    return table.select(pl.col(place).alias(name) for name, place in places.items())


def _typed(path: Path, column: pl.Series, type: pl.DataType) -> pl.Series:
    """A column in its type, with missing values as null."""
    missing = MISSING.get(column.name)
    if column.dtype == TEXT:
        text = column.str.strip_chars('"').replace("", None)
        column = text.str.split(";") if type.is_nested() else text
        column = column.cast(INT, strict=False).cast(type) if type == FLAG else column.cast(type, strict=False)
        broken = column.is_null() & text.is_not_null()
        if type.is_nested():
            broken |= column.list.eval(pl.element().is_null()).list.any().fill_null(False)
        expected = {INT: "a whole number", FLAG: "0 or 1", FLOAT: "a number"}.get(
            type, "numbers separated by semicolons"
        )
        _first(path, broken.to_numpy(), lambda row: f"{column.name} is {text[row]!r}; {expected} was expected")
    if missing is None:
        return column
    alone = column.list.first().set(column.list.len() != 1, None) if type.is_nested() else column
    absent = alone == missing
    return pl.select(pl.when(absent.fill_null(False)).then(None).otherwise(column).alias(column.name)).to_series()


def _first(path: Path, bad: np.ndarray, problem: str | Callable[[int], str]) -> None:
    """Raise the problem with the first bad row of a CSV file; the header is its row 1."""
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise RecordingError(path, problem if isinstance(problem, str) else problem(row), row=row + 2)
