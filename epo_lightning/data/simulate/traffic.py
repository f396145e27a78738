"""Simulation of traffic on a layout with SUMO: the position of each vehicle in its lane at each step.

SUMO simulates a straight abstract network with one edge per carriageway and section, whose lanes are the layout's strips.
Lane changes follow its sublane model (SL2015), which moves vehicles sideways smoothly, and car following its EIDM. Drivers
differ between vehicle types, and the mixture of types differs between recordings.
"""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.simulate.demand import CLASSES, STYLES, Style, write_demand
from epo_lightning.data.simulate.layout import Layout
from epo_lightning.data.simulate.network import Edge, edges_of, write_network
from epo_lightning.registry import ConfigError

RATE = 25
"""Frame rate of exiD [Hz]."""
WARM_UP = 90.0
"""Time [s] in which the road fills; it is not recorded."""
MARGIN = 1.0
"""Time [s] before and after the recorded time that the smoothing needs."""
FASTEST = 60.0
"""Largest speed [m/s]; a vehicle with more was moved by the simulator."""


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
        ConfigError: SUMO is not installed, or the system lacks libraries that it needs.
    """
    try:
        with redirect_stdout(io.StringIO()):  # it prints a warning about pyarrow, which is not used with it
            import libsumo
            import sumo
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"simulated traffic needs the simulator SUMO ({error}): install it with `pip install 'epo_lightning[sim]'`"
        ) from None
    except ImportError as error:
        raise ConfigError(
            f"SUMO is installed, but a library of the system is missing ({error}): on Debian and Ubuntu, "
            "`apt-get install libgl1 libxext6 libxrender1`"
        ) from None
    return libsumo, Path(sumo.SUMO_HOME) / "bin"


def brake(libsumo: ModuleType, names: Iterable[str], style: Style, rate: int, random: np.random.Generator) -> None:
    """Let some drivers brake, so that on average each does so once in ``style.every`` seconds; none do so without it."""
    if style.every is None:
        return
    for name in names:
        if random.random() < 1 / (style.every * rate):
            slow_down(libsumo, name, style, random)


def slow_down(libsumo: ModuleType, name: str, style: Style, random: np.random.Generator) -> None:
    """Let a driver brake, for a time and by a deceleration that are drawn."""
    seconds = random.uniform(*style.lasting)
    slower = libsumo.vehicle.getSpeed(name) - seconds * random.uniform(*style.braking)
    libsumo.vehicle.slowDown(name, max(slower, 0.0), seconds)


@dataclass(frozen=True)
class RunningSumo:
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
) -> Iterator[RunningSumo]:
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
    edges = edges_of(layout)
    net = write_network(layout, edges, programs, folder)
    steps = round(WARM_UP * rate) + round((seconds + MARGIN) * rate)
    drivers = write_demand(layout, edges, random, steps / rate, folder / "routes.xml", style)
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
        yield RunningSumo(libsumo, random, edges, where, {row["id"]: row for row in drivers})
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
