"""Small INTERACTION folders in the public format of the data set, made by code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import Transformer

from data.recorded.formats.exid_files import road

PLACE = "DR_TEST_Merging_AA0"
HEADER = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"
AROUND = (1000.0, 980.0)
"""Where the road begins [m]: maps of the data set lie around (1000, 1000)."""
_GLOBE = Transformer.from_crs("EPSG:32631", "EPSG:4326")


def globe(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude of a position in metres from latitude and longitude 0."""
    east, _ = Transformer.from_crs("EPSG:4326", "EPSG:32631").transform(0.0, 0.0)
    return _GLOBE.transform(x + east, y)


def map_text(metres: bool = False) -> str:
    """The road of exiD's tests, moved, with latitudes and longitudes or with x and y."""
    osm = road()
    osm.nodes = [(id, x + AROUND[0], y + AROUND[1]) for id, x, y in osm.nodes]
    lines = [line for line in str(osm).splitlines() if not line.startswith("<node")]
    nodes = []
    for id, x, y in osm.nodes:
        if metres:
            nodes.append(f"<node id='{id}' visible='true' version='1' x='{x!r}' y='{y!r}'/>")
        else:
            lat, lon = globe(x, y)
            nodes.append(f"<node id='{id}' visible='true' version='1' lat='{lat:.13f}' lon='{lon:.13f}'/>")
    text = "\n".join([*lines[:2], *nodes, *lines[2:]]) + "\n"
    return text.replace("<osm ", "<osm_xy ").replace("</osm>", "</osm_xy>") if metres else text


def vehicles(frames: int = 12, case: str = "", seed: int = 0) -> list[str]:
    """Rows of two cars and a truck on the road."""
    random, rows = np.random.default_rng(seed), []
    for track, (lane, kind, length) in enumerate(((5.6, "car", 4.3), (1.9, "car", 4.8), (1.9, "truck", 9.5)), 1):
        speed, start = random.uniform(8, 12), random.uniform(20, 30) + 30 * track
        for k in range(frames):
            along = start + speed * k / 10
            x, y, heading = AROUND[0] + along, AROUND[1] + lane + 5e-4 * along**2, np.arctan(1e-3 * along)
            frame = track + k
            vx, vy = speed, speed * 1e-3 * along
            rows.append(
                f"{case}{track},{frame},{100 * frame},{kind},{x:.3f},{y:.3f},{vx:.3f},{vy:.3f},{heading:.3f},{length},2.0"
            )
    return rows


def pedestrians(frames: int = 8, case: str = "", blank: str = "") -> list[str]:
    """Rows of one pedestrian that walks and of one that stands."""
    rows = []
    for k in range(frames):
        for track, (vx, vy) in (("P1", (-0.9, 1.1)), ("P2", (0.0, 0.05))):
            x, y = AROUND[0] + 10 + vx * k / 10, AROUND[1] + 12 + vy * k / 10
            rows.append(f"{case}{track},{k + 1},{100 * (k + 1)},pedestrian/bicycle,{x:.3f},{y:.3f},{vx},{vy}{blank}")
    return rows


def write_recording(folder: Path, number: int = 0, suffix: str = ".osm", frames: int = 12) -> Path:
    """One recording with its map; an empty suffix leaves the map out."""
    place = folder / "recorded_trackfiles" / PLACE
    place.mkdir(parents=True, exist_ok=True)
    (place / f"vehicle_tracks_{number:03d}.csv").write_text("\n".join([HEADER, *vehicles(frames)]) + "\n")
    header = HEADER.rsplit(",", 3)[0]
    (place / f"pedestrian_tracks_{number:03d}.csv").write_text("\n".join([header, *pedestrians()]) + "\n")
    return write_map(folder, suffix)


def write_cases(folder: Path, cases: int = 3, suffix: str = ".osm") -> Path:
    """One table of the multi-agent challenge: cases 1.0, 2.0, ... with vehicles and pedestrians."""
    rows = [
        row
        for case in range(1, cases + 1)
        for row in (*vehicles(8, f"{case}.0,", case), *pedestrians(8, f"{case}.0,", ",,,"))
    ]
    (folder / "train").mkdir(parents=True, exist_ok=True)
    (folder / "train" / f"{PLACE}_train.csv").write_text("\n".join([f"case_id,{HEADER}", *rows]) + "\n")
    return write_map(folder, suffix)


def write_map(folder: Path, suffix: str) -> Path:
    if suffix:
        (folder / "maps").mkdir(exist_ok=True)
        (folder / "maps" / f"{PLACE}{suffix}").write_text(map_text(metres=suffix == ".osm_xy"))
    return folder
