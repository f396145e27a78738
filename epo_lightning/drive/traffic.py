"""Traffic as a world: one vehicle on a road is planned, and a simulator moves all others, which react to it.

An episode ends when the planned vehicle has arrived, touches another one or leaves the road, or when its time is over. A
:class:`Simulator` begins episodes, each with a :class:`~epo_lightning.drive.ride.Simulation` that knows where the vehicles
are and a :class:`~epo_lightning.drive.ride.Ride` that keeps the record. This module makes one batch of scenes of all of
them, and moves the planned vehicles by a unicycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from epo_lightning.checks import check_whole
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.road_scenes import RoadScenes
from epo_lightning.drive.ride import WINDOWS, Ride, Simulation, contacts
from epo_lightning.drive.road_game import ENERGY, road_game
from epo_lightning.drive.world import EGO, SEEDS, Outcome, Search
from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, SPEED, Scene

NEAR = 6
"""Number of vehicles, the nearest ones to the planned one, of which measures are taken at each moment."""
PER_SEED = 1000
"""Number of simulator seeds that one seed of the world may use."""
TOGETHER = 25
"""Number of episodes that are driven together."""
ASIDE = 0.3
"""Distance [m] of the centre from the nearest lane at which a vehicle is off the road."""


class Simulator(Protocol):
    """The interface of simulators of traffic, whose time step is that of :data:`~epo_lightning.drive.ride.WINDOWS`.

    Attributes:
        together: largest number of consecutive episodes that can be begun together.
        steps: largest number of steps of an episode.
    """

    together: int
    steps: int

    def __len__(self) -> int:
        """The number of episodes."""
        ...

    def begin(self, episode: int) -> Simulation:
        """Begin an episode; those that were begun before go on until their ``end``."""
        ...

    def close(self) -> None:
        """End the simulator."""
        ...


def first_seed(world: str, episodes: int, seed: int, most: int) -> int:
    """The first simulator seed of a world's seed, after a check of the number of episodes.

    Args:
        world: name of the world, for the message.
        episodes: number of episodes.
        seed: seed of the world.
        most: largest number of episodes of one seed.

    Raises:
        ConfigError: no whole number of episodes, or more than ``most``.
    """
    check_whole("episodes", episodes)
    if episodes > most:
        raise ConfigError(
            f"episodes must be {most} or fewer in world={world}, not {episodes}: further ones are those of the next seed; "
            "drive several seeds"
        )
    return (SEEDS + seed) * PER_SEED


class TrafficWorld:
    """Episodes of a simulator.

    Args:
        simulator: the simulator, which the world closes.
        turning: share of a motorway's costs of turning that planners are told.
    """

    dt = WINDOWS.dt
    agents = WINDOWS.agents
    shape = "box"
    energy = ENERGY
    arrived = float("inf")
    patience = 10.0
    search = Search(steps=25, accelerations=(-3.0,))

    def __init__(self, simulator: Simulator, turning: float = 1.0) -> None:
        self.simulator, self.turning = simulator, turning
        self.together = simulator.together
        self.rides: list[Ride] = []
        self._scenes: dict[int, RoadScenes] = {}

    def __len__(self) -> int:
        return len(self.simulator)

    def close(self) -> None:
        self._end()
        self.simulator.close()

    def _end(self) -> None:
        for ride in self.rides:
            ride.simulation.end()

    def reset(self, episodes: Sequence[int]) -> None:
        self._end()
        begun = [self.simulator.begin(episode) for episode in episodes]
        self.rides = [Ride(simulation, self.simulator.steps) for simulation in begun]

    @property
    def going(self) -> Int[Tensor, " b"]:
        return torch.tensor([index for index, ride in enumerate(self.rides) if not ride.over], dtype=torch.long)

    def _left(self) -> list[Ride]:
        return [ride for ride in self.rides if not ride.over]

    def observe(self) -> Scene:
        """The planned vehicles with their nearest neighbours; a neighbour keeps its place in the scene while it is one."""
        rides = self._left()
        maps: dict[int, list[int]] = {}
        for index, ride in enumerate(rides):
            maps.setdefault(id(ride.simulation.lanes), []).append(index)
        scenes = [self._on_one_map([rides[index] for index in chosen]) for chosen in maps.values()]
        order = torch.tensor([index for chosen in maps.values() for index in chosen])
        return Scene.concatenated(scenes)[order.argsort()]

    def _on_one_map(self, rides: Sequence[Ride]) -> Scene:
        """Scenes of episodes on one map, which are made together."""
        make = self._maker(rides[0].simulation.lanes)
        near = [ride.near() for ride in rides]
        on = make.on_lanes(np.concatenate([ride.now.states[rows] for ride, rows in zip(rides, near, strict=True)]))
        ends = np.cumsum([len(rows) for rows in near])[:-1]
        for ride, rows, there in zip(rides, near, np.split(on, ends), strict=True):
            ride.choose(rows[there])
        history, seen, there, size, kind = map(np.stack, zip(*(ride.history() for ride in rides), strict=True))
        return make(history, size, seen, there, kind, framed=WINDOWS.agents, on_lanes_only=False)

    def _maker(self, lanes: LaneGraph) -> RoadScenes:
        if id(lanes) not in self._scenes:
            self._scenes[id(lanes)] = RoadScenes(lanes, WINDOWS)
        return self._scenes[id(lanes)]

    def game(self, scene: Scene) -> GameParameters:
        lines = torch.tensor([ride.positions[-1].line for ride in self._left()])
        return road_game(scene, lines, WINDOWS.horizon, self.turning)

    def advance(self, controls: Float[Tensor, "b 2"] | None) -> None:
        rides = self._left()
        if controls is None:
            for ride in rides:
                ride.simulation.step(None)
        else:
            now = np.stack([ride.now.states[EGO] for ride in rides])
            steps = controls.detach().double()[:, None]
            after = Unicycle().rollout(torch.as_tensor(now), steps, self.dt)[:, 0].numpy()
            for ride, *way in zip(rides, now, after, strict=True):
                ride.simulation.step((way[0], way[1]))
        moments = [ride.simulation.moment() for ride in rides]
        for ride, moment, contact in zip(rides, moments, contacts(moments), strict=True):
            ride.record(moment, contact)

    def outcome(self) -> Outcome:
        """States of the planned vehicle and of all that were among the nearest ones.

        Further measures: whether the vehicle ``arrives``, is ``hit from behind`` or leaves the road (``off_road``), and its
        mean ``speed`` [m/s].
        """
        tracks = [ride.tracks(NEAR) for ride in self.rides]
        most, steps = (max(each.shape[axis] for each, _, _ in tracks) for axis in (0, 1))
        batch, most = len(tracks), max(2, most)
        states, mask = np.zeros((batch, most, steps, 4)), np.zeros((batch, most, steps), dtype=bool)
        size, progress = np.ones((batch, most, 2)), np.zeros((batch, steps))
        for index, (ride, (track, there, extent)) in enumerate(zip(self.rides, tracks, strict=True)):
            count, end = there.shape
            states[index, :count, :end], states[index, :count, end:] = track, track[:, -1:]
            mask[index, :count, :end], size[index, :count] = there, extent
            progress[index] = [ride.positions[min(t, end - 1)].progress for t in range(steps)]
        states[:, EGO, :, HEADING] = np.unwrap(states[:, EGO, :, HEADING])
        shares = {
            "arrived": [ride.positions[-1].arrived for ride in self.rides],
            "hit_from_behind": [ride.contact.from_behind for ride in self.rides],
            "off_road": [ride.positions[-1].off_road for ride in self.rides],
        }
        speed = [track[EGO, :, SPEED].mean() for track, _, _ in tracks]
        lanes = self.rides[0].simulation.lanes
        return Outcome(
            states=torch.tensor(states),
            agent_mask=torch.tensor(mask),
            size=torch.tensor(size),
            progress=torch.tensor(progress),
            measures={
                name: torch.tensor(values, dtype=torch.double) for name, values in {**shares, "speed": speed}.items()
            },
            rates=frozenset(shares),
            lines=tuple(torch.tensor(line) for side in (lanes.left, lanes.right) for line in side),
        )
