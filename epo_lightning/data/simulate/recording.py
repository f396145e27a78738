"""Writer of recordings in exiD's format: tracks with all derived columns of v2.1, track metadata and recording metadata.

Derived columns come from the simulation, not from the map: the lane of the centre, its offset from the middle of that lane,
the vehicle ahead. ``leadDHW`` is the free distance along the lane from front to rear bumper, ``leadTHW`` that
distance by the own speed, ``leadDV`` the own speed minus the leader's, ``leadTTC`` the distance by ``leadDV`` where it is
positive. A vehicle on a neighbouring lane is ahead, behind or alongside if it is completely ahead, completely behind or
neither. The three columns of OpenDRIVE ids that some copies of exiD have are absent, as there is no such map.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
from jaxtyping import Float, Int
from pyproj import Transformer

from epo_lightning.data import cache
from epo_lightning.data.simulate.lanelets import lanelets
from epo_lightning.data.simulate.layout import Layout
from epo_lightning.data.simulate.motion import Motion

NONE = -1
FAR = 1e5
"""Upper bound of positions along a road [m]."""
MOST_ALONGSIDE = 4


def lane_changes(motion: Motion) -> Int[np.ndarray, " T"]:
    """Indicator [T], 1 in the first frame in which a vehicle's centre is on another lane than before."""
    changed = np.diff(motion.strip, prepend=motion.strip[:1]) != 0
    return (changed & (np.diff(motion.vehicle, prepend=-1) == 0)).astype(np.int64)


def _piecewise(strip: Int[np.ndarray, " T"], values: list[Float[np.ndarray, " T"]]) -> Float[np.ndarray, " T"]:
    return np.select([strip == index for index in range(len(values))], values)


def tracks(motion: Motion, layout: Layout, number: int) -> pl.DataFrame:
    """The table of tracks of recording ``number``."""
    lanes = layout.lanes
    count = np.bincount(motion.vehicle)
    starts = np.repeat(np.cumsum(count) - count, count)
    length, width = motion.size[motion.vehicle].T
    cosine, sine = np.cos(motion.heading), np.sin(motion.heading)

    def ahead_and_aside(vector: Float[np.ndarray, "T 2"]) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
        return vector[:, 0] * cosine + vector[:, 1] * sine, vector[:, 1] * cosine - vector[:, 0] * sine

    speed, slip = ahead_and_aside(motion.velocity)
    pull, push = ahead_and_aside(motion.acceleration)
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(motion.position, axis=0).T))])

    # Offsets are measured across the lane, not across the reference curve.
    direction = _piecewise(motion.strip, [layout.direction(lane, motion.s) for lane in lanes])
    normal = np.interp(motion.s, *layout.course)
    across = np.cos(direction - normal)
    offset = (motion.d - _piecewise(motion.strip, [layout.offset(lane, motion.s) for lane in lanes])) * across
    lanelet, before, extent = _lanelets(motion, layout)
    around = _neighbours(motion, layout)

    lead = around.pop("leadId")
    has = lead != NONE
    leader = np.where(has, lead, 0)
    along = _piecewise(motion.strip, [layout.along(lane, motion.s) for lane in lanes])
    headway = np.where(has, along[leader] - along - (length + length[leader]) / 2, NONE)
    closing = np.where(has, speed - speed[leader], -1000.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        time_headway = np.where(has & (speed > 0.1), headway / speed, NONE)
        collision = np.where(has & (closing > 0.01), headway / closing, NONE)

    def ids(rows: Int[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
        return np.where(rows == NONE, NONE, motion.vehicle[rows])

    columns: dict[str, np.ndarray | pl.Series] = {
        "recordingId": np.full(len(motion.frame), number),
        "trackId": motion.vehicle,
        "frame": motion.frame,
        "trackLifetime": np.arange(len(motion.frame)) - starts,
        "xCenter": motion.position[:, 0],
        "yCenter": motion.position[:, 1],
        "heading": np.degrees(motion.heading) % 360.0,
        "width": width,
        "length": length,
        "xVelocity": motion.velocity[:, 0],
        "yVelocity": motion.velocity[:, 1],
        "xAcceleration": motion.acceleration[:, 0],
        "yAcceleration": motion.acceleration[:, 1],
        "lonVelocity": speed,
        "latVelocity": slip,
        "lonAcceleration": pull,
        "latAcceleration": push,
        "traveledDistance": travelled - travelled[starts],
        "latLaneCenterOffset": offset,
        "laneWidth": layout.width * across,
        "laneletId": lanelet,
        "laneChange": lane_changes(motion),
        "lonLaneletPos": along - before,
        "laneletLength": extent,
        "leadDHW": headway,
        "leadDV": closing,
        "leadTHW": time_headway,
        "leadTTC": collision,
        "leadId": ids(lead),
        "rearId": ids(around["rearId"]),
        "leftLeadId": ids(around["leftLeadId"]),
        "leftRearId": ids(around["leftRearId"]),
        "leftAlongsideId": _listed(around["leftAlongsideId"], motion),
        "rightLeadId": ids(around["rightLeadId"]),
        "rightRearId": ids(around["rightRearId"]),
        "rightAlongsideId": _listed(around["rightAlongsideId"], motion),
    }
    return pl.DataFrame(
        {
            name: np.round(values, 4) + 0.0 if isinstance(values, np.ndarray) and values.dtype.kind == "f" else values
            for name, values in columns.items()
        }
    )


def _lanelets(
    motion: Motion, layout: Layout
) -> tuple[Int[np.ndarray, " T"], Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
    """Id of each row's lanelet, its start along the strip [m] and its length [m]."""
    ident = np.full(len(motion.s), NONE)
    before, extent = np.zeros(len(motion.s)), np.zeros(len(motion.s))
    for piece in lanelets(layout):
        strip = layout.strips[piece.strip]
        if not strip.shoulder:
            here = (motion.strip == layout.lanes.index(strip)) & (motion.s >= piece.begin) & (motion.s < piece.end)
            begin, end = layout.along(strip, np.array([piece.begin, piece.end]))
            ident[here], before[here], extent[here] = piece.id, begin, end - begin
    return ident, before, extent


def _neighbours(motion: Motion, layout: Layout) -> dict[str, Int[np.ndarray, " ..."]]:
    """Rows of the vehicles around each row's vehicle, -1 for none; up to MOST_ALONGSIDE of them alongside."""
    lanes = layout.lanes
    half = motion.size[motion.vehicle, 0] / 2
    rear, front = motion.s - half, motion.s + half
    group = motion.frame * len(lanes) + motion.strip
    by_rear, by_front = (np.argsort(group * FAR + values, kind="stable") for values in (rear, front))
    rears, fronts = (group * FAR + rear)[by_rear], (group * FAR + front)[by_front]
    rows = np.arange(len(group))

    def ahead(target: np.ndarray, point: np.ndarray) -> Int[np.ndarray, " T"]:
        """Rank, among all rear bumpers, of the first one that is not behind a point of a lane."""
        return np.searchsorted(rears, target * FAR + point)

    def lead_and_rear(target: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first = ahead(target, front)
        found = by_rear[np.minimum(first, len(rows) - 1)]
        lead = np.where(valid & (first < len(rows)) & (group[found] == target), found, NONE)
        last = np.searchsorted(fronts, target * FAR + rear, side="right") - 1
        found = by_front[np.maximum(last, 0)]
        return lead, np.where(valid & (last >= 0) & (group[found] == target), found, NONE)

    around: dict[str, np.ndarray] = {}
    around["leadId"], around["rearId"] = lead_and_rear(group, np.ones(len(rows), dtype=bool))
    for side, step in (("left", 1), ("right", -1)):
        beside = np.full(len(rows), NONE)
        for index, lane in enumerate(lanes):
            for other, neighbour in enumerate(lanes):
                if neighbour.place == lane.place + step:
                    there = (motion.s >= neighbour.begin) & (motion.s <= neighbour.end)
                    together = (motion.s >= max(lane.join, neighbour.join)) & (
                        motion.s <= min(lane.leave, neighbour.leave)
                    )
                    if (lane.join, lane.leave) == (neighbour.join, neighbour.leave):
                        together = np.ones(len(rows), dtype=bool)
                    beside[(motion.strip == index) & there & together] = other
        valid = beside != NONE
        target = motion.frame * len(lanes) + beside
        around[f"{side}LeadId"], around[f"{side}RearId"] = lead_and_rear(target, valid)
        first = ahead(target, front)
        alongside = np.full((len(rows), MOST_ALONGSIDE), NONE)
        for count in range(MOST_ALONGSIDE):
            found = by_rear[np.maximum(first - 1 - count, 0)]
            touching = valid & (first - 1 - count >= 0) & (group[found] == target) & (front[found] > rear)
            alongside[touching, count] = found[touching]
        around[f"{side}AlongsideId"] = alongside
    return around


def _listed(rows: Int[np.ndarray, "T m"], motion: Motion) -> pl.Series:
    """Ids of several vehicles as text, separated by semicolons; empty for none."""
    text = np.where(rows[:, 0] == NONE, "", motion.vehicle[rows[:, 0]].astype(str)).astype(object)
    for row in np.flatnonzero(rows[:, 1] != NONE):
        text[row] = ";".join(str(motion.vehicle[other]) for other in rows[row] if other != NONE)
    return pl.Series(text, dtype=pl.String)


def tracks_meta(motion: Motion, number: int) -> pl.DataFrame:
    """The table of track metadata: class, size and frames of each track."""
    count = np.bincount(motion.vehicle)
    first = motion.frame[np.cumsum(count) - count]
    return pl.DataFrame(
        {
            "recordingId": np.full(len(count), number),
            "trackId": np.arange(len(count)),
            "initialFrame": first,
            "finalFrame": first + count - 1,
            "numFrames": count,
            "width": np.round(motion.size[:, 1], 4),
            "length": np.round(motion.size[:, 0], 4),
            "class": list(motion.kind),
        }
    )


def recording_meta(motion: Motion, layout: Layout, number: int) -> pl.DataFrame:
    """The table of recording metadata, of one row. Simulated days are Wednesdays."""
    longitude, latitude = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(*layout.origin)
    vehicles = len(motion.size)
    return pl.DataFrame(
        {
            "recordingId": [number],
            "locationId": [layout.id],
            "frameRate": [motion.rate],
            "speedLimit": [NONE if layout.limit is None else round(layout.limit, 2)],
            "weekday": ["wednesday"],
            "startTime": ["12:00"],
            "duration": [round(float(motion.frame.max() + 1) / motion.rate, 2)],
            "numTracks": [vehicles],
            "numVehicles": [vehicles],
            "numVrus": [0],
            "latLocation": [round(latitude, 7)],
            "lonLocation": [round(longitude, 7)],
            "xUtmOrigin": [layout.origin[0]],
            "yUtmOrigin": [layout.origin[1]],
            "orthoPxToMeter": [0.1],
            "exportVersion": ["2.1"],
        }
    )


def write(motion: Motion, layout: Layout, number: int, folder: Path) -> list[Path]:
    """Write the three files of recording ``number``, each atomically, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    tables = {
        "tracks": tracks(motion, layout, number),
        "tracksMeta": tracks_meta(motion, number),
        "recordingMeta": recording_meta(motion, layout, number),
    }
    paths = []
    for name, table in tables.items():
        path = folder / f"{number:02d}_{name}.csv"
        cache.write_file(path, table.write_csv(null_value="", quote_style="never").encode())
        paths.append(path)
    return paths
