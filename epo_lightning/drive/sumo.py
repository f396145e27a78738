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

from epo_lightning.checks import check_whole
from epo_lightning.data.recorded.formats.lanelet2 import read_map
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.simulate.lanelets import write_map
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.data.simulate.motion import SLOWEST, strip_at
from epo_lightning.data.simulate.traffic import CLASSES, STYLES, simulator
from epo_lightning.drive.sumo_process import END, OWN, STEP, Branch, Vehicles, serve
from epo_lightning.drive.traffic import Moment, Position, TrafficWorld
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import KINDS

SEEDS = 1_000_000
"""Added to seeds of episodes, so that their traffic is that of no data set."""
MERGES = tuple(layout.id for layout in LAYOUTS if sum(np.isfinite(strip.join) for strip in layout.lanes) == 1)
"""Layouts with an on-ramp of one lane, which all vehicles on it have to leave."""
PER_STREAM = 3
"""Episodes of one simulation."""
BEYOND = 50.0
"""Distance [m] behind the end of the acceleration lane at which a vehicle has arrived."""
ASIDE = 0.3
"""Distance [m] of the centre from the nearest lane at which a vehicle is off the road."""
SECONDS = 24.0
"""Longest duration of an episode."""


def sumo_world(episodes: int, seed: int = 0, style: str = "dense") -> TrafficWorld:
    """Merges in SUMO's traffic.

    Args:
        episodes: number of episodes.
        seed: seed of their traffic; the same seed gives the same episodes.
        style: ``dense`` or ``free`` (:data:`~epo_lightning.data.simulate.traffic.STYLES`).

    Raises:
        ConfigError: a value out of its range, SUMO is not installed, or this system cannot fork.
    """
    return TrafficWorld(SumoSimulator(episodes, seed, style))


class SumoSimulator:
    """SUMO in a process of its own (:mod:`~epo_lightning.drive.sumo_process`), as a simulator of episodes.

    Consecutive episodes go through all layouts with an on-ramp, ``PER_STREAM`` of them in one simulation.

    Args:
        episodes, seed, style: as in :func:`sumo_world`.
    """

    def __init__(self, episodes: int, seed: int, style: str) -> None:
        check_whole("episodes", episodes)
        if style not in STYLES:
            raise ConfigError(f"unknown traffic {style!r} of SUMO: {nearest(str(style), tuple(STYLES))}")
        simulator()
        if not hasattr(os, "fork"):
            raise ConfigError("world=sumo branches episodes off by os.fork, which Linux and macOS have")
        self._episodes, self._seed, self._style = episodes, SEEDS + seed, style
        self.steps = round(SECONDS * 5)
        self._maps: dict[int, LaneGraph] = {}
        self._pending = False

    def __len__(self) -> int:
        return self._episodes

    @cached_property
    def _pipe(self) -> Any:
        """The connection to the process, which ends when the connection is closed."""
        context = multiprocessing.get_context("spawn")
        pipe, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other,), daemon=True)
        self._process.start()
        other.close()
        return pipe

    def _ask(self, message: Any) -> Any:
        """Send a message to the process, and return its answer.

        Raises:
            ConfigError: the process ended.
        """
        pipe = self._pipe
        try:
            pipe.send(message)
            answer = pipe.recv()
        except (EOFError, OSError):
            self._pending = False
            raise ConfigError("the process of SUMO ended: is there enough memory?") from None
        if isinstance(answer, Exception):
            self._pending = False
            raise answer
        return answer

    def branch(self, episode: int) -> Branch:
        """The stream of an episode, and its number in it."""
        stream, number = divmod(episode, PER_STREAM)
        layout = MERGES[stream % len(MERGES)]
        return Branch(layout, self._seed * 1000 + stream, self._style, number)

    def begin(self, episode: int) -> list[Moment]:
        self._end()
        branch = self.branch(episode)
        self.layout = LAYOUTS[branch.layout]
        if branch.layout not in self._maps:
            self._maps[branch.layout] = lanes_of(self.layout)
        self.lanes = self._maps[branch.layout]
        self._name, history = self._ask(branch)
        self._pending = True
        last: Vehicles = history[-1]
        ego = last.names.index(self._name)
        self._half = last.values[ego, 4] / 2
        self._ramp = self.layout.lanes[last.strip[ego]]
        self._end_of_ramp = min(self._ramp.end, self._ramp.leave)
        self._from = last.values[ego, 0] - self._half
        return [self._moment(vehicles) for vehicles in history]

    def _end(self) -> None:
        if self._pending:
            self._pending = False
            with suppress(OSError):  # the process ended, as the next message will tell
                self._pipe.send(END)

    def step(self, way: tuple[Float[np.ndarray, " 4"], Float[np.ndarray, " 4"]] | None) -> Moment:
        if way is None:
            return self._moment(self._ask(OWN))
        before, after = way
        share = np.arange(1, STEP + 1)[:, None] / STEP
        s, d = self.layout.project(before[:2] + share * (after[:2] - before[:2]))
        moment = self._moment(self._ask(np.stack([s + self._half, d], 1)))
        moment.states[0] = after
        return moment

    def _moment(self, vehicles: Vehicles) -> Moment:
        """Vehicles in the plane, by the rules of :func:`~epo_lightning.data.simulate.motion.move`; no filter."""
        if self._name not in vehicles.names:
            raise ConfigError("the planned vehicle left SUMO's network: the section ends before its road does")
        first = vehicles.names.index(self._name)
        order = [first, *(row for row in range(len(vehicles.names)) if row != first)]
        front, aside, speed, slip, length, width, kind = vehicles.values[order].T
        strip = np.array(vehicles.strip)[order]
        lanes, s = self.layout.lanes, front - length / 2
        on = [strip == index for index in range(len(lanes))]
        d = aside + np.select(on, [self.layout.offset(lane, s) for lane in lanes])
        along = np.select(on, [self.layout.direction(lane, s) for lane in lanes])
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
        on_ramp = lane is self._ramp
        return Position(
            progress=s - self._from,
            arrived=s >= self._end_of_ramp + BEYOND and not on_ramp,
            off_road=beside > ASIDE,
            line=0 if on_ramp and self._ramp.join <= s else 1,
        )

    def close(self) -> None:
        """End the process."""
        if "_pipe" in self.__dict__:
            self._end()
            self._pipe.close()
            self._process.join(timeout=10.0)
            del self.__dict__["_pipe"]


def lanes_of(layout: Layout) -> LaneGraph:
    """The map of a layout as forecasters know it: written as a Lanelet2 map, and read again."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.osm"
        write_map(layout, path)
        lanes = read_map(path, layout.origin, zone=32)
    limit = np.nan if layout.limit is None else round(layout.limit, 2)
    return replace(lanes, speed_limit=np.full(len(lanes), limit))
