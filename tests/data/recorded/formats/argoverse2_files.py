"""Small Argoverse 2 scenarios, written by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl

LONG = 150.0
"""Length of each of the two pieces of the road [m]."""


def points(*ends: tuple[float, float]) -> list[dict[str, float]]:
    """A boundary as the maps write it."""
    return [{"x": x, "y": y, "z": 0.5} for x, y in ends]


def lane(id: int, left: list, right: list, **about: object) -> dict[str, object]:
    """A lane segment between two boundaries."""
    known = {"is_intersection": False, "lane_type": "VEHICLE"} | {
        f"{side}_{what}": value
        for side in ("left", "right")
        for what, value in (("lane_mark_type", "NONE"), ("neighbor_id", None))
    }
    boundaries = {"left_lane_boundary": points(*left), "right_lane_boundary": points(*right)}
    return known | boundaries | {"id": id, "successors": [], "predecessors": []} | about


def city() -> dict[str, object]:
    """Two pieces of a road along x. Each has a right lane (10, 12), a left lane (11, 13), an oncoming lane on its left
    (20, 21) and a bicycle lane on its right (30, 31)."""
    lanes = []
    for piece in range(2):
        ends = (piece * LONG, (piece + 1) * LONG)

        def line(y: float, ends=ends) -> list[tuple[float, float]]:
            return [(ends[0], y), (sum(ends) / 2, y), (ends[1], y)]

        right, left, oncoming, bike = 10 + 2 * piece, 11 + 2 * piece, 20 + piece, 30 + piece
        after, before = ([12, 13, 31], [999, 11]) if piece == 0 else ([], [10])
        lanes += [
            lane(
                right,
                line(3.5),
                line(0.0),
                successors=after[:1],
                predecessors=before[:1],
                left_neighbor_id=left,
                left_lane_mark_type="DASHED_WHITE",
                right_neighbor_id=bike,
                right_lane_mark_type="SOLID_WHITE",
            ),
            lane(
                left,
                line(7.0),
                line(3.5),
                successors=after[1:2],
                left_neighbor_id=oncoming,
                left_lane_mark_type="DOUBLE_SOLID_YELLOW",
                right_neighbor_id=right,
                right_lane_mark_type="DASHED_WHITE",
            ),
            lane(
                oncoming,
                line(7.0)[::-1],
                line(10.5)[::-1],
                predecessors=[21] if piece == 0 else [],
                left_neighbor_id=left,
                left_lane_mark_type="DOUBLE_SOLID_YELLOW",
            ),
            lane(
                bike,
                line(0.0),
                line(-1.5),
                lane_type="BIKE",
                successors=after[2:],
                left_neighbor_id=right,
                left_lane_mark_type="SOLID_WHITE",
            ),
        ]
    return {
        "drivable_areas": {},
        "pedestrian_crossings": {},
        "lane_segments": {str(segment["id"]): segment for segment in lanes},
    }


AGENTS = (
    ("7", "vehicle", 5.0, 1.9, 12.0),
    ("AV", "vehicle", 20.0, 5.2, 10.0),
    ("8", "bus", 40.0, 1.6, 9.0),
    ("9", "pedestrian", 30.0, -4.0, 1.2),
    ("12", "cyclist", 35.0, -0.7, 5.0),
    ("14", "vehicle", 200.0, 8.8, -11.0),
    ("15", "static", 60.0, -6.0, 0.0),
    ("16", "motorcyclist", 2.0, 5.0, 11.0),
)
"""Identifier, type, x and y at the beginning [m], speed along x [m/s]."""


def drive(frames: int = 110, agents=AGENTS) -> pl.DataFrame:
    """Tracks along that road, rows in the publisher's order: by agent."""
    rows = []
    for number, (track, kind, x, y, speed) in enumerate(agents):
        rows += [
            {"observed": k < 50, "track_id": track, "object_type": kind, "object_category": number % 4, "timestep": k}
            | {"position_x": x + 0.1 * k * speed, "position_y": y, "heading": 0.0 if speed >= 0 else np.pi}
            | {"velocity_x": speed, "velocity_y": 0.0, "scenario_id": "s", "start_timestamp": 0.0}
            | {"end_timestamp": 1.09e10, "num_timestamps": 110, "focal_track_id": "7", "city": "austin"}
            for k in range(frames)
        ]
    return pl.DataFrame(rows)


def write(
    home: Path, name: str = "s", tracks: pl.DataFrame | None = None, roads: dict[str, object] | None = None
) -> Path:
    """One scenario in a folder of its own below ``home``."""
    folder = home / name
    folder.mkdir(parents=True)
    (drive() if tracks is None else tracks).write_parquet(folder / f"scenario_{name}.parquet")
    (folder / f"log_map_archive_{name}.json").write_text(json.dumps(city() if roads is None else roads))
    return folder
