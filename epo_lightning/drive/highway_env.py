"""highway-env's merge and roundabout as worlds: the other vehicles drive by its IDM and react.

- ``merge``: the planned vehicle is the one on the ramp, which has to change to the motorway before its lane ends.
- ``roundabout``: the planned vehicle is that of the environment. It enters from the south and leaves to the north.

For the first 1.8 s the planned vehicle is driven by the environment's IDM, too. Coordinates are mirrored, because
highway-env's y axis points to the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from epo_lightning.checks import check_choice
from epo_lightning.data.recorded.lanes import LANE, LaneGraph, Polylines
from epo_lightning.drive.ride import WINDOWS, Moment, Position
from epo_lightning.drive.traffic import ASIDE, PER_SEED, TOGETHER, TrafficWorld, first_seed
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, KINDS

SUBSTEPS = 3
"""Steps of 1/15 s, those of the environments, in one step of a planner."""
SPACING = 2.0
"""Largest distance [m] between two points of a line of the map."""
CLOSED = 0.5
"""Largest distance [m] of a line's end from the next one's begin that is no gap."""
MIRROR = np.array([1.0, -1.0])
Lane = tuple[str, str, int]


@dataclass(frozen=True)
class Setting:
    """Setting of the episodes in an environment.

    Attributes:
        environment: its name in gymnasium.
        vehicle: index of the planned vehicle in the environment's list.
        back: distance [m] by which it starts farther back, because it is planned 1.8 s later.
        route: nodes of the network that it passes.
        beyond: distance [m] behind the last node at which it has arrived; negative before it.
        speed: speed limit [m/s], what the traffic on the road drives at.
        seconds: longest duration.
        gap: largest gap [m] between the ends of lanes that follow one another.
        turning: share of a motorway's costs of turning that planners are told.
    """

    environment: str
    vehicle: int
    back: float
    route: tuple[str, ...]
    beyond: float
    speed: float
    seconds: float
    gap: float
    turning: float = 1.0


SETTINGS = {
    "merge": Setting(
        environment="merge-v1",
        vehicle=-1,
        back=0.0,
        route=("j", "k", "b", "c", "d"),
        beyond=-90.0,
        speed=30.0,
        seconds=20.0,
        gap=1.0,
    ),
    "roundabout": Setting(
        environment="roundabout-v1",
        vehicle=0,
        back=15.0,
        route=("ser", "ses", "se", "ex", "ee", "nx", "nxs", "nxr"),
        beyond=-117.5,
        speed=12.0,
        seconds=24.0,
        gap=8.0,
        turning=0.2,
    ),
}
"""The environments by their names in ``others``."""


def highway_env_world(episodes: int, seed: int = 0, place: str = "merge") -> TrafficWorld:
    """Episodes in an environment of highway-env.

    Args:
        episodes: number of episodes.
        seed: seed of their traffic; the same seed gives the same episodes.
        place: ``merge`` or ``roundabout``.

    Raises:
        ConfigError: a value out of its range, or highway-env is not installed.
    """
    simulator = HighwayEnvSimulator(episodes, seed, place)
    return TrafficWorld(simulator, SETTINGS[place].turning)


class HighwayEnvSimulator:
    """An environment of highway-env as a simulator of episodes.

    Args:
        episodes, seed, place: as in :func:`highway_env_world`.
    """

    together = TOGETHER

    def __init__(self, episodes: int, seed: int, place: str) -> None:
        first = first_seed("highway_env", episodes, seed, PER_SEED)
        check_choice("place", place, SETTINGS, "highway-env")
        self._episodes, self._seed, self._setting = episodes, first, SETTINGS[place]
        self._environment = _environment(self._setting.environment)
        self._environment.reset(seed=self._seed)
        self.roads = Roads(self._environment.road.network, self._setting)
        self.steps = round(self._setting.seconds / WINDOWS.dt)

    def __len__(self) -> int:
        return self._episodes

    def begin(self, episode: int) -> HighwayEnvSimulation:
        self._environment.reset(
            seed=self._seed + episode
        )  # makes a new road with vehicles and random numbers of its own
        return HighwayEnvSimulation(self._environment.road, self._setting, self.roads)

    def close(self) -> None:
        """End the environment."""
        self._environment.close()


class HighwayEnvSimulation:
    """An episode on a road of highway-env, of which the first 1.8 s are driven when it is begun.

    Args:
        road: the road with its vehicles.
        setting: setting of the episodes.
        roads: its map.
    """

    def __init__(self, road: Any, setting: Setting, roads: Roads) -> None:
        from highway_env.vehicle.behavior import IDMVehicle

        self._road, self.lanes, self._roads = road, roads.lanes, roads
        road.vehicles = [
            vehicle if isinstance(vehicle, IDMVehicle) else IDMVehicle.create_from(vehicle) for vehicle in road.vehicles
        ]
        ego = road.vehicles[setting.vehicle]
        if setting.back:
            lane = road.network.get_lane(ego.lane_index)
            ego.position = lane.position(lane.local_coordinates(ego.position)[0] - setting.back, 0.0)
            ego.on_state_update()
        road.vehicles.remove(ego)
        self._vehicles: Sequence[Any] = [ego, *road.vehicles]
        road.vehicles = list(self._vehicles)
        self._log = [self._moment()]
        for _ in range(WINDOWS.history - 1):
            self.step(None)
            self._log.append(self.moment())
        self._from = roads.position(self._log[-1].states[0], 0.0).progress

    def history(self) -> list[Moment]:
        return self._log

    def step(self, way: tuple[Float[np.ndarray, " 4"], Float[np.ndarray, " 4"]] | None) -> None:
        road, ego = self._road, self._vehicles[0]
        for substep in range(1, SUBSTEPS + 1):
            road.act()
            road.step(WINDOWS.dt / SUBSTEPS)
            if way is not None:
                x, y, heading, speed = way[0] + substep / SUBSTEPS * (way[1] - way[0])
                ego.position, ego.heading, ego.speed = np.array([x, -y]), -heading, speed
                ego.on_state_update()
        self._way = way

    def moment(self) -> Moment:
        moment = self._moment()
        if self._way is not None:
            moment.states[0] = self._way[1]
        return moment

    def _moment(self) -> Moment:
        vehicles = self._vehicles
        states = np.array([[*(vehicle.position * MIRROR), -vehicle.heading, vehicle.speed] for vehicle in vehicles])
        return Moment(
            names=[str(number) for number in range(len(vehicles))],
            states=states,
            size=np.array([[vehicle.LENGTH, vehicle.WIDTH] for vehicle in vehicles], dtype=float),
            kind=np.full(len(vehicles), KINDS.index("car")),
        )

    def position(self, state: Float[np.ndarray, " 4"]) -> Position:
        return self._roads.position(state, self._from)

    def end(self) -> None:
        """Does nothing: a road is simulated when a step is asked for."""


class Roads:
    """The map of an environment, and the way of the planned vehicle on it.

    Args:
        network: highway-env's network of lanes.
        setting: setting of the episodes.
    """

    def __init__(self, network: Any, setting: Setting) -> None:
        self.lanes = lanes_of(network, setting)
        # A lane that ends although its road goes on has to be left.
        self._ending = {
            place
            for place, (_, node, _) in enumerate(keys_of(network))
            if not self.lanes.successors[place] and network.graph.get(node)
        }
        legs = [network.get_lane((a, b, 0)) for a, b in pairwise(setting.route)]
        self._way = Polylines([np.concatenate([_line(leg, 0.0) for leg in legs])])
        self._end = self._way.length[0] + setting.beyond

    def position(self, state: Float[np.ndarray, " 4"], begin: float) -> Position:
        """Place of the planned vehicle that was at ``begin`` [m] of its way when it began."""
        along = float(self._way.project(np.zeros(1, dtype=int), state[None, :2])[0][0])
        located = self.lanes.locate(state[None, :2], state[None, HEADING])
        lane = int(located.lane[0])
        off = lane < 0
        if not off:
            width = float(np.linalg.norm(self.lanes.left[lane][0] - self.lanes.right[lane][0]))
            beyond = located.along[0] - self.lanes.centrelines.length[lane]
            off = abs(float(located.offset[0])) > width / 2 + ASIDE or (beyond > ASIDE and lane in self._ending)
        merging = lane in self._ending
        return Position(
            progress=along - begin,
            arrived=along >= self._end and not merging and not off,
            off_road=off,
            line=0 if merging else 1,
        )


def _environment(name: str) -> Any:
    try:
        import gymnasium
        import highway_env  # noqa: F401 - registers its environments
    except ImportError as error:
        raise ConfigError(
            f"world=highway_env needs highway-env ({error}): install it with `pip install 'epo_lightning[drive]'`"
        ) from None
    return gymnasium.make(name).unwrapped


def _line(lane: Any, aside: float) -> Float[np.ndarray, "n 2"]:
    """Points of a lane, or of a line beside it, to the right [m]."""
    along = np.linspace(0.0, lane.length, max(2, round(lane.length / SPACING) + 1))
    return np.array([lane.position(s, aside) for s in along], dtype=float) * MIRROR


def _joined(line: Float[np.ndarray, "n 2"], onward: Sequence[Float[np.ndarray, "m 2"]]) -> Float[np.ndarray, "n 2"]:
    """A line that ends where the next one begins, if exactly one follows behind a gap."""
    if len(onward) != 1 or np.linalg.norm(onward[0][0] - line[-1]) < CLOSED:
        return line
    return np.concatenate((line, onward[0][:1]))


def keys_of(network: Any) -> list[Lane]:
    """The lanes of a network, in the order of the map."""
    return [(a, b, i) for a, ends in network.graph.items() for b, lanes in ends.items() for i in range(len(lanes))]


def lanes_of(network: Any, setting: Setting) -> LaneGraph:
    """The map of a network. Where the planned vehicle's route goes on, a lane leads there alone."""
    keys = keys_of(network)
    index = {key: place for place, key in enumerate(keys)}
    lanes = [network.get_lane(key) for key in keys]
    drawn = [[_line(lane, side * lane.width_at(0.0) / 2) for lane in lanes] for side in (0, -1, 1)]
    centre = drawn[0]
    onward = dict(pairwise(setting.route))
    successors = []
    for place, (_, node, _) in enumerate(keys):
        follow = network.graph.get(node, {})
        follow = {onward[node]: follow[onward[node]]} if onward.get(node) in follow else follow
        found = []
        for end, beside in follow.items():
            gaps = [
                float(np.linalg.norm(centre[index[node, end, i]][0] - centre[place][-1])) for i in range(len(beside))
            ]
            if min(gaps) < setting.gap:
                found.append(index[node, end, int(np.argmin(gaps))])
        successors.append(tuple(found))
    centre, left_border, right_border = (
        [_joined(line, [lines[after] for after in found]) for line, found in zip(lines, successors, strict=True)]
        for lines in drawn
    )
    left = np.array([index.get((a, b, i - 1), -1) for a, b, i in keys])
    right = np.array([index.get((a, b, i + 1), -1) for a, b, i in keys])
    open_right = np.array([other if other >= 0 and not lanes[other].forbidden else -1 for other in right])
    return LaneGraph(
        ids=np.arange(len(keys)),
        left=left_border,
        right=right_border,
        centre=centre,
        successors=successors,
        left_of=left,
        right_of=open_right,
        adjacent_left=left,
        adjacent_right=right,
        speed_limit=np.full(len(keys), setting.speed),
        kind=np.full(len(keys), LANE),
    ).check("highway-env")
