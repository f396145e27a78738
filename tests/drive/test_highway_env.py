"""highway-env's merge and roundabout as worlds: maps, histories, and drivers that react."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

import epo_lightning
from epo_lightning.data.recorded.road_scenes import RoadScenes
from epo_lightning.drive import highway_env
from epo_lightning.drive.episodes import play
from epo_lightning.drive.highway_env import HighwayEnvSimulator, highway_env_world
from epo_lightning.drive.measures import measure
from epo_lightning.drive.planners import ForecastPlanner, ResponsePlanner, first_agents
from epo_lightning.drive.ride import SEEN, WINDOWS
from epo_lightning.drive.traffic import TrafficWorld
from epo_lightning.registry import ConfigError
from epo_lightning.scene import FIELDS

pytest.importorskip("highway_env", reason="the extra `drive` is not installed")
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module", params=["merge", "roundabout"])
def world(request: pytest.FixtureRequest) -> TrafficWorld:
    return highway_env_world(3, seed=1, place=request.param)


def test_vehicles_are_on_the_lanes_of_the_map(world: TrafficWorld) -> None:
    world.reset([0])
    scene = world.observe()
    assert scene.history.shape == (1, SEEN, 10, 4)
    assert bool(scene.history_mask[:, 0].all())
    (ride,) = world.rides
    lanes, moment = ride.simulation.lanes, ride.now
    located = lanes.locate(moment.states[:, :2], moment.states[:, 2])
    assert (located.lane >= 0).all()
    assert np.abs(located.offset).max() < 2.0
    _, tangent = lanes.centrelines.at(located.lane, located.along)
    turned = moment.states[:, 2] - np.arctan2(tangent[:, 1], tangent[:, 0])
    assert np.abs(np.sin(turned)).max() < 0.6, "headings are mirrored with the map"
    assert np.cos(turned).min() > 0.8


def test_forecasters_are_shown_the_nearest_vehicles_alone(world: TrafficWorld) -> None:
    """What a forecaster sees does not depend on how many more vehicles a response sees."""
    world.reset([0])
    scene, (ride,) = world.observe(), world.rides
    assert int(scene.agent_mask.sum()) > WINDOWS.agents, "a response sees more"
    near = first_agents(scene, world.agents)
    assert near.agent_mask.shape == (1, WINDOWS.agents)
    history, seen, there, size, kind = (values[None, : WINDOWS.agents] for values in ride.history())
    alone = RoadScenes(ride.simulation.lanes, WINDOWS)(history, size, seen, there, kind)
    for name in FIELDS:
        torch.testing.assert_close(getattr(near, name), getattr(alone, name))
    distance = ride.now.distance[[ride.now.rows[name] for name in ride._members if name]]
    assert distance[1 : WINDOWS.agents].max() <= distance[WINDOWS.agents :].max()


def test_other_drivers_see_where_the_planned_vehicle_was_put(world: TrafficWorld) -> None:
    world.reset([0])
    simulation = world.rides[0].simulation
    now = simulation.moment().states[0]
    after = now + np.array([1.0, 0.5, 0.2, 0.3])
    simulation.step((now, after))
    vehicle = simulation._vehicles[0]
    x, y = vehicle.position
    seen = np.array([x, -y, -vehicle.heading, vehicle.speed])  # y and turns are mirrored
    np.testing.assert_allclose(seen, after, atol=1e-9)


def test_scenes_on_several_maps_have_the_order_of_their_episodes() -> None:
    merge, roundabout = (highway_env_world(2, seed=1, place=place) for place in ("merge", "roundabout"))
    merge.reset([0, 1])
    roundabout.reset([0])
    (first, last), (middle,) = merge.observe().history, roundabout.observe().history
    mixed = TrafficWorld(merge.simulator)
    mixed.rides = [merge.rides[0], roundabout.rides[0], merge.rides[1]]
    torch.testing.assert_close(mixed.observe().history, torch.stack((first, middle, last)))


@pytest.mark.parametrize(("place", "left", "right"), [("merge", 4, 3), ("roundabout", 8, 8)])
def test_left_is_left_and_right_is_right(place: str, left: int, right: int) -> None:
    """Lanes are 4 m wide. The number of them with one on the left differs from that of those with an open one on the right
    by the lane of the ramp, which may be left but not entered."""
    lanes = HighwayEnvSimulator(1, 1, place).roads.lanes
    for beside, count, side in ((lanes.left_of, left, 1), (lanes.right_of, right, -1)):
        having = np.flatnonzero(beside >= 0)
        assert len(having) == count
        for lane in having:
            position = lanes.centre[beside[lane]][1][None]
            _, offset = lanes.centrelines.project(np.array([lane]), position)
            assert 3.0 < side * float(offset[0]) < 5.0


def test_no_vehicle_changes_to_the_forbidden_lane_of_the_ramp() -> None:
    simulator = HighwayEnvSimulator(1, 1, "merge")
    keys, lanes = highway_env.keys_of(simulator._environment.road.network), simulator.roads.lanes
    fast, slow, ramp = (keys.index(("b", "c", number)) for number in range(3))
    assert lanes.left_of[[fast, slow, ramp]].tolist() == [-1, fast, slow]
    assert lanes.right_of[[fast, slow, ramp]].tolist() == [slow, -1, -1]
    assert lanes.adjacent_left[[fast, slow, ramp]].tolist() == [-1, fast, slow]
    assert lanes.adjacent_right[[fast, slow, ramp]].tolist() == [slow, ramp, -1], "it is there all the same"


def test_episodes_repeat_and_differ(world: TrafficWorld) -> None:
    first, other, again = (play(world, None, [episode]).outcome.states for episode in (0, 1, 0))
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


def test_planners_drive(world: TrafficWorld) -> None:
    forecaster = epo_lightning.load("highway_sim/hivt_m_epo")
    world.simulator.steps = 8
    for planner in (
        ForecastPlanner(forecaster, world.agents),
        ResponsePlanner(world.energy, world.game, None, world.search),
    ):
        episodes = play(world, planner, [2])
        assert bool(episodes.found.all())
        assert float(measure(episodes, world)["progress"][0]) > 3.0


def test_a_response_drives_around_the_roundabout_where_costs_of_a_motorway_would_stand() -> None:
    progress = []
    for turning in (1.0, highway_env.SETTINGS["roundabout"].turning):
        world = TrafficWorld(HighwayEnvSimulator(2, 5, "roundabout"), turning)
        outcome = play(world, ResponsePlanner(world.energy, world.game, None, world.search), range(2)).outcome
        progress.append(outcome.progress[:, -1])
    assert progress[0].max() < 30.0
    assert progress[1].min() > 100.0
    assert outcome.measures["arrived"].bool().all()


def test_a_lane_of_the_route_ends_where_the_next_one_begins() -> None:
    simulator = HighwayEnvSimulator(1, 1, "roundabout")
    keys, lanes = highway_env.keys_of(simulator._environment.road.network), simulator.roads.lanes
    leaving, onward = keys.index(("ee", "nx", 1)), keys.index(("nx", "nxs", 0))
    assert lanes.successors[leaving] == (onward,)
    for lines in (lanes.centre, lanes.left, lanes.right):
        np.testing.assert_array_equal(lines[leaving][-1], lines[onward][0])


def test_a_vehicle_that_merges_has_to_leave_its_lane() -> None:
    roads = HighwayEnvSimulator(1, 1, "merge").roads
    ramp, road = np.array([280.0, -8.0, 0.0, 20.0]), np.array([280.0, -4.0, 0.0, 20.0])
    assert (roads.position(ramp, 0.0).line, roads.position(road, 0.0).line) == (0, 1)
    assert not roads.position(np.array([310.2, -8.0, 0.0, 20.0]), 0.0).off_road
    for x in (310.4, 312.0):  # the lane ends at 310 m
        assert roads.position(np.array([x, -8.0, 0.0, 20.0]), 0.0).off_road
    assert not roads.position(np.array([312.0, -4.0, 0.0, 20.0]), 0.0).off_road
    assert roads.position(np.array([400.0, -4.0, 0.0, 20.0]), 0.0).arrived


def test_episodes_that_are_over_are_left_out(world: TrafficWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three episodes of different lengths, driven together and alone, by a forecaster and by the simulator's driver."""
    begin = world.reset

    def reset(episodes: Sequence[int]) -> None:
        begin(episodes)
        for ride, episode in zip(world.rides, episodes, strict=True):
            ride.steps = 4 + 3 * episode

    monkeypatch.setattr(world, "reset", reset)
    forecaster = epo_lightning.load("highway_sim/hivt_m_epo")
    for planner in (ForecastPlanner(forecaster, world.agents), None):
        together = play(world, planner, range(3))
        scores = measure(together, world)
        assert together.outcome.agent_mask[:, 0].sum(1).tolist() == [5, 8, 11]
        assert together.controls[..., 0].isfinite().sum(1).tolist() == [4, 7, 10]
        for episode in range(3):
            alone = measure(play(world, planner, [episode]), world)
            for name, value in alone.items():
                assert float(scores[name][episode]) == pytest.approx(float(value[0]), abs=1e-3), name


def test_mistakes_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="episodes must be 1000 or fewer in world=highway_env, not 1001"):
        highway_env_world(1001)
    with pytest.raises(ConfigError, match="did you mean 'merge'"):
        highway_env_world(1, place="merges")
    monkeypatch.setitem(__import__("sys").modules, "highway_env", None)
    with pytest.raises(ConfigError, match=r"pip install 'epo_lightning\[drive\]'"):
        highway_env._environment("merge-v1")
