"""Tables of exiD recordings: the columns of the three CSV files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import polars as pl

from epo_lightning.data.recorded.formats import tables
from epo_lightning.data.recorded.formats.tables import FLAG, FLOAT, FLOATS, INT, INTS, TEXT, Types

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
"""Columns of a tracks file. Lists, separated by semicolons, are over an agent's lanelets or the vehicles beside it."""
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
"""Columns that some copies of the data set lack."""
MISSING = (
    dict.fromkeys(("leadDHW", "leadTHW", "leadTTC", "leadId", "rearId", "leftLeadId", "leftRearId"), -1)
    | dict.fromkeys(("rightLeadId", "rightRearId", "leftAlongsideId", "rightAlongsideId", "laneletId"), -1)
    | dict.fromkeys(("laneWidth", "lonLaneletPos", "laneletLength", "odrRoadId", "odrSectionNo"), -1)
    | {"leadDV": -1000, "speedLimit": -1}
)
"""Numbers that mean a missing value, by column. For columns in which -1 is a valid value see TOLD_BY."""
TOLD_BY = {"latLaneCenterOffset": "laneletId", "odrLaneId": "odrRoadId"}
"""Columns in which -1 is a valid value (a lane offset of -1 m): they are missing where the other column is missing."""

USED = ("recordingId", "trackId", "frame", "xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
"""Columns of a tracks file that a :class:`TrackTable` is made of."""


def read_table(
    path: Path, types: Types, required: Iterable[str], optional: Iterable[str] = frozenset(OPTIONAL)
) -> pl.DataFrame:
    """Columns of a file of exiD by name and type, as :func:`~epo_lightning.data.recorded.formats.tables.read_table`."""
    return tables.read_table(path, types, required, optional, MISSING, TOLD_BY)


def read_tracks(path: Path) -> pl.DataFrame:
    """All columns of a tracks file in the types of :data:`TRACKS`, in that order; missing values are null.

    Raises:
        RecordingError: there is no such file, a column is missing or repeated, a row is cut off, or a text is not a number.
    """
    return read_table(path, TRACKS, USED)


def read_tracks_meta(path: Path) -> pl.DataFrame:
    """All columns of a tracksMeta file, as :func:`read_tracks`."""
    return read_table(path, TRACKS_META, tuple(TRACKS_META))


def read_recording_meta(path: Path) -> pl.DataFrame:
    """All columns of a recordingMeta file, as :func:`read_tracks`."""
    return read_table(path, RECORDING_META, ("recordingId", "locationId", "frameRate", "xUtmOrigin", "yUtmOrigin"))
