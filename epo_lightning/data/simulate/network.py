"""SUMO's network of a layout: straight edges, whose lanes are the strips of the layout."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from epo_lightning.data.simulate.layout import Layout
from epo_lightning.registry import ConfigError

UNLIMITED = 130 / 3.6
"""Reference [m/s] of desired speeds on roads without a speed limit."""
RAMP_SPEED = 90 / 3.6
"""Speed limit on ramps [m/s]."""


@dataclass(frozen=True)
class Edge:
    """A section of a carriageway."""

    name: str
    road: str
    begin: float
    end: float
    strips: tuple[int, ...]
    """Indices into ``layout.lanes``, from right to left."""


def edges_of(layout: Layout) -> list[Edge]:
    """The edges of the network: one per section and carriageway, in downstream order."""
    lanes = layout.lanes
    cuts = [s for strip in lanes for s in (*strip.driven, strip.join, strip.leave)]
    edges = []
    for number, (begin, end) in enumerate(layout.sections(cuts)):
        middle = (begin + end) / 2
        roads: dict[str, list[int]] = {}
        for index, strip in sorted(enumerate(lanes), key=lambda item: item[1].place):
            if strip.driven[0] < middle < strip.driven[1]:
                roads.setdefault(strip.road(middle), []).append(index)
        edges += [Edge(f"{road}_{number}", road, begin, end, tuple(strips)) for road, strips in roads.items()]
    return edges


def _xml(path: Path, tag: str, children: Iterable[tuple[str, dict[str, Any]]]) -> Path:
    root = ElementTree.Element(tag)
    for name, attributes in children:
        ElementTree.SubElement(root, name, {key: str(value) for key, value in attributes.items()})
    ElementTree.ElementTree(root).write(path)
    return path


def write_network(layout: Layout, edges: list[Edge], programs: Path, folder: Path) -> Path:
    """Write SUMO's network of a layout, and return its path.

    Edges are straight; vehicles pass from the end of one to the start of the next.

    Raises:
        ConfigError: SUMO refuses it.
    """
    height = {road: -50.0 * row for row, road in enumerate(dict.fromkeys(edge.road for edge in edges))}
    height["main"] = 0.0

    # Ramp and road share a node where they meet; elsewhere they are drawn apart.
    def node(edge: Edge, s: float) -> tuple[str, float]:
        meeting = [other for other in edges if s in (other.begin, other.end) and set(other.strips) & set(edge.strips)]
        road = "main" if any(other.road == "main" for other in meeting) else edge.road
        return f"{road}@{s:g}", height[road]

    nodes: dict[str, dict[str, Any]] = {}
    rows, links = [], []
    speed = layout.limit or UNLIMITED
    for edge in edges:
        ends = []
        for s in (edge.begin, edge.end):
            name, y = node(edge, s)
            nodes[name] = {"id": name, "x": s, "y": y}
            ends.append(name)
        rows.append(
            (
                "edge",
                {
                    "id": edge.name,
                    "from": ends[0],
                    "to": ends[1],
                    "numLanes": len(edge.strips),
                    "speed": speed if edge.road == "main" else min(speed, RAMP_SPEED),
                    "length": edge.end - edge.begin,
                    "width": layout.width,
                },
            )
        )
        for after in edges:
            if after.begin == edge.end:
                links += [
                    (
                        "connection",
                        {
                            "from": edge.name,
                            "to": after.name,
                            "fromLane": edge.strips.index(strip),
                            "toLane": after.strips.index(strip),
                        },
                    )
                    for strip in edge.strips
                    if strip in after.strips
                ]
    net = folder / "net.xml"
    command = [
        str(programs / "netconvert"),
        f"--node-files={_xml(folder / 'nodes.xml', 'nodes', (('node', row) for row in nodes.values()))}",
        f"--edge-files={_xml(folder / 'edges.xml', 'edges', rows)}",
        f"--connection-files={_xml(folder / 'connections.xml', 'connections', links)}",
        f"--output-file={net}",
        "--no-internal-links=true",
        "--no-turnarounds=true",
        "--junctions.limit-turn-speed=-1",
        "--offset.disable-normalization=true",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode or not net.is_file():
        raise ConfigError(f"SUMO's netconvert refuses the network of layout {layout.name}: {done.stderr.strip()}")
    return net
