"""Lanelet2 maps of layouts, in OpenStreetMap XML as in exiD v2.1.

The strips are cut into lanelets wherever a lane begins, ends, joins or leaves. Consecutive lanelets share points and
neighbouring lanelets share boundary ways, from which Lanelet2 derives successors and neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pyproj import Transformer

from epo_lightning.data.simulate.layout import Layout

LEAD_IN, LEAD_OUT = 30.0, 60.0
"""Lengths [m] of the map before and behind the recorded area."""


@dataclass(frozen=True)
class Lanelet:
    """A piece of a strip.

    Attributes:
        id: id of the lanelet in the map.
        strip: index into ``layout.strips``.
        begin, end: range of s [m].
    """

    id: int
    strip: int
    begin: float
    end: float


def lanelets(layout: Layout) -> list[Lanelet]:
    """All lanelets of a layout's map."""
    first, last = layout.area[0] - LEAD_IN, layout.area[1] + LEAD_OUT
    cuts = [s for strip in layout.strips for s in (strip.begin, strip.end, strip.join, strip.leave)]
    found: list[Lanelet] = []
    for begin, end in layout.sections([*cuts, first, last]):
        middle = (begin + end) / 2
        if first < middle < last:
            found += [
                Lanelet(len(found) + 1 + count, index, begin, end)
                for count, index in enumerate(
                    index for index, strip in enumerate(layout.strips) if strip.begin < middle < strip.end
                )
            ]
    return found


def write_map(layout: Layout, path: Path, spacing: float = 5.0) -> None:
    """Write a layout's map.

    Args:
        path: path of the ``.osm`` file.
        spacing: distance of the points along a boundary [m].
    """
    geographic = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    pieces = lanelets(layout)
    nodes: dict[tuple[int, int], int] = {}
    places: list[np.ndarray] = []
    sides: dict[tuple[int, ...], list[tuple[Lanelet, str]]] = {}
    for piece in pieces:
        s = np.linspace(piece.begin, piece.end, max(2, round((piece.end - piece.begin) / spacing) + 1))
        for side, offset in zip(("left", "right"), layout.edges(layout.strips[piece.strip], s), strict=True):
            points = layout.locate(s, offset)
            # Points that agree to a millimetre become one node, in which lanes meet.
            keys = [(round(along * 1e3), round(beside * 1e3)) for along, beside in zip(s, offset, strict=True)]
            for key, point in zip(keys, points, strict=True):
                if key not in nodes:
                    nodes[key] = 100_001 + len(nodes)
                    places.append(point)
            sides.setdefault(tuple(nodes[key] for key in keys), []).append((piece, side))
    longitude, latitude = geographic.transform(*(np.array(places) + layout.origin).T)

    root = ElementTree.Element("osm", version="0.6", generator="epo_lightning")
    for number, north, east in zip(nodes.values(), latitude, longitude, strict=True):
        ElementTree.SubElement(
            root, "node", id=str(number), visible="true", version="1", lat=f"{north:.11f}", lon=f"{east:.11f}"
        )
    ways: dict[tuple[int, str], int] = {}
    for count, (way, users) in enumerate(sides.items()):
        element = ElementTree.SubElement(root, "way", id=str(10_001 + count), visible="true", version="1")
        for number in way:
            ElementTree.SubElement(element, "nd", ref=str(number))
        shoulder = any(layout.strips[piece.strip].shoulder for piece, _ in users)
        if len(users) == 1:
            _tag(element, type="road_border")
        else:
            _tag(element, type="line_thin", subtype="solid" if shoulder else "dashed")
        ways.update({(piece.id, side): 10_001 + count for piece, side in users})
    for piece in pieces:
        strip = layout.strips[piece.strip]
        road = strip.road((piece.begin + piece.end) / 2)
        element = ElementTree.SubElement(root, "relation", id=str(piece.id), visible="true", version="1")
        for side in ("left", "right"):
            ElementTree.SubElement(element, "member", type="way", ref=str(ways[piece.id, side]), role=side)
        _tag(
            element,
            type="lanelet",
            subtype="emergency_lane" if strip.shoulder else "highway",
            location="nonurban",
            one_way="yes",
            **({"onramp": "yes"} if road.startswith("on") else {"offramp": "yes"} if road.startswith("off") else {}),
        )
    ElementTree.indent(root)
    path.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _tag(element: ElementTree.Element, **tags: str) -> None:
    for key, value in tags.items():
        ElementTree.SubElement(element, "tag", k=key, v=value)
