"""Simulation of traffic on a layout with SUMO: the position of each vehicle in its lane at each step.

SUMO simulates a straight abstract network with one edge per carriageway and section, whose lanes are the layout's strips.
Lane changes follow its sublane model (SL2015), which moves vehicles sideways smoothly, and car following its EIDM. Drivers
differ between vehicle types, and the mixture of types differs between recordings.
"""

from __future__ import annotations

import io
import subprocess
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.simulate.layout import Layout
from epo_lightning.registry import ConfigError

RATE = 25
"""Frame rate of exiD [Hz]."""
WARM_UP = 90.0
"""Time [s] in which the road fills; it is not recorded."""
MARGIN = 1.0
"""Time [s] before and after the recorded time that the smoothing needs."""
UNLIMITED = 130 / 3.6
"""Reference [m/s] of desired speeds on roads without a speed limit."""
RAMP_SPEED = 90 / 3.6
"""Speed limit on ramps [m/s]."""
FASTEST = 60.0
"""Largest speed [m/s]; a vehicle with more was moved by the simulator."""
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


@dataclass(frozen=True)
class Traffic:
    """Simulated positions. Rows are sorted by vehicle, and by step within a vehicle.

    Attributes:
        rate: steps per second [Hz].
        vehicle: index of each row's vehicle.
        step: simulation step, counted from the end of the warm-up.
        strip: index into ``layout.lanes`` of the lane whose middle is nearest.
        front: s of the front bumper [m].
        aside: offset from the middle of the strip, positive to the left [m].
        size: length and width of each vehicle [m].
        kind: class of each vehicle, an index into CLASSES.
        dropped: vehicles that were left out, by reason.
    """

    rate: int
    vehicle: Int[np.ndarray, " T"]
    step: Int[np.ndarray, " T"]
    strip: Int[np.ndarray, " T"]
    front: Float[np.ndarray, " T"]
    aside: Float[np.ndarray, " T"]
    size: Float[np.ndarray, "A 2"]
    kind: Int[np.ndarray, " A"]
    dropped: dict[str, int]


def simulator() -> tuple[ModuleType, Path]:
    """The module of SUMO, and the folder of its programs.

    Raises:
        ConfigError: SUMO is not installed.
    """
    try:
        with redirect_stdout(io.StringIO()):  # it prints a warning about pyarrow, which is not used with it
            import libsumo
            import sumo
    except ImportError as error:
        raise ConfigError(
            f"simulated traffic needs the simulator SUMO ({error}): install it with `pip install 'epo_lightning[sim]'`"
        ) from None
    return libsumo, Path(sumo.SUMO_HOME) / "bin"


@dataclass(frozen=True)
class Edge:
    """A section of a carriageway."""

    name: str
    road: str
    begin: float
    end: float
    strips: tuple[int, ...]
    """Indices into ``layout.lanes``, from right to left."""


def _edges(layout: Layout) -> list[Edge]:
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


def _network(layout: Layout, edges: list[Edge], programs: Path, folder: Path) -> Path:
    """Path of SUMO's network of a layout. Edges are straight; vehicles pass from the end of one to the start of the next."""
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


def _drivers(random: np.random.Generator, layout: Layout) -> list[dict[str, Any]]:
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


def _demand(
    layout: Layout, edges: list[Edge], random: np.random.Generator, until: float, path: Path, style: Style
) -> list[dict[str, Any]]:
    """Write the flows of vehicles between edges, and return the vehicle types."""
    drivers = _drivers(random, layout)
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


def brake(libsumo: ModuleType, names: Iterable[str], style: Style, rate: int, random: np.random.Generator) -> None:
    """Let some drivers brake, so that on average each does so once in ``style.every`` seconds; none do so without it."""
    if style.every is None:
        return
    for name in names:
        if random.random() < 1 / (style.every * rate):
            seconds = random.uniform(*style.lasting)
            slower = libsumo.vehicle.getSpeed(name) - seconds * random.uniform(*style.braking)
            libsumo.vehicle.slowDown(name, max(slower, 0.0), seconds)


@dataclass(frozen=True)
class Simulation:
    """SUMO while it runs in this process.

    Attributes:
        libsumo: its module.
        random: the generator that the simulation continues to draw from.
        edges: edges of the network, in downstream order.
        where: strip, an index into ``layout.lanes``, and s of the beginning [m] of every lane of the network.
        drivers: the vehicle types, by id.
    """

    libsumo: ModuleType
    random: np.random.Generator
    edges: list[Edge]
    where: dict[str, tuple[int, float]]
    drivers: dict[str, dict[str, Any]]


@contextmanager
def running(
    layout: Layout, seed: Sequence[int], seconds: float, folder: Path, rate: int = RATE, style: Style = STYLES["free"]
) -> Iterator[Simulation]:
    """A simulation at its first moment, with traffic for some time after the warm-up; it is closed at the end.

    SUMO keeps its state in global variables, so there is one simulation in a process at a time.

    Args:
        layout: the road.
        seed: seed of the drivers and of all random numbers of SUMO.
        seconds: duration after the warm-up.
        folder: folder for SUMO's input files.
        rate: steps per second [Hz].
        style: how busy the road is and how drivers drive.

    Raises:
        ConfigError: SUMO is not installed or fails.
    """
    libsumo, programs = simulator()
    random = np.random.default_rng(seed)
    edges = _edges(layout)
    net = _network(layout, edges, programs, folder)
    steps = round(WARM_UP * rate) + round((seconds + MARGIN) * rate)
    drivers = _demand(layout, edges, random, steps / rate, folder / "routes.xml", style)
    where = {f"{edge.name}_{lane}": (strip, edge.begin) for edge in edges for lane, strip in enumerate(edge.strips)}
    command = [
        "sumo",
        f"--net-file={net}",
        f"--route-files={folder / 'routes.xml'}",
        f"--step-length={1 / rate}",
        "--lateral-resolution=0.3",
        "--time-to-teleport=-1",
        "--collision.action=warn",
        "--collision.mingap-factor=0",
        "--no-warnings=true",
        "--no-step-log=true",
        "--xml-validation=never",
        f"--seed={random.integers(2**31)}",
    ]
    try:
        libsumo.start(command)
        yield Simulation(libsumo, random, edges, where, {row["id"]: row for row in drivers})
    except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
        raise ConfigError(f"SUMO fails on layout {layout.name} with seed {list(seed)}: {error}") from None
    finally:
        libsumo.close()


def kind_of(type_id: str) -> int:
    """Class of the vehicles of a type, an index into CLASSES."""
    return CLASSES.index(type_id.rstrip("0123456789"))


def simulate(
    layout: Layout, seed: Sequence[int], seconds: float, folder: Path, rate: int = RATE, style: Style = STYLES["free"]
) -> Traffic:
    """Simulated traffic of ``seconds`` after the warm-up; see :func:`running`.

    Raises:
        ConfigError: SUMO is not installed or fails.
    """
    warm_up = round(WARM_UP * rate)
    first = warm_up - round(MARGIN * rate)
    rows = array("d")  # a list of tuples would need a gigabyte for a quarter of an hour
    numbers: dict[str, int] = {}
    types: list[str] = []
    crashed: set[str] = set()
    with running(layout, seed, seconds, folder, rate, style) as run:
        libsumo, constants = run.libsumo, run.libsumo.constants
        variables = (constants.VAR_LANE_ID, constants.VAR_LANEPOSITION, constants.VAR_LANEPOSITION_LAT)
        for step in range(warm_up + round((seconds + MARGIN) * rate)):
            libsumo.simulationStep()
            for name in libsumo.simulation.getDepartedIDList():
                libsumo.vehicle.subscribe(name, variables)
                numbers[name] = len(numbers)
                types.append(libsumo.vehicle.getTypeID(name))
            for hit in libsumo.simulation.getCollisions():
                crashed |= {hit.collider, hit.victim}
            brake(libsumo, libsumo.vehicle.getIDList(), style, rate, run.random)
            if step >= first:
                for name, values in libsumo.vehicle.getAllSubscriptionResults().items():
                    lane, position, aside = (values[variable] for variable in variables)
                    strip, begin = run.where[lane]
                    rows.extend((numbers[name], step - warm_up, strip, begin, position, aside))
        drivers = run.drivers
    return _sorted(np.array(rows).reshape(-1, 6), rate, drivers, types, {numbers[name] for name in crashed})


def _sorted(
    rows: Float[np.ndarray, "T 6"], rate: int, drivers: dict[str, dict[str, Any]], types: list[str], crashed: set[int]
) -> Traffic:
    """Rows sorted by vehicle, without vehicles that collide or jump."""
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    vehicle, step, strip = rows[:, :3].astype(np.int64).T
    front, aside = rows[:, 3] + rows[:, 4], rows[:, 5]
    same = np.diff(vehicle) == 0
    forward = np.diff(front)
    jumps = same & ((np.diff(step) != 1) | (forward < -0.01) | (forward > FASTEST / rate))
    jumped = set(vehicle[1:][jumps].tolist())
    kept = ~np.isin(vehicle, list(crashed | jumped))
    return Traffic(
        rate=rate,
        vehicle=vehicle[kept],
        step=step[kept],
        strip=strip[kept],
        front=front[kept],
        aside=aside[kept],
        size=np.array([[drivers[name]["length"], drivers[name]["width"]] for name in types]),
        kind=np.array([kind_of(name) for name in types]),
        dropped={"collision": len(crashed), "jump": len(jumped - crashed)},
    )
