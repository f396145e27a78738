"""SUMO's motorway ramps as a world: the planned vehicle comes down an on-ramp and has to merge, and SUMO's drivers react.

The layouts and the traffic are those of ``data=highway_sim`` and ``data=highway_sim_dense``, under other seeds. Every
episode takes over a vehicle of the traffic, so its history is one that SUMO's driver has driven. It has arrived 50 m behind
the end of the acceleration lane, on another lane than this one.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from epo_lightning.checks import check_choice
from epo_lightning.data.recorded.formats.lanelet2 import read_map
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.simulate.demand import CLASSES, STYLES
from epo_lightning.data.simulate.lanelets import write_map
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.data.simulate.motion import SLOWEST, strip_at
from epo_lightning.data.simulate.traffic import simulator
from epo_lightning.drive.ride import WINDOWS, Moment, Position
from epo_lightning.drive.sumo_process import END, OWN, STEP, Branch, Vehicles, serve
from epo_lightning.drive.traffic import ASIDE, PER_SEED, TOGETHER, TrafficWorld, first_seed
from epo_lightning.registry import ConfigError
from epo_lightning.scene import KINDS

MERGES = tuple(layout.id for layout in LAYOUTS if sum(np.isfinite(strip.join) for strip in layout.lanes) == 1)
"""Layouts with an on-ramp of one lane, which all vehicles on it have to leave."""
PER_STREAM = 4
"""Episodes of one simulation."""
BEYOND = 50.0
"""Distance [m] behind the end of the acceleration lane at which a vehicle has arrived."""
SECONDS = 24.0
"""Longest duration of an episode."""
ENDED = "the process of SUMO ended: is there enough memory?"
"""Message of the error that is raised when a connection breaks."""


def sumo_world(episodes: int, seed: int = 0, style: str = "dense") -> TrafficWorld:
    """Merges in SUMO's traffic.

    Args:
        episodes: number of episodes.
        seed: seed of their traffic; the same seed gives the same episodes.
        style: ``dense`` or ``free`` (:data:`~epo_lightning.data.simulate.demand.STYLES`).

    Raises:
        ConfigError: a value out of its range, SUMO is not installed, or this system cannot fork.
    """
    return TrafficWorld(SumoSimulator(episodes, seed, style))


class SumoSimulator:
    """SUMO in processes of its own (:mod:`~epo_lightning.drive.sumo_process`), as a simulator of episodes.

    ``TOGETHER`` simulations run side by side, on all layouts with an on-ramp. Each has one of as many consecutive episodes,
    and another one of the next; after ``PER_STREAM`` episodes a new simulation follows.

    Args:
        episodes, seed, style: as in :func:`sumo_world`.
    """

    together = TOGETHER

    def __init__(self, episodes: int, seed: int, style: str) -> None:
        first = first_seed("sumo", episodes, seed, PER_SEED * PER_STREAM)
        check_choice("traffic", style, STYLES, "SUMO")
        simulator()
        if not hasattr(os, "fork"):
            raise ConfigError("world=sumo branches episodes off by os.fork, which Linux and macOS have")
        self._episodes, self._seed, self._style = episodes, first, style
        self.steps = round(SECONDS / WINDOWS.dt)
        self._maps: dict[int, LaneGraph] = {}

    def __len__(self) -> int:
        return self._episodes

    @cached_property
    def _pipes(self) -> list[Any]:
        """Connections to the processes, which end when these are closed."""
        context = multiprocessing.get_context("spawn")
        pipes, others = zip(*(context.Pipe() for _ in range(min(TOGETHER, self._episodes))), strict=True)
        self._process = context.Process(target=serve, args=(others,), daemon=True)
        self._process.start()
        for other in others:
            other.close()
        return list(pipes)

    def branch(self, episode: int) -> Branch:
        """The stream of an episode, and its number in it."""
        round_, place = divmod(episode, TOGETHER)
        turn, number = divmod(round_, PER_STREAM)
        stream = turn * TOGETHER + place
        layout = MERGES[stream % len(MERGES)]
        return Branch(layout, self._seed + stream, self._style, number)

    def begin(self, episode: int) -> SumoSimulation:
        """Begin an episode. Episodes of one process, such as 0 and ``TOGETHER``, cannot be begun together."""
        branch = self.branch(episode)
        if branch.layout not in self._maps:
            self._maps[branch.layout] = lanes_of(LAYOUTS[branch.layout])
        return SumoSimulation(self._pipes[episode % TOGETHER], branch, self._maps[branch.layout])

    def close(self) -> None:
        """End the processes."""
        if "_pipes" in self.__dict__:
            for pipe in self._pipes:
                pipe.close()
            self._process.join(timeout=10.0)
            del self.__dict__["_pipes"]


class SumoSimulation:
    """An episode in SUMO, in the process at the other end of a connection.

    Args:
        pipe: the connection.
        branch: name of the episode.
        lanes: the map.

    Raises:
        ConfigError: the process ended, or SUMO failed.
    """

    def __init__(self, pipe: Any, branch: Branch, lanes: LaneGraph) -> None:
        self.layout, self.lanes = LAYOUTS[branch.layout], lanes
        self._pipe, self._going = pipe, True
        self._to: Float[np.ndarray, " 4"] | None = None
        self._ask(branch)

    def history(self) -> list[Moment]:
        self._name, history = self._answer()
        last: Vehicles = history[-1]
        ego = last.names.index(self._name)
        self._half = last.values[ego, 4] / 2
        self.ramp = self.layout.lanes[last.strip[ego]]
        self._end_of_ramp = min(self.ramp.end, self.ramp.leave)
        self._from = last.values[ego, 0] - self._half
        return [self._moment(vehicles) for vehicles in history]

    def _ask(self, message: Any) -> None:
        """Send a message to the process.

        Raises:
            ConfigError: the process ended.
        """
        try:
            self._pipe.send(message)
        except OSError:
            self._going = False
            raise ConfigError(ENDED) from None

    def _answer(self) -> Any:
        """The answer of the process.

        Raises:
            ConfigError: the process ended, or SUMO failed.
        """
        try:
            answer = self._pipe.recv()
        except (EOFError, OSError):
            self._going = False
            raise ConfigError(ENDED) from None
        if isinstance(answer, Exception):
            self._going = False
            raise answer
        return answer

    def end(self) -> None:
        if self._going:
            self._going = False
            with suppress(OSError):  # the process ended, as the next message will tell
                self._pipe.send(END)

    def step(self, way: tuple[Float[np.ndarray, " 4"], Float[np.ndarray, " 4"]] | None) -> None:
        if way is None:
            self._to = None
            self._ask(OWN)
            return
        before, self._to = way
        share = np.arange(1, STEP + 1)[:, None] / STEP
        s, d = self.layout.project(before[:2] + share * (self._to[:2] - before[:2]))
        self._ask(np.stack([s + self._half, d], 1))

    def moment(self) -> Moment:
        moment = self._moment(self._answer())
        if self._to is not None:
            moment.states[0] = self._to
        return moment

    def _moment(self, vehicles: Vehicles) -> Moment:
        """Vehicles in the plane, by the rules of :func:`~epo_lightning.data.simulate.motion.move`; no filter."""
        if self._name not in vehicles.names:
            raise ConfigError("the planned vehicle left SUMO's network: the section ends before its road does")
        first = vehicles.names.index(self._name)
        order = [first, *(row for row in range(len(vehicles.names)) if row != first)]
        front, aside, speed, slip, length, width, kind = vehicles.values[order].T
        strip = np.array(vehicles.strip)[order]
        s = front - length / 2
        on = [(self.layout.lanes[index], strip == index) for index in np.unique(strip)]
        d, along = aside.copy(), np.zeros_like(aside)
        for lane, here in on:
            d[here] += self.layout.offset(lane, s[here])
            along[here] = self.layout.direction(lane, s[here])
        ahead = speed * self.layout.stretch(s, d)
        heading = along + np.arctan2(slip, np.maximum(ahead, SLOWEST))
        kinds = np.array([KINDS.index(CLASSES[int(each)]) for each in kind])
        return Moment(
            names=[vehicles.names[row] for row in order],
            states=np.column_stack([self.layout.locate(s, d), heading, np.hypot(ahead, slip)]),
            size=np.column_stack([length, width]),
            kind=kinds,
        )

    def position(self, state: Float[np.ndarray, " 4"]) -> Position:
        s, d = (float(value) for value in self.layout.project(state[:2]))
        at = np.array([s])
        lane = self.layout.lanes[int(strip_at(self.layout, at, np.array([d]))[0])]
        beside = abs(d - float(self.layout.offset(lane, at)[0])) - self.layout.width / 2
        on_ramp = lane is self.ramp
        return Position(
            progress=s - self._from,
            arrived=s >= self._end_of_ramp + BEYOND and not on_ramp and beside <= ASIDE,
            off_road=beside > ASIDE,
            line=0 if on_ramp and self.ramp.join <= s else 1,
        )


def lanes_of(layout: Layout) -> LaneGraph:
    """The map of a layout as forecasters know it: written as a Lanelet2 map, and read again."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.osm"
        write_map(layout, path)
        lanes = read_map(path, layout.origin, zone=32)
    limit = np.nan if layout.limit is None else round(layout.limit, 2)
    return replace(lanes, speed_limit=np.full(len(lanes), limit))
