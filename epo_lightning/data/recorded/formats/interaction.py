"""Reader of INTERACTION: recorded track files, and the tables of the multi-agent challenge.

Zhan et al., "INTERACTION Dataset", 2019. Two layouts, both at 10 Hz in metres, radians and m/s, with y up:

- ``<scenario>/vehicle_tracks_NNN.csv`` and ``<scenario>/pedestrian_tracks_NNN.csv``, whole recordings;
- ``<scenario>_train.csv``, ``<scenario>_val.csv`` and ``<scenario>_obs.csv``, many cases of four seconds, with a column
  ``case_id``.

Maps are ``maps/<scenario>.osm``, with latitudes and longitudes projected about latitude and longitude 0, or ``.osm_xy`` in
metres. Pedestrians and cyclists are one class without headings and sizes.
"""

from __future__ import annotations

import re
from collections import Counter
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats import lanelet2
from epo_lightning.data.recorded.formats.motion import check_motion, direction_of_motion
from epo_lightning.data.recorded.formats.tables import FLOAT, TEXT, Types, raise_first, read_table
from epo_lightning.data.recorded.kinds import completed_sizes, kinds_of
from epo_lightning.data.recorded.tracks import Recording, RecordingSource, TrackTable, together, unwrapped
from epo_lightning.registry import register

RATE = 10.0
"""Frames per second [Hz]."""
ZONE, ORIGIN = 31, (166021.4430805405, 0.0)
"""UTM zone of latitude and longitude 0, and the UTM coordinates of that point [m]."""
CASE = 1000
"""Frames from a case of the challenge to the next one: a frame is ``CASE case_id + frame_id``."""
PEDESTRIANS, PER_CASE = 1_000_000, 2_000_000
"""Added to the numbers of ids that begin with P; and ids from a case to the next one."""
MOST_CASES, LATEST = 1_000_000, 10**9
"""Largest number of a case, and largest number of a frame."""
SLOWEST = 0.3
"""Speed [m/s] up to which a pedestrian keeps its heading."""
PRESENT = ("track_id", "frame_id", "timestamp_ms", "agent_type", "x", "y", "vx", "vy")
SHAPE = ("psi_rad", "length", "width")
"""Columns that every row has, and those that only vehicles have."""
CLASSES = {"pedestrian/bicycle": "pedestrian"}
COLUMNS: Types = (
    dict.fromkeys(("case_id", "track_id", "agent_type"), TEXT)
    | dict.fromkeys(("frame_id", "timestamp_ms"), FLOAT)
    | dict.fromkeys(("x", "y", "vx", "vy", *SHAPE), FLOAT)
)


class _Files(NamedTuple):
    """Tables of a recording, and the map of its scenario if there is one."""

    tables: tuple[Path, ...]
    map: Path | None


@register("format", "interaction")
def interaction(folder: Path) -> list[RecordingSource]:
    """All recordings and tables of the challenge in a folder or below it. Their group is the scenario (the place).

    Raises:
        RecordingError: there is none, two have the same name, or a scenario has several maps.
    """
    folder = Path(folder)
    tables: dict[str, list[Path]] = {}
    scenario: dict[str, str] = {}
    for path in sorted(folder.rglob("*.csv")):
        if match := re.fullmatch(r"(vehicle|pedestrian)_tracks_(\d+)\.csv", path.name, re.ASCII):
            place, name, most = path.parent.name, f"{path.parent.name}_{match[2]}", 2
        elif match := re.fullmatch(r"(\w+)_(?:train|val|obs)\.csv", path.name):
            place, name, most = match[1], path.stem, 1
        else:
            continue
        found = tables.setdefault(name, [])
        scenario[name] = place
        if len(found) == most or any(path.name == other.name for other in found):
            raise RecordingError(path, f"{found[0]} has the same name: rename one of the two, or remove a copy")
        found.append(path)
    if not tables:
        raise RecordingError(
            folder,
            "there is no recording in it or below it: files called <scenario>/vehicle_tracks_NNN.csv or "
            "<scenario>_train.csv were expected",
        )
    maps = {place: _map_of(folder, place) for place in set(scenario.values())}
    return [
        _source(name, scenario[name], _Files(tuple(sorted(found, reverse=True)), maps[scenario[name]]))
        for name, found in sorted(tables.items())
    ]


def _map_of(folder: Path, place: str) -> Path | None:
    """The map of a scenario in the folder or below it, or in the folder ``maps`` beside it; None if there is none."""
    for suffix in (".osm", ".osm_xy"):
        found = sorted(folder.rglob(f"{place}{suffix}")) or sorted(folder.parent.glob(f"maps/{place}{suffix}"))
        if len(found) > 1:
            raise RecordingError(found[1], f"{found[0]} is a map of the same scenario: keep one of them")
        if found:
            return found[0]
    return None


def _source(name: str, place: str, files: _Files) -> RecordingSource:
    present = files.tables if files.map is None else (*files.tables, files.map)
    return RecordingSource(name, place, present, partial(_read_recording, name, place, files))


def _read_recording(name: str, place: str, files: _Files) -> Recording:
    dropped: Counter[str] = Counter()
    parts = [_tracks(table, dropped) for table in files.tables]
    for part in parts[1:]:
        if len(twice := np.intersect1d(parts[0].ids, part.ids)):
            raise RecordingError(
                files.tables[1], f"track {twice[0]} is in {files.tables[0].name} too: give it another id"
            )
    tracks = together(parts)
    check_motion(
        tracks, " and ".join(map(str, files.tables)), "vx and vy", f"{RATE:g} frames per second", unit="radians"
    )
    lanes = None
    if files.map is not None:
        lanes = lanelet2.read_map(files.map, ORIGIN, zone=ZONE, dropped=dropped, north=True)
    return Recording(name, place, tracks, lanes, dict(dropped))


def _tracks(path: Path, dropped: Counter[str]) -> TrackTable:
    """The tracks of one table, checked by themselves, so that errors name the table."""
    rows = _rows(path).sort("id", "frame")
    ids, first, agent = np.unique(rows["id"].to_numpy(), return_index=True, return_inverse=True)
    kind = kinds_of(rows["agent_type"].gather(first), dropped, CLASSES)
    size = completed_sizes(
        rows.select("length", "width").to_numpy()[first], kind, dropped, of=("pedestrian", "bicycle")
    )
    velocity, heading = rows.select("vx", "vy").to_numpy(), rows["psi_rad"].to_numpy().copy()
    without = np.isnan(heading)
    heading[without] = direction_of_motion(
        np.unique(agent[without], return_inverse=True)[1], velocity[without], SLOWEST
    )
    return TrackTable(
        rate=RATE,
        agent=agent,
        frame=rows["frame"].to_numpy(),
        position=rows.select("x", "y").to_numpy(),
        heading=unwrapped(heading, np.flatnonzero(np.diff(agent, prepend=-1))),
        velocity=velocity,
        ids=ids,
        size=size,
        kind=kind,
    ).check(path)


def _rows(path: Path) -> pl.DataFrame:
    """The rows of one table, checked: ids and frames are unique over all cases; heading and size are NaN and 0 if absent."""
    table = read_table(path, COLUMNS, PRESENT, optional={"case_id", *SHAPE})
    table = table.with_columns(pl.lit(None, COLUMNS[name]).alias(name) for name in COLUMNS if name not in table.columns)
    table = table.with_columns(pl.col("agent_type").str.strip_chars())
    case = np.zeros(len(table), dtype=int)
    if table["case_id"].null_count() < len(table):
        raise_first(path, table["case_id"].is_null().to_numpy(), "there is no case_id")
        case = _whole(path, table["case_id"], "case_id", r"(\d+)(?:\.0+)?", MOST_CASES)
    track = _whole(path, table["track_id"], "track_id", r"P?(\d+)(?:\.0+)?", PEDESTRIANS)
    track = track + PEDESTRIANS * table["track_id"].str.contains("P", literal=True).to_numpy()
    frame, time = table["frame_id"].to_numpy(), table["timestamp_ms"].to_numpy()
    most = LATEST if not case.any() else CASE - 1
    raise_first(
        path,
        ~((frame >= 0) & (frame <= most) & (frame == np.rint(frame))),
        lambda row: f"frame_id is {frame[row]:g}; a whole number in 0 .. {most} was expected",
    )
    raise_first(
        path,
        ~(np.abs(time - 1000 / RATE * frame) <= 0.5),
        lambda row: (
            f"timestamp_ms is {time[row]:g} in frame {frame[row]:g}; {1000 / RATE * frame[row]:g} was expected: "
            f"frames are {1000 / RATE:g} ms apart"
        ),
    )
    for name in SHAPE:
        raise_first(
            path,
            (
                table[name].is_null() & ~table["agent_type"].is_in(["pedestrian/bicycle", "pedestrian", "bicycle"])
            ).to_numpy(),
            f"there is no {name}; only pedestrians and cyclists may lack it",
        )
    raise_first(
        path,
        ~np.isfinite(table["psi_rad"].fill_null(0.0).to_numpy()),
        lambda row: f"psi_rad is {table['psi_rad'][row]}; a finite number was expected",
    )
    id, moment = (
        pl.Series("id", case * PER_CASE + track),
        pl.Series("frame", case * CASE + frame.astype(int)),
    )
    # Ids of records are not those in the files, so a repetition is named here.
    raise_first(
        path,
        ~pl.DataFrame([id, moment]).to_struct().is_first_distinct().to_numpy(),
        lambda row: (
            f"track {table['track_id'][row].strip()} has frame {frame[row]:g} twice: is its id that of two agents, or a row "
            "repeated?"
        ),
    )
    return table.select(
        id,
        moment,
        "agent_type",
        "x",
        "y",
        "vx",
        "vy",
        pl.col("psi_rad").fill_null(float("nan")),
        pl.col("length").fill_null(0.0),
        pl.col("width").fill_null(0.0),
    )


def _whole(path: Path, column: pl.Series, name: str, pattern: str, below: int) -> np.ndarray:
    """Numbers of ids that are written as 7, 7.0 or P7."""
    text = column.str.strip_chars()
    number = text.str.extract(f"^{pattern}$").cast(pl.Int64, strict=False)
    raise_first(
        path,
        (number.is_null() | (number >= below)).to_numpy(),
        lambda row: f"{name} is {text[row]!r}; a whole number below {below} was expected",
    )
    found: np.ndarray = number.to_numpy()
    return found
