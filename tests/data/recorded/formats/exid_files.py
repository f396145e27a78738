"""Small exiD folders and Lanelet2 maps, written by hand; whole tables of exiD, and where the shared data are."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import polars as pl
import pytest
from pyproj import Transformer

from epo_lightning.data.recorded.formats.exid_tables import RECORDING_META, TRACKS, TRACKS_META, USED, read_table

ORIGIN = (351_000.0, 5_650_000.0)
"""Origin of the local frame in UTM zone 32 [m], near Cologne."""
_GLOBE = Transformer.from_crs("EPSG:32632", "EPSG:4326")


def globe(x: float, y: float, origin: tuple[float, float] = ORIGIN) -> tuple[float, float]:
    """Latitude and longitude [deg] of a position in the local frame."""
    return _GLOBE.transform(x + origin[0], y + origin[1])


def shared(name: str) -> Path:
    """A file of the data that the project does not hold; skips the test where it is absent."""
    folder = Path(os.environ.get("EPO_SHARED", Path(__file__).parents[5] / "shared"))
    if not (folder / name).exists():
        pytest.skip(f"there is no {name} in {folder}: set EPO_SHARED to the folder that holds it")
    return folder / name


def read_tracks(path: Path) -> pl.DataFrame:
    """All columns of a tracks file, of which the reader of the format takes some; missing values are null."""
    return read_table(path, TRACKS, USED)


def read_tracks_meta(path: Path) -> pl.DataFrame:
    """All columns of a tracksMeta file."""
    return read_table(path, TRACKS_META, tuple(TRACKS_META))


def read_recording_meta(path: Path) -> pl.DataFrame:
    """All columns of a recordingMeta file."""
    return read_table(path, RECORDING_META, ("recordingId", "locationId", "frameRate", "xUtmOrigin", "yUtmOrigin"))


@dataclass
class Osm:
    """A Lanelet2 map in the making."""

    nodes: list[tuple[int, float, float]] = field(default_factory=list)
    ways: list[tuple[int, list[int], dict[str, str]]] = field(default_factory=list)
    lanelets: list[tuple[int, int, int, dict[str, str]]] = field(default_factory=list)

    def node(self, x: float, y: float, id: int | None = None) -> int:
        self.nodes.append((len(self.nodes) + 1 if id is None else id, x, y))
        return self.nodes[-1][0]

    def way(self, nodes: Iterable[int], id: int | None = None, **tags: str) -> int:
        self.ways.append((len(self.ways) + 1 if id is None else id, list(nodes), tags))
        return self.ways[-1][0]

    def lanelet(self, left: int, right: int, id: int | None = None, **tags: str) -> int:
        tags = {"subtype": "highway", "location": "nonurban"} | tags
        self.lanelets.append((len(self.lanelets) + 1 if id is None else id, left, right, tags))
        return self.lanelets[-1][0]

    def __str__(self) -> str:
        def written(tags: Mapping[str, str]) -> str:
            return "".join(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items())

        lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6' generator='test'>"]
        for id, x, y in self.nodes:
            lat, lon = globe(x, y)
            lines.append(f"<node id='{id}' visible='true' version='1' lat='{lat:.12f}' lon='{lon:.12f}'/>")
        for id, nodes, tags in self.ways:
            references = "".join(f"<nd ref='{node}'/>" for node in nodes)
            lines.append(f"<way id='{id}' visible='true' version='1'>{references}{written(tags)}</way>")
        for id, left, right, tags in self.lanelets:
            lines.append(
                f"<relation id='{id}' visible='true' version='1'><member type='way' ref='{left}' role='left'/>"
                f"<member type='way' ref='{right}' role='right'/>{written({'type': 'lanelet'} | tags)}</relation>"
            )
        return "\n".join([*lines, "</osm>"]) + "\n"


DASHED = {"type": "line_thin", "subtype": "dashed"}
SOLID = {"type": "line_thick", "subtype": "solid"}
BORDER = {"type": "road_border"}


def road() -> Osm:
    """Two lanes and a shoulder, two lanelets long: lanelets 1, 2, 3 from left to right, then 4, 5, 6."""
    osm = Osm()
    grid = [[osm.node(x, y + 5e-4 * x**2) for x in range(0, 201, 25)] for y in (7.5, 3.75, 0.0, -3.0)]
    for part in (slice(0, 5), slice(4, 9)):
        ways = [osm.way(line[part], **tags) for line, tags in zip(grid, (BORDER, DASHED, SOLID, BORDER), strict=True)]
        for left, right, subtype in zip(ways, ways[1:], ("highway", "highway", "emergency_lane"), strict=False):
            osm.lanelet(left, right, subtype=subtype)
    return osm


def drive(lanes: Iterable[float] = (5.6, 1.9, 1.9), frames: int = 12, rate: float = 25.0) -> pl.DataFrame:
    """Tracks along that road at 25, 26, ... m/s, each in the lane around y, one frame after the other."""
    rows = []
    for track, y in enumerate(lanes):
        for k in range(frames):
            speed = 25.0 + track
            x = 20.0 + 30.0 * track + speed * k / rate
            slope = 1e-3 * x
            lanelet = (1 if y > 3.75 else 2) + 3 * (x >= 100)
            both = k == 3
            rows.append(
                {"recordingId": 7, "trackId": 10 + track, "frame": 5 * track + k, "trackLifetime": k}
                | {"xCenter": x, "yCenter": y + 5e-4 * x**2, "heading": float(np.rad2deg(np.arctan(slope)))}
                | {"width": 1.9, "length": 4.5, "xVelocity": speed, "yVelocity": speed * slope}
                | {"xAcceleration": 0.0, "yAcceleration": 0.0, "lonVelocity": speed, "latVelocity": 0.0}
                | {"lonAcceleration": 0.0, "latAcceleration": 0.0, "traveledDistance": x - 20.0}
                | {"latLaneCenterOffset": "-1.0;2.75" if both else "-1.0", "laneWidth": "3.75;3.75" if both else "3.75"}
                | {"laneletId": f"{lanelet};{lanelet + 3}" if both else str(lanelet) if k else "-1"}
                | {
                    "laneChange": int(k == 2),
                    "lonLaneletPos": "4" if k else "-1",
                    "laneletLength": "100" if k else "-1",
                }
                | {"leadDHW": -1.0 if k else 20.0, "leadDV": -1000.0 if k else -1.0, "leadTHW": -1.0, "leadTTC": -1.0}
                | {"leadId": -1 if k else 11, "rearId": -1, "leftLeadId": -1, "leftRearId": -1}
                | {"leftAlongsideId": "11;12" if both else None, "rightLeadId": -1, "rightRearId": -1}
                | {"rightAlongsideId": "11" if both else None, "odrRoadId": 1 if k else -1, "odrSectionNo": 0}
                | {"odrLaneId": -1}
            )
    return pl.DataFrame(rows, infer_schema_length=None)


def meta_of(tracks: pl.DataFrame, kinds: Iterable[str] = ("car", "truck", "van")) -> pl.DataFrame:
    """The tracksMeta table of tracks."""
    found = tracks.group_by("recordingId", "trackId", maintain_order=True).agg(
        initialFrame=pl.col("frame").min(),
        finalFrame=pl.col("frame").max(),
        numFrames=pl.len(),
        width=pl.col("width").first(),
        length=pl.col("length").first(),
    )
    return found.with_columns(pl.Series("class", list(kinds)[: len(found)]))


SETTING = (
    {
        "recordingId": 7,
        "locationId": 2,
        "frameRate": 25.0,
        "speedLimit": 27.78,
        "weekday": "tuesday",
        "startTime": "09:12",
    }
    | {"duration": 2.0, "numTracks": 3, "numVehicles": 3, "numVrus": 0, "latLocation": 50.9, "lonLocation": 6.8}
    | {"xUtmOrigin": ORIGIN[0], "yUtmOrigin": ORIGIN[1], "orthoPxToMeter": 0.1, "exportVersion": "2.1"}
)


def write(
    folder: Path,
    tracks: pl.DataFrame | None = None,
    meta: pl.DataFrame | None = None,
    setting: Mapping[str, object] = SETTING,
    osm: Osm | None = None,
    version: str = "2.1",
) -> Path:
    """One recording as version 2.1 or 2.0 lays it out."""
    tracks = drive() if tracks is None else tracks
    data = folder / "data"
    data.mkdir(parents=True)
    tracks.write_csv(data / "07_tracks.csv", quote_style="never")
    (meta_of(tracks) if meta is None else meta).write_csv(data / "07_tracksMeta.csv")
    name = "07_recordingMeta.csv" if version == "2.1" else "07_recordingsMeta.csv"
    pl.DataFrame([setting]).write_csv(data / name)
    maps = folder / "maps" / "lanelet2"
    place = maps / "2_aachen_brand" / "location2.osm" if version == "2.1" else maps / "2_aachen_brand.osm"
    place.parent.mkdir(parents=True)
    place.write_text(str(road() if osm is None else osm))
    return folder
