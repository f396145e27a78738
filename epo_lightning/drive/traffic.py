"""Traffic as a world: one vehicle on a road is planned, and a simulator moves all others, which react to it.

Episodes are begun one by one. An episode ends when the planned vehicle has arrived, touches another one or leaves the
road, or when its time is over. A :class:`Simulator` knows where the vehicles are; this module makes scenes of them, moves
the planned vehicle by a unicycle and keeps the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.drive.road_game import ENERGY, road_game
from epo_lightning.drive.road_scenes import RoadScenes
from epo_lightning.drive.world import EGO, Outcome, Search
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.metrics.functional.overlap import overlaps_with
from epo_lightning.scene import HEADING, SPEED, GameParameters, Scene

WINDOWS = WindowConfig()
"""Settings of the scenes: the paper's."""
NEAR = 6
"""Number of vehicles, the nearest ones to the planned one, of which measures are taken at each moment."""
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


class Simulator(Protocol):
    """The interface of simulators of traffic, whose time step is that of :data:`WINDOWS`.

    Attributes:
        lanes: the map of the episode that was begun last.
        steps: largest number of steps of an episode.
    """

    lanes: LaneGraph
    steps: int

    def __len__(self) -> int:
        """The number of episodes."""
        ...

    def begin(self, episode: int) -> list[Moment]:
        """Begin an episode: its history, with the present moment last."""
        ...

    def step(self, way: tuple[Float[np.ndarray, " 4"], Float[np.ndarray, " 4"]] | None) -> Moment:
        """The next moment; the planned vehicle moves from one state to the next, or by its own driver."""
        ...

    def position(self, state: Float[np.ndarray, " 4"]) -> Position:
        """Place of the planned vehicle on its way."""
        ...

    def close(self) -> None:
        """End the simulation."""
        ...


class TrafficWorld:
    """Episodes of a simulator.

    Args:
        simulator: the simulator, which the world closes.
    """

    shape = "box"
    energy = ENERGY
    arrived = float("inf")
    patience = 10.0
    together = 1
    search = Search(steps=25, accelerations=(-3.0,))

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self._scenes: dict[int, RoadScenes] = {}

    def __len__(self) -> int:
        return len(self.simulator)

    def close(self) -> None:
        self.simulator.close()

    def reset(self, episodes: Sequence[int]) -> None:
        (episode,) = episodes
        self._log = self.simulator.begin(episode)
        self._begun = len(self._log) - 1
        lanes = self.simulator.lanes
        self._make = self._scenes.setdefault(id(lanes), RoadScenes(lanes, WINDOWS))
        self._members: list[str] = []
        self._positions = [self.simulator.position(self._log[-1].states[EGO])]
        self._contact: tuple[bool, bool] = (False, False)

    @property
    def finished(self) -> bool:
        now = self._positions[-1]
        late = len(self._positions) > self.simulator.steps
        return now.arrived or now.off_road or self._contact[0] or late

    def observe(self) -> Scene:
        """The planned vehicle and its nearest neighbours; a neighbour keeps its place in the scene while it is one."""
        now = self._log[-1]
        rows = {name: row for row, name in enumerate(now.names)}
        self._members = self._arranged(self._neighbours(now))
        count, steps = WINDOWS.agents, WINDOWS.history
        history, seen = np.zeros((count, steps, 4)), np.zeros((count, steps), dtype=bool)
        size, kind = np.zeros((count, 2)), np.zeros(count, dtype=np.int64)
        for place, name in enumerate(self._members):
            if not name:
                continue
            size[place], kind[place] = now.size[rows[name]], now.kind[rows[name]]
            for step, moment in enumerate(self._log[-steps:], steps - min(steps, len(self._log))):
                if name in moment.names:
                    history[place, step] = moment.states[moment.names.index(name)]
                    seen[place, step] = True
            heading = history[place, seen[place], HEADING]
            history[place, seen[place], HEADING] = np.unwrap(heading)
        return self._make(history, seen, np.array([bool(name) for name in self._members]), size, kind)

    def _neighbours(self, now: Moment) -> list[str]:
        """The vehicles on a lane that are nearest to where the planned one is, or would be in a moment at its velocity."""
        x, y, heading, speed = now.states[EGO]
        soon = np.array([x, y]) + SOON * speed * np.array([np.cos(heading), np.sin(heading)])
        distance = np.linalg.norm(now.states[:, :2] - now.states[EGO, :2], axis=1)
        distance = np.minimum(distance, np.linalg.norm(now.states[:, :2] - soon, axis=1))
        order = [row for row in np.argsort(distance, kind="stable") if row != EGO]
        near = [row for row in order if distance[row] <= RADIUS]
        near = near[: 2 * WINDOWS.agents]
        on = self._make.on_lanes(now.states[near]) if near else ()
        return [now.names[row] for row, there in zip(near, on, strict=True) if there][: WINDOWS.agents - 1]

    def _arranged(self, neighbours: list[str]) -> list[str]:
        """Names by place in the scene; empty for no vehicle."""
        places = [name if name in neighbours else "" for name in self._members[1:]] or [""] * (WINDOWS.agents - 1)
        new = [name for name in neighbours if name not in places]
        return [self._log[-1].names[EGO], *(name or (new.pop(0) if new else "") for name in places)]

    def game(self, scene: Scene) -> GameParameters:
        return road_game(scene, self._positions[-1].line, WINDOWS.horizon)

    def advance(self, controls: Tensor | None) -> None:
        now = self._log[-1].states[EGO]
        way = None
        if controls is not None:
            steps = controls.detach().double().view(1, 2)
            way = (now, Unicycle().rollout(torch.tensor(now), steps, WINDOWS.dt)[0].numpy())
        moment = self.simulator.step(way)
        self._log.append(moment)
        self._positions.append(self.simulator.position(moment.states[EGO]))
        self._contact = _contact(moment)

    def outcome(self) -> Outcome:
        """States of the planned vehicle and of all that were among the nearest ones.

        Further measures: whether the vehicle ``arrives``, is ``hit from behind`` or leaves the road (``off_road``), and its
        mean ``speed`` [m/s].
        """
        moments = self._log[self._begun :]
        names = [moments[0].names[EGO]]
        for moment in moments:
            distance = np.linalg.norm(moment.states[:, :2] - moment.states[EGO, :2], axis=1)
            names += [moment.names[row] for row in np.argsort(distance)[1 : NEAR + 1]]
        names = list(dict.fromkeys(names))
        index = {name: place for place, name in enumerate(names)}
        count = max(2, len(names))
        states, mask = np.zeros((count, len(moments), 4)), np.zeros((count, len(moments)), dtype=bool)
        size = np.ones((count, 2))
        for t, moment in enumerate(moments):
            for row, name in enumerate(moment.names):
                if (place := index.get(name)) is not None:
                    states[place, t], mask[place, t], size[place] = moment.states[row], True, moment.size[row]
        states[EGO, :, HEADING] = np.unwrap(states[EGO, :, HEADING])
        last = self._positions[-1]
        shares = {"arrived": last.arrived, "hit_from_behind": self._contact[1], "off_road": last.off_road}
        progress = torch.tensor([position.progress for position in self._positions], dtype=torch.double)
        lanes = self.simulator.lanes
        return Outcome(
            states=torch.tensor(states)[None],
            agent_mask=torch.tensor(mask)[None],
            size=torch.tensor(size)[None],
            progress=progress[None],
            measures={
                **{name: torch.tensor([float(value)], dtype=torch.double) for name, value in shares.items()},
                "speed": torch.tensor(states[EGO, :, SPEED].mean())[None],
            },
            rates=frozenset(shares),
            lines=tuple(torch.tensor(line) for side in (lanes.left, lanes.right) for line in side),
        )


def _contact(moment: Moment) -> tuple[bool, bool]:
    """Whether the planned vehicle touches another one, and whether all of these are behind it."""
    states = torch.tensor(moment.states)[None, :, None]
    there = torch.ones(1, len(moment.names), dtype=torch.bool)
    touch = overlaps_with(EGO, states, torch.tensor(moment.size)[None], there, "box")[0, :, 0].numpy()
    if not touch.any():
        return False, False
    x, y, heading, _ = moment.states[EGO]
    ahead = (moment.states[1:, 0] - x) * np.cos(heading) + (moment.states[1:, 1] - y) * np.sin(heading)
    behind: Bool[np.ndarray, " n"] = ahead[touch] < BEHIND * moment.size[EGO, 0]
    return True, bool(behind.all())
