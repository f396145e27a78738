"""The record of one episode in traffic: where the vehicles were, which ones a planner sees, and whether it is over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.drive.world import EGO
from epo_lightning.metrics.functional.overlap import overlaps_with
from epo_lightning.scene import HEADING

WINDOWS = WindowConfig()
"""Settings of the scenes: the paper's."""
SEEN = 8
"""Number of agents in a scene, the planned vehicle included. Forecasters are shown those of a window, the first ones."""
RADIUS = 2 * (WINDOWS.radius or np.inf)
"""Largest distance [m] of a neighbour: members of a window are within its radius of one of them, not of each."""
SOON = 1.0
"""Time [s] ahead: neighbours are also those near the place where the planned vehicle would be then."""
BEHIND = -0.25
"""A vehicle whose centre is farther behind the planned one's than this share of its length hits it from behind."""


@dataclass(frozen=True)
class Moment:
    """All vehicles at one moment; the planned one is first.

    Attributes:
        names: names of the vehicles, which stay the same during an episode.
        states: x, y [m], heading [rad], speed [m/s].
        size: length and width [m].
        kind: classes, indices into :data:`~epo_lightning.scene.KINDS`.
    """

    names: Sequence[str]
    states: Float[np.ndarray, "n 4"]
    size: Float[np.ndarray, "n 2"]
    kind: Int[np.ndarray, " n"]

    @cached_property
    def rows(self) -> Mapping[str, int]:
        """Row of every vehicle by name."""
        return {name: row for row, name in enumerate(self.names)}

    @cached_property
    def distance(self) -> Float[np.ndarray, " n"]:
        """Distance [m] of the centres from that of the planned vehicle."""
        return np.asarray(np.linalg.norm(self.states[:, :2] - self.states[EGO, :2], axis=1))


@dataclass(frozen=True)
class Position:
    """Place of the planned vehicle on its way.

    Attributes:
        progress: distance [m] along the road from where it began.
        arrived: whether it has reached the end of the section on a lane that goes on.
        off_road: whether its centre is off all lanes.
        line: index of the reference line that it wants to follow: the lane on the left (0), its own (1) or on the right (2).
    """

    progress: float
    arrived: bool
    off_road: bool
    line: int


class Simulation(Protocol):
    """The interface of an episode that a simulator has begun.

    Simulations may work at the same time: beginning an episode or a step does not wait for its result.

    Attributes:
        lanes: the map.
    """

    lanes: LaneGraph

    def history(self) -> list[Moment]:
        """Moments before the first step, with the present one last; asked for once."""
        ...

    def step(self, way: tuple[Float[np.ndarray, " 4"], Float[np.ndarray, " 4"]] | None) -> None:
        """Begin a step in which the planned vehicle moves from one state to the next, or by its own driver."""
        ...

    def moment(self) -> Moment:
        """The moment at the end of the step that was begun last; asked for once per step."""
        ...

    def position(self, state: Float[np.ndarray, " 4"]) -> Position:
        """Place of the planned vehicle on its way."""
        ...

    def end(self) -> None:
        """End the episode; may be called again."""
        ...


@dataclass(frozen=True)
class Contact:
    """Whether the planned vehicle touches another one, and whether all that it touches are behind it."""

    touches: bool = False
    from_behind: bool = False


class Ride:
    """An episode in traffic.

    Args:
        simulation: the simulation, which is ended when the episode is over.
        steps: largest number of steps.

    Attributes:
        positions: places of the planned vehicle, from the first planned moment on.
        contact: the contact that ended the episode.
    """

    def __init__(self, simulation: Simulation, steps: int) -> None:
        self.simulation, self.steps = simulation, steps
        self._log = simulation.history()
        self._begun = len(self._log) - 1
        self._members = [self.now.names[EGO], *[""] * (SEEN - 1)]
        self.positions = [simulation.position(self.now.states[EGO])]
        self.contact = Contact()

    @property
    def now(self) -> Moment:
        """The present moment."""
        return self._log[-1]

    @property
    def over(self) -> bool:
        """Whether the episode is over."""
        now = self.positions[-1]
        return now.arrived or now.off_road or self.contact.touches or len(self.positions) > self.steps

    def near(self) -> Int[np.ndarray, " n"]:
        """Rows of the vehicles that may be neighbours, nearest first.

        The distance is that from where the planned vehicle is, or would be in a moment at its velocity.
        """
        now = self.now
        x, y, heading, speed = now.states[EGO]
        soon = np.array([x, y]) + SOON * speed * np.array([np.cos(heading), np.sin(heading)])
        distance = np.minimum(now.distance, np.linalg.norm(now.states[:, :2] - soon, axis=1))
        order = np.argsort(distance, kind="stable")
        return order[(order != EGO) & (distance[order] <= RADIUS)][: 2 * SEEN]

    def choose(self, rows: Int[np.ndarray, " n"]) -> None:
        """Take the first of some vehicles, nearest first, as neighbours.

        A forecaster knows the nearest ones, and the others follow. Within these two groups a neighbour keeps its place.
        """
        names = [self.now.names[row] for row in rows]
        known = WINDOWS.agents
        groups = ((1, known, names[: known - 1]), (known, SEEN, names[known - 1 : SEEN - 1]))
        for first, last, chosen in groups:
            places = [name if name in chosen else "" for name in self._members[first:last]]
            new = [name for name in chosen if name not in places]
            self._members[first:last] = [name or (new.pop(0) if new else "") for name in places]

    def history(
        self,
    ) -> tuple[
        Float[np.ndarray, "N H 4"],
        Bool[np.ndarray, "N H"],
        Bool[np.ndarray, " N"],
        Float[np.ndarray, "N 2"],
        Int[np.ndarray, " N"],
    ]:
        """History of the planned vehicle and its neighbours: states, observed steps, presence, sizes and classes."""
        steps, now = WINDOWS.history, self.now
        history, seen = np.zeros((SEEN, steps, 4)), np.zeros((SEEN, steps), dtype=bool)
        size, kind = np.zeros((SEEN, 2)), np.zeros(SEEN, dtype=np.int64)
        for place, name in enumerate(self._members):
            if not name:
                continue
            row = now.rows[name]
            size[place], kind[place] = now.size[row], now.kind[row]
            for step, moment in enumerate(self._log[-steps:], steps - min(steps, len(self._log))):
                if (before := moment.rows.get(name)) is not None:
                    history[place, step] = moment.states[before]
                    seen[place, step] = True
            history[place, seen[place], HEADING] = np.unwrap(history[place, seen[place], HEADING])
        return history, seen, np.array([bool(name) for name in self._members]), size, kind

    def record(self, moment: Moment, contact: Contact) -> None:
        """Record the next moment, and end the simulation if the episode is over then."""
        self._log.append(moment)
        self.positions.append(self.simulation.position(moment.states[EGO]))
        self.contact = contact
        if self.over:
            self.simulation.end()

    def tracks(
        self, near: int
    ) -> tuple[Float[np.ndarray, "N T+1 4"], Bool[np.ndarray, "N T+1"], Float[np.ndarray, "N 2"]]:
        """States, masks and sizes of the planned vehicle and of all that were among the ``near`` nearest ones."""
        moments = self._log[self._begun :]
        names = dict.fromkeys([moments[0].names[EGO]])
        for moment in moments:
            names.update(dict.fromkeys(moment.names[row] for row in np.argsort(moment.distance)[1 : near + 1]))
        states, mask = np.zeros((len(names), len(moments), 4)), np.zeros((len(names), len(moments)), dtype=bool)
        size = np.ones((len(names), 2))
        for place, name in enumerate(names):
            for t, moment in enumerate(moments):
                if (row := moment.rows.get(name)) is not None:
                    states[place, t], mask[place, t], size[place] = moment.states[row], True, moment.size[row]
        return states, mask, size


def contacts(moments: Sequence[Moment]) -> list[Contact]:
    """The contact of the planned vehicle at each of some moments."""
    # Bodies that touch are nearer than half of their diagonals together.
    reach = [np.linalg.norm(moment.size, axis=1) / 2 for moment in moments]
    near = [np.flatnonzero(each.distance <= far + far[EGO]) for each, far in zip(moments, reach, strict=True)]
    most = max(2, *map(len, near))
    states, size = torch.zeros(len(moments), most, 1, 4, dtype=torch.double), torch.ones(len(moments), most, 2)
    there = torch.zeros(len(moments), most, dtype=torch.bool)
    for index, (moment, rows) in enumerate(zip(moments, near, strict=True)):
        states[index, : len(rows), 0] = torch.as_tensor(moment.states[rows])
        size[index, : len(rows)] = torch.as_tensor(moment.size[rows])
        there[index, : len(rows)] = True
    touch = overlaps_with(EGO, states, size.double(), there, "box")[..., 0]
    offset = (states[:, 1:, 0, :2] - states[:, :1, 0, :2]).numpy()
    heading = states[:, :1, 0, HEADING].numpy()
    ahead = offset[..., 0] * np.cos(heading) + offset[..., 1] * np.sin(heading)
    behind = torch.as_tensor(ahead) < BEHIND * size[:, :1, 0]
    return [
        Contact(bool(each.any()), bool(each.any() and back[each].all()))
        for each, back in zip(touch, behind, strict=True)
    ]
