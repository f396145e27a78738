"""SUMO in processes of its own, from which episodes branch off.

A *stream* is a simulation with all vehicles under their own drivers, in a process of its own. Whenever a vehicle on the
on-ramp comes near the road, and the last episode began a while ago, an episode begins there: the process forks, and the
child simulates what follows while the parent waits. So an episode starts in exactly the state of the stream, as often as it
is asked for, and its other drivers meet the vehicle that a planner drives now. All planners drive an episode before the
stream goes on, so that nothing is simulated twice. SUMO can also save its state to a file, but what it loads from there does
not continue like what was saved, and not always in the same way.
"""

from __future__ import annotations

import os
import select
import tempfile
import zlib
from collections import deque
from collections.abc import Generator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from jaxtyping import Float

from epo_lightning.data.simulate.demand import STYLES, Style
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.data.simulate.traffic import WARM_UP, RunningSumo, brake, kind_of, running, slow_down
from epo_lightning.registry import ConfigError

OWN, END = "own", "end"
"""Messages: the planned vehicle drives by its own driver for a step; the episode is over."""
RATE, STEP = 10, 2
"""Steps per second [Hz], and steps of SUMO in one step of a planner (0.2 s).

Recordings have 25 Hz, which takes 2.5 times as long.
"""
HISTORY = 10
"""Steps of a planner that are known when an episode begins."""
TAKEN = 60.0
"""Distance [m] before the place where the ramp meets the road at which an episode begins."""
PAUSE = 8.0
"""Smallest time [s] between the beginnings of two episodes of a stream."""
LONGEST = 3600.0
"""Longest duration [s] of a stream after the warm-up."""
FILLING = 2.0
"""Time [s] after the warm-up before the first episode begins."""
AROUND = 250.0
"""Distance [m] along the road from the planned vehicle within which vehicles are sent; none beyond it can be a neighbour."""
PATIENCE = 120.0
"""Time [s] within which an episode has to begin; without one, the stream is given up."""


@dataclass(frozen=True)
class Branch:
    """Name of an episode: layout, seed and style of its stream, and its number in it."""

    layout: int
    seed: int
    style: str
    number: int

    @property
    def stream(self) -> tuple[int, int, str]:
        """The stream alone."""
        return self.layout, self.seed, self.style


@dataclass(frozen=True)
class Vehicles:
    """All vehicles at one moment.

    Attributes:
        names: their names.
        strip: index into ``layout.lanes`` of each vehicle's lane.
        values: s of the front bumper, offset to the left of the middle of the lane [m], speed along the road and to the left
            [m/s], length, width [m], and class (an index into CLASSES).
    """

    names: list[str]
    strip: list[int]
    values: Float[np.ndarray, "n 7"]

    def around(self, name: str, vehicles: Vehicles) -> Vehicles:
        """The vehicles of another moment that are near where a vehicle is at this one."""
        if name not in self.names:
            return vehicles
        near = np.abs(vehicles.values[:, 0] - self.values[self.names.index(name), 0]) <= AROUND
        rows = np.flatnonzero(near)
        return Vehicles(
            [vehicles.names[row] for row in rows], [vehicles.strip[row] for row in rows], vehicles.values[rows]
        )


def serve(pipes: Sequence[Connection]) -> None:
    """Answer on every connection, each from a process of its own."""
    processes = []
    for pipe in pipes:
        process = os.fork()
        if not process:
            for other in pipes:
                if other is not pipe:
                    other.close()
            _serve(pipe)
            os._exit(0)
        processes.append(process)
    for pipe in pipes:
        pipe.close()
    for process in processes:
        os.waitpid(process, 0)


def _serve(pipe: Connection) -> None:
    """Answer until the other end is closed: a :class:`Branch` begins an episode.

    The answer is the name of the vehicle that is taken over and a list of ``HISTORY`` moments; then each path [STEP, 2] of
    this vehicle (s of the front bumper, d of the centre, in m), or :data:`OWN`, is answered by the next moment, until
    :data:`END`. Errors are sent as they are.
    """
    stream: tuple[int, int, str] | None = None
    streaming = _nothing()
    road: _Road | None = None
    number = -1
    while True:
        try:
            branch = pipe.recv()
        except EOFError:
            return
        try:
            if branch.stream != stream or branch.number < number:
                streaming.close()
                streaming, stream, number = _stream(branch, pipe), branch.stream, -1
            while number < branch.number:
                road = next(streaming)
                number += 1
        except EOFError:
            return
        except Exception as error:  # whatever it is, it is told to the process that waits for an answer
            stream = None
            pipe.send(error)
            continue
        child = os.fork()
        if not child:
            assert road is not None
            _episode(pipe, road, branch)
        _, status = os.waitpid(child, 0)
        if status:
            stream = None
            pipe.send(ConfigError(f"SUMO ended in an episode (status {status}) of {branch}"))


def _episode(pipe: Connection, road: _Road, branch: Branch) -> None:
    """Simulate an episode, then end this process; its status is 1 if an error could not be sent."""
    status = 1
    try:
        road.hesitate = _Hesitation(STYLES[branch.style], (branch.layout, branch.seed, branch.number))
        pipe.send((road.taken, [road.history[-1].around(road.taken, each) for each in road.history]))
        while not isinstance(path := pipe.recv(), str) or path != END:
            now = road.advance(None if isinstance(path, str) else path)
            pipe.send(now.around(road.taken, now))
        status = 0
    except (EOFError, BrokenPipeError):
        status = 0
    except Exception as error:  # as above
        pipe.send(error)
        status = 0
    finally:
        os._exit(status)


def _nothing() -> Generator[_Road]:
    yield from ()


def _closed(pipe: Connection) -> bool:
    """Whether the other end is closed, because its process closed it or was killed; messages are left where they are."""
    poll = select.poll()
    poll.register(pipe.fileno(), select.POLLHUP)
    return any(event & select.POLLHUP for _, event in poll.poll(0))


def _stream(branch: Branch, pipe: Connection) -> Generator[_Road]:
    """The simulation at the beginning of one episode after the other.

    Raises:
        ConfigError: no episode begins.
        EOFError: the other end of the connection is closed: no process waits for the episode.
    """
    layout, style = LAYOUTS[branch.layout], STYLES[branch.style]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        seed = [branch.seed, branch.layout]
        road = _Road(layout, stack.enter_context(running(layout, seed, LONGEST, folder, RATE, style)), style)
        free = WARM_UP + FILLING
        while road.time < WARM_UP + LONGEST:
            road.advance(None)
            if _closed(pipe):
                raise EOFError
            if road.time < free:
                continue
            if road.time > free + PATIENCE:
                raise ConfigError(f"no vehicle comes down the ramp of layout {layout.name}: use another seed")
            if taken := road.arriving():
                road.taken, free = taken, road.time + PAUSE
                yield road


class _Road:
    """A running simulation with the last moments.

    Attributes:
        history: the last moments, the present one last.
        taken: name of the vehicle that an episode takes over.
    """

    def __init__(self, layout: Layout, simulation: RunningSumo, style: Style) -> None:
        self.layout, self.simulation = layout, simulation
        self.history: deque[Vehicles] = deque(maxlen=HISTORY)
        self.taken = ""
        self.time = 0.0
        self.hesitate: _Hesitation | None = None
        self._style = style
        (ramp,) = {strip.join for strip in layout.lanes if np.isfinite(strip.join)}
        self._take = ramp - TAKEN
        self._types: dict[str, tuple[float, float, int]] = {}

    def advance(self, path: Float[np.ndarray, "STEP 2"] | None) -> Vehicles:
        """Simulate a step of a planner, with the vehicle that is taken over on a path or under its own driver."""
        libsumo = self.simulation.libsumo
        for substep in range(STEP):
            if path is not None:
                self._put(*path[substep])
            libsumo.simulationStep()
            self.time += 1 / RATE
            names = libsumo.vehicle.getIDList()
            if self.hesitate is None:
                brake(libsumo, names, self._style, RATE, self.simulation.random)
            else:
                self.hesitate(self.simulation, [name for name in names if name != self.taken], self.time)
        self.history.append(self._vehicles())
        return self.history[-1]

    def _vehicles(self) -> Vehicles:
        vehicle = self.simulation.libsumo.vehicle
        names, strips, rows = [], [], []
        for name in vehicle.getIDList():
            if name not in self._types:
                of_type = vehicle.getTypeID(name)
                self._types[name] = vehicle.getLength(name), vehicle.getWidth(name), kind_of(of_type)
            strip, begin = self.simulation.where[vehicle.getLaneID(name)]
            names.append(name)
            strips.append(strip)
            front, aside = begin + vehicle.getLanePosition(name), vehicle.getLateralLanePosition(name)
            rows.append((front, aside, vehicle.getSpeed(name), vehicle.getLateralSpeed(name), *self._types[name]))
        return Vehicles(names, strips, np.array(rows).reshape(-1, 7))

    def arriving(self) -> str | None:
        """The vehicle that has just come so near to the road that an episode may begin, and that has to merge."""
        if len(self.history) < HISTORY:
            return None
        before, now = self.history[-2], self.history[-1]
        at = dict(zip(before.names, before.values[:, 0] - before.values[:, 4] / 2, strict=True))
        known = set(self.history[0].names)
        for name, strip, row in zip(now.names, now.strip, now.values, strict=True):
            lane = self.layout.lanes[strip]
            merges = np.isfinite(lane.join) and lane.end < self.layout.length
            stays = self.simulation.libsumo.vehicle.getRoute(name)[-1].startswith("main")
            if merges and stays and name in known and at[name] < self._take <= row[0] - row[4] / 2:
                return str(name)
        return None

    def _put(self, front: float, d: float) -> None:
        """Move the vehicle that is taken over: its front bumper to s, and its centre to d [m]."""
        libsumo, layout = self.simulation.libsumo, self.layout
        s = front - libsumo.vehicle.getLength(self.taken) / 2
        found = [
            (abs(d - float(layout.offset(layout.lanes[strip], np.array(s)))), edge, lane, strip)
            for edge in self.simulation.edges
            if edge.begin <= front <= edge.end
            for lane, strip in enumerate(edge.strips)
        ]
        _, edge, lane, strip = min(found, key=lambda place: place[0])
        aside = d - float(layout.offset(layout.lanes[strip], np.array(s)))
        begin, end = np.array(libsumo.lane.getShape(f"{edge.name}_{lane}"))
        ahead = (end - begin) / np.linalg.norm(end - begin)
        x, y = (
            begin
            + (end - begin) * (front - edge.begin) / (edge.end - edge.begin)
            + aside * np.array((-ahead[1], ahead[0]))
        )
        angle = 90.0 - np.degrees(np.arctan2(ahead[1], ahead[0]))
        libsumo.vehicle.moveToXY(self.taken, edge.name, lane, x, y, angle, 1)


class _Hesitation:
    """Drivers brake as :func:`~epo_lightning.data.simulate.traffic.brake` says, each at moments of its own.

    The moments do not depend on which other vehicles there are, so they are the same whatever the planned vehicle does.
    """

    def __init__(self, style: Style, seed: Sequence[int]) -> None:
        self.style, self.seed = style, seed
        self._of: dict[str, tuple[np.random.Generator, float]] = {}

    def __call__(self, simulation: RunningSumo, names: Sequence[str], time: float) -> None:
        if self.style.every is None:
            return
        for name in names:
            if name not in self._of:
                random = np.random.default_rng([*self.seed, zlib.crc32(name.encode())])
                self._of[name] = random, time + random.exponential(self.style.every)
            random, when = self._of[name]
            if time >= when:
                slow_down(simulation.libsumo, name, self.style, random)
                self._of[name] = random, time + random.exponential(self.style.every)
