"""The vehicles that enter a simulated road: their types, how busy the road is, and where they go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from epo_lightning.data.simulate.layout import Layout
from epo_lightning.data.simulate.network import RAMP_SPEED, UNLIMITED, Edge

CLASSES = ("car", "van", "truck", "motorcycle")
"""Vehicle classes of exiD."""


@dataclass(frozen=True)
class Style:
    """How busy a road is and how its drivers drive; the defaults are those of a free flow.

    Attributes:
        main, on, off: factors of the layout's flows on the road, on the on-ramp and to the off-ramp.
        headway: factor of the drivers' desired time headways.
        every: mean time [s] between two moments at which a driver brakes for reasons that the simulator does not know, for
            instance to let another vehicle in, or before an exit. None for never: then drivers foresee each other so well
            that they rarely have to give way.
        braking: smallest and largest deceleration [m/s^2] of such a moment.
        lasting: its shortest and longest duration [s].
    """

    main: float = 1.0
    on: float = 1.0
    off: float = 1.0
    headway: float = 1.0
    every: float | None = None
    braking: tuple[float, float] = (2.0, 4.0)
    lasting: tuple[float, float] = (1.0, 2.5)


STYLES: Mapping[str, Style] = {
    "free": Style(),
    "dense": Style(main=1.1, on=1.5, off=1.2, headway=0.8, every=15.0),
}
"""The styles of traffic, by the name in ``data.traffic``."""


def drivers_of(random: np.random.Generator, layout: Layout) -> list[dict[str, Any]]:
    """Vehicle types of one recording, each with its parameters and its share of the traffic."""
    speed = layout.limit or UNLIMITED
    heavy = random.uniform(0.08, 0.18)
    hurry, haste = random.uniform(0.97, 1.06), random.uniform(0.85, 1.15)
    cars, vans, trucks = 20, 4, 8
    rows = []
    for number in range(cars + vans + trucks + 1):
        kind = 0 if number < cars else 1 if number < cars + vans else 2 if number < cars + vans + trucks else 3
        common = {
            "id": f"{CLASSES[kind]}{number}",
            "carFollowModel": "EIDM",
            "laneChangeModel": "SL2015",
            "latAlignment": "center",
            "lcSublane": 1,
            "lcSigma": 0.1,
            "lcMaxSpeedLatStanding": 0,
            "lcCooperative": round(random.uniform(0.7, 1.0), 2),
            "lcAssertive": round(random.uniform(1.0, 1.5), 2),
            "minGapLat": 0.6,
            "sigma": 0.3,
            "emergencyDecel": 8.0,
        }
        if kind == 2:
            own = {
                "vClass": "truck",
                "length": random.uniform(8.0, 18.5),
                "width": 2.5,
                "maxSpeed": 25.0,
                "speedFactor": f"normc({24.0 / speed:.3f},{0.6 / speed:.3f},{22.0 / speed:.3f},{25.0 / speed:.3f})",
                "accel": random.uniform(0.7, 1.1),
                "decel": 4.0,
                "tau": random.uniform(1.2, 1.9) * haste,
                "minGap": 3.0,
                "lcStrategic": 1.5,
                "lcSpeedGain": 0.5,
                "lcKeepRight": 1.5,
                "maxSpeedLat": random.uniform(0.8, 1.0),
                "lcAccelLat": 0.5,
                "probability": heavy / trucks,
            }
        else:
            spread = 0.08 if layout.limit else 0.13
            share = {0: (0.93 - heavy) / cars, 1: 0.06 / vans, 3: 0.01}[kind]
            length, width = {0: ((3.7, 5.1), (1.7, 2.0)), 1: ((5.2, 7.2), (2.0, 2.2)), 3: ((2.1, 2.3), (0.8, 0.9))}[
                kind
            ]
            mean = hurry * (0.92 if kind == 1 else 1.0)
            own = {
                "vClass": "motorcycle" if kind == 3 else "passenger",
                "length": random.uniform(*length),
                "width": random.uniform(*width),
                "maxSpeed": 55.0,
                "speedFactor": f"normc({mean:.3f},{spread},{mean - 2 * spread:.3f},{mean + 2.5 * spread:.3f})",
                "accel": random.uniform(1.4, 2.4),
                "decel": 4.5,
                "tau": random.uniform(0.7, 1.5) * haste,
                "minGap": 2.0,
                "lcStrategic": round(random.uniform(1.0, 2.0), 2),
                "lcSpeedGain": round(random.uniform(0.8, 2.0), 2),
                "lcKeepRight": round(random.uniform(0.3, 1.2), 2),
                "maxSpeedLat": random.uniform(0.9, 1.3),
                "lcAccelLat": random.uniform(0.6, 0.9),
                "probability": share,
            }
        rows.append({key: round(v, 3) if isinstance(v, float) else v for key, v in {**common, **own}.items()})
    return rows


def write_demand(
    layout: Layout, edges: list[Edge], random: np.random.Generator, until: float, path: Path, style: Style
) -> list[dict[str, Any]]:
    """Write the flows of vehicles between edges, and return the vehicle types."""
    drivers = drivers_of(random, layout)
    for row in drivers:
        row["tau"] = round(row["tau"] * style.headway, 3)
    main, on_ramp, off_ramp = layout.main * style.main, layout.on * style.on, layout.off * style.off
    busy = random.uniform(0.85, 1.05)
    roads = {road: [edge for edge in edges if edge.road == road] for road in dict.fromkeys(edge.road for edge in edges)}
    flows: list[tuple[str, str, float]] = []
    on = next((road for road in roads if road.startswith("on")), None)
    off = next((road for road in roads if road.startswith("off")), None)
    leaving = off_ramp / (main + on_ramp)
    for source, rate in (("main", main), (on, on_ramp)):
        # Vehicles from the on-ramp leave again on weaving lanes only, and less often than others.
        weave = source == "main" or any(np.isfinite((strip.join, strip.leave)).all() for strip in layout.lanes)
        away = leaving * (1.0 if source == "main" else 0.4) if off and weave else 0.0
        if source:
            flows += [(source, "main", rate * (1 - away))] + ([(source, str(off), rate * away)] if away else [])
    root = ElementTree.Element("routes")
    mixture = ElementTree.SubElement(root, "vTypeDistribution", {"id": "mixture"})
    for row in drivers:
        ElementTree.SubElement(mixture, "vType", {key: str(value) for key, value in row.items()})
    for source, target, rate in flows:
        ElementTree.SubElement(
            root,
            "flow",
            {
                "id": f"{source}-{target}",
                "type": "mixture",
                "from": roads[source][0].name,
                "to": roads[target][-1].name,
                "begin": "0",
                "end": f"{until}",
                "period": f"exp({rate * busy / 3600:.6f})",
                "departLane": "best",
                "departPos": "base",
                "departSpeed": "desired" if source == "main" else f"{RAMP_SPEED * 0.8:.2f}",
            },
        )
    ElementTree.ElementTree(root).write(path)
    return drivers
