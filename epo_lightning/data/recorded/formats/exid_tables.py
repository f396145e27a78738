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
