"""Small highD, inD, rounD and uniD folders in the public format of these data sets, made by code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from data.recorded.formats.exid_files import ORIGIN, Osm, road

RATE = 25.0
UPPER, LOWER = (8.5, 12.4, 16.2), (21.0, 24.9, 28.7, 32.5)
"""Lane markings of a highD recording along y, which points down [m]: two lanes to the left, three to the right."""


def highd_lane(y: float) -> int:
    """highD's id of the lane at a position of the image: lanes and gaps are counted from the upper edge, from 1 on."""
    return 1 + int(np.searchsorted([*UPPER, *LOWER], y))


def highd_tracks(frames: int = 20) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Tracks and tracksMeta: a car and a truck to the left, two cars to the right, of which one changes lane."""
    vehicles = [
        (3, 4.6, 1.9, 1, 300.0, 14.3, -31.0, 0.0),
        (5, 14.5, 2.5, 1, 380.0, 10.5, -24.0, 0.05),
        (8, 4.2, 1.8, 2, 20.0, 26.0, 36.0, -1.9),
        (9, 4.9, 2.0, 2, 90.0, 30.6, 1.5, 0.1),
    ]
    rows, meta = [], []
    for number, (id, length, width, direction, x, y, vx, vy) in enumerate(vehicles):
        for k in range(frames):
            centre = x + vx * k / RATE, y + vy * k / RATE
            rows.append(
                {"frame": 1 + 2 * number + k, "id": id, "x": centre[0] - length / 2, "y": centre[1] - width / 2}
                | {"width": length, "height": width, "xVelocity": vx, "yVelocity": vy}
                | {"xAcceleration": 0.0, "yAcceleration": 0.0, "frontSightDistance": 100.0, "backSightDistance": 50.0}
                | {"dhw": 0.0, "thw": 0.0, "ttc": 0.0, "precedingXVelocity": 0.0, "precedingId": 0, "followingId": 0}
                | {"leftPrecedingId": 0, "leftAlongsideId": 0, "leftFollowingId": 0}
                | {"rightPrecedingId": 0, "rightAlongsideId": 0, "rightFollowingId": 0, "laneId": highd_lane(centre[1])}
            )
        first = 1 + 2 * number
        meta.append(
            {"id": id, "width": length, "height": width, "initialFrame": first, "finalFrame": first + frames - 1}
            | {"numFrames": frames, "class": "Truck" if length > 10 else "Car", "drivingDirection": direction}
            | {"traveledDistance": abs(vx) * frames / RATE, "minXVelocity": abs(vx), "maxXVelocity": abs(vx)}
            | {"meanXVelocity": abs(vx), "minDHW": -1.0, "minTHW": -1.0, "minTTC": -1.0, "numLaneChanges": 0}
        )
    return pl.DataFrame(rows), pl.DataFrame(meta)


def write_highd(folder: Path, number: int = 1, location: int = 2, limit: float = -1.0, frames: int = 20) -> Path:
    """One recording of highD."""
    folder.mkdir(parents=True, exist_ok=True)
    tracks, meta = highd_tracks(frames)
    tracks.write_csv(folder / f"{number:02d}_tracks.csv")
    meta.write_csv(folder / f"{number:02d}_tracksMeta.csv")
    setting = {"id": number, "frameRate": int(RATE), "locationId": location, "speedLimit": limit, "month": "9.2017"}
    setting |= {"weekDay": "Tue", "startTime": "08:38", "duration": frames / RATE + 0.4, "totalDrivenDistance": 100.0}
    setting |= {"totalDrivenTime": 3.2, "numVehicles": 4, "numCars": 3, "numTrucks": 1}
    setting |= {"upperLaneMarkings": ";".join(map(str, UPPER)), "lowerLaneMarkings": ";".join(map(str, LOWER))}
    pl.DataFrame([setting]).write_csv(folder / f"{number:02d}_recordingMeta.csv", quote_style="never")
    return folder


def urban_tracks(recording: int, frames: int = 16) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Tracks and tracksMeta of inD: a car, a truck or bus, a cyclist and two pedestrians without a size."""
    agents = [
        ("car", 4.4, 1.8, 30.0, 5.6, 12.0, 0.0),
        ("truck_bus", 11.8, 2.6, 60.0, 1.9, 9.0, 0.0),
        ("bicycle", 0.0, 0.0, 20.0, -1.5, 4.5, 0.0),
        ("pedestrian", 0.0, 0.0, 40.0, -5.0, 0.0, 1.4),
        ("pedestrian", 0.0, 0.0, 45.0, 12.0, -0.4, -1.2),
    ]
    rows, meta = [], []
    for track, (kind, length, width, x, y, vx, vy) in enumerate(agents):
        heading = float(np.rad2deg(np.arctan2(vy, vx)) % 360)
        first = 3 * track
        rows += [
            {"recordingId": recording, "trackId": track, "frame": first + k, "trackLifetime": k}
            | {"xCenter": x + vx * k / RATE, "yCenter": y + vy * k / RATE + 5e-4 * x**2, "heading": heading}
            | {"width": width, "length": length, "xVelocity": vx, "yVelocity": vy, "xAcceleration": 0.0}
            | {"yAcceleration": 0.0, "lonVelocity": float(np.hypot(vx, vy)), "latVelocity": 0.0}
            | {"lonAcceleration": 0.0, "latAcceleration": 0.0}
            for k in range(frames)
        ]
        meta.append(
            {"recordingId": recording, "trackId": track, "initialFrame": first, "finalFrame": first + frames - 1}
            | {"numFrames": frames, "width": width, "length": length, "class": kind}
        )
    return pl.DataFrame(rows), pl.DataFrame(meta)


def write_urban(
    folder: Path, number: int = 0, location: int = 4, osm: Osm | None = None, maps: str = "maps", frames: int = 16
) -> Path:
    """One recording of inD, rounD or uniD; with ``osm`` also the map of its location, in the folder ``maps``."""
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    tracks, meta = urban_tracks(number, frames)
    tracks.write_csv(data / f"{number:02d}_tracks.csv")
    meta.write_csv(data / f"{number:02d}_tracksMeta.csv")
    setting = {"recordingId": number, "locationId": location, "frameRate": RATE, "speedLimit": 13.9}
    setting |= {
        "weekday": "tuesday",
        "startTime": 9,
        "duration": frames / RATE + 0.8,
        "numTracks": 5,
        "numVehicles": 2,
        "numVRUs": 3,
    }
    setting |= {"latLocation": 50.78, "lonLocation": 6.07, "xUtmOrigin": ORIGIN[0], "yUtmOrigin": ORIGIN[1]}
    pl.DataFrame([setting | {"orthoPxToMeter": 0.008}]).write_csv(data / f"{number:02d}_recordingMeta.csv")
    if osm is not None:
        place = folder / maps / f"{location:02d}_somewhere.osm"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(str(osm))
    return folder


def urban_road() -> Osm:
    """The road that the vehicles of :func:`urban_tracks` are on."""
    return road()
