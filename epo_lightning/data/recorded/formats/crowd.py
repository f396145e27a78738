"""Reader of vehicle-crowd recordings, DUT and CITR: vehicles among pedestrians, without a map.

Yang, Li, Redmill and Özgüner, "Top-view Trajectories: A Pedestrian Dataset of Vehicle-Crowd Interaction from Controlled
Experiments and Crowded Campus", IV 2019. Each clip has two tables that share frame numbers,
``<clip>_traj_ped_filtered.csv`` (id, frame, label, x_est, y_est, vx_est, vy_est) and ``<clip>_traj_veh_filtered.csv``
(id, frame, label, x_est, y_est, psi_est, vel_est), in metres, radians and m/s. The axes are those of the image, y down;
records have y up. Sizes are not recorded.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.motion import check_motion, direction_of_motion
from epo_lightning.data.recorded.formats.tables import FLOAT, INT, TEXT, Types, raise_first, read_table
from epo_lightning.data.recorded.kinds import typical_sizes
from epo_lightning.data.recorded.tracks import Recording, RecordingSource, TrackTable, together, unwrapped
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import KINDS

DUT_RATE = 23.976
"""Frames per second of DUT's videos [Hz]; CITR has 29.97."""
VEHICLES = 1_000_000
"""Added to the ids of vehicles, which are counted separately from those of pedestrians."""
OFFSET = {"ped": 0, "veh": VEHICLES}
"""Added to the ids of a table, by label."""
MOST = {"ped": 1.25, "veh": 2.0}
"""Largest factor between displacements and velocities, in the median, by label: the speeds of cars lag behind."""
LATEST = 10**9
"""Largest frame number."""
SLOWEST = 0.3
"""Speed [m/s] up to which a pedestrian keeps its heading, because the direction of a filtered velocity is noise."""
PEDESTRIAN = (0.3, 0.3)
"""Length and width of a pedestrian in a crowd [m]. With 0.5 m, recorded bodies overlap in 84% of DUT's scenes, because
people walk side by side; with 0.3 m, in 16%."""
FASTEST = 40.0
"""Speed [m/s] that no agent on a campus reaches."""

_COLUMNS: Types = {"id": INT, "frame": INT, "label": TEXT, "x_est": FLOAT, "y_est": FLOAT}
COLUMNS: dict[str, Types] = {
    "ped": {**_COLUMNS, "vx_est": FLOAT, "vy_est": FLOAT},
    "veh": {**_COLUMNS, "psi_est": FLOAT, "vel_est": FLOAT},
}
"""Columns of the table of pedestrians and of that of vehicles, by label."""
NAMES = {"ped": "pedestrians", "veh": "vehicles"}


class _Rows(NamedTuple):
    """Rows of one table in the axes of records: y up, angles counter-clockwise."""

    id: np.ndarray
    frame: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    heading: np.ndarray


@register("format", "crowd")
def crowd(folder: Path, rate: float = DUT_RATE) -> list[RecordingSource]:
    """All clips in a folder or below it. The group of a clip is its place, its name without the number at its end.

    Args:
        rate: frames per second [Hz].

    Raises:
        RecordingError: there is no clip, or two have the same name.
        ConfigError: the frame rate is no positive number.
    """
    folder = Path(folder)
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1.0 <= rate <= 1000.0:
        raise ConfigError(f"data.options.rate must be frames per second, between 1 and 1000, not {rate!r}")
    clips: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.rglob("[!.]*_traj_*_filtered.csv")):
        if match := re.fullmatch(r"(.+)_traj_(ped|veh)_filtered\.csv", path.name):
            tables = clips.setdefault(match[1], {})
            if match[2] in tables:
                raise RecordingError(path, f"{tables[match[2]]} has the same name: rename one of the two")
            tables[match[2]] = path
    if not clips:
        raise RecordingError(
            folder, "there is no clip in it or below it: files called <clip>_traj_ped_filtered.csv were expected"
        )
    return [_source(name, tables, float(rate)) for name, tables in sorted(clips.items())]


def _source(name: str, tables: dict[str, Path], rate: float) -> RecordingSource:
    group = re.sub(r"_\d+$", "", name)
    return RecordingSource(name, group, tuple(tables.values()), partial(_read_recording, name, group, tables, rate))


def _read_recording(name: str, group: str, tables: dict[str, Path], rate: float) -> Recording:
    dropped: Counter[str] = Counter({f"clips without a table of {NAMES[of]}": 1 for of in NAMES if of not in tables})
    # Pedestrians come first, because their ids are below those of vehicles.
    parts = [_numbered(_tracks(tables[label], label, rate), label) for label in NAMES if label in tables]
    return Recording(name, group, together(parts), lanes=None, dropped=dict(dropped))


def _numbered(tracks: TrackTable, label: str) -> TrackTable:
    """The tracks with the ids that they have in a recording."""
    return replace(tracks, ids=tracks.ids + OFFSET[label])


def _tracks(path: Path, label: str, rate: float) -> TrackTable:
    """The tracks of one table, checked by themselves: vehicles are few among pedestrians, and errors name file and id."""
    id, frame, position, velocity, heading = _rows(path, label)
    order = np.lexsort((frame, id))
    ids, agent = np.unique(id[order], return_inverse=True)
    position, velocity, heading = position[order], velocity[order], heading[order]
    kind = np.full(len(ids), KINDS.index("pedestrian" if label == "ped" else "car"))
    size = typical_sizes(kind)
    if label == "ped":
        heading = direction_of_motion(agent, velocity, SLOWEST)
        size[:] = PEDESTRIAN
    tracks = TrackTable(
        rate=rate,
        agent=agent,
        frame=frame[order],
        position=position,
        heading=unwrapped(heading, np.flatnonzero(np.diff(agent, prepend=-1))),
        velocity=velocity,
        ids=ids,
        size=size,
        kind=kind,
    ).check(path, FASTEST)
    check_motion(
        tracks,
        path,
        "vx_est and vy_est" if label == "ped" else "psi_est and vel_est",
        f"{rate:g} frames per second (data.options.rate)",
        0.5,
        2.0,
        "radians",
        most=MOST[label],
    )
    return tracks


def _rows(path: Path, label: str) -> _Rows:
    """The rows of one table, checked."""
    table = read_table(path, COLUMNS[label], tuple(COLUMNS[label]))
    id, frame = table["id"].to_numpy(), table["frame"].to_numpy()
    labels = table["label"].str.strip_chars(' "').to_numpy()
    raise_first(path, labels != label, lambda row: f"label is {labels[row]!r}; {label!r} was expected in this file")
    raise_first(path, (id < 0) | (id >= VEHICLES), lambda row: f"id is {id[row]}; 0 .. {VEHICLES - 1} was expected")
    raise_first(path, (frame < 0) | (frame > LATEST), lambda row: f"frame {frame[row]} was expected in 0 .. {LATEST}")
    for name, type in COLUMNS[label].items():
        if type == FLOAT:
            values = table[name].to_numpy()
            raise_first(
                path,
                ~np.isfinite(values),
                lambda row, name=name, values=values: f"{name} is {values[row]}; a finite number was expected",  # type: ignore[misc]
            )
    position = _y_up(table, "x_est", "y_est")
    if label == "ped":
        # The heading of a pedestrian follows from its velocities when its track is sorted.
        return _Rows(id, frame, position, _y_up(table, "vx_est", "vy_est"), np.zeros(len(id)))
    heading, speed = -table["psi_est"].to_numpy(), table["vel_est"].to_numpy()
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    return _Rows(id, frame, position, velocity, heading)


def _y_up(table: pl.DataFrame, x: str, y: str) -> np.ndarray:
    """Two columns of image axes as a vector [T, 2] with y up."""
    return np.stack([table[x].to_numpy(), -table[y].to_numpy()], 1)
