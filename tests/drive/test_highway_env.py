"""highway-env's merge and roundabout as worlds: maps, histories, and drivers that react."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import epo_lightning
from epo_lightning.drive import highway_env
from epo_lightning.drive.episodes import play
from epo_lightning.drive.highway_env import HighwayEnvSimulator, highway_env_world
from epo_lightning.drive.measures import measure
from epo_lightning.drive.planners import ForecastPlanner, ResponsePlanner
from epo_lightning.drive.traffic import TrafficWorld
from epo_lightning.registry import ConfigError

pytest.importorskip("highway_env", reason="the extra `drive` is not installed")
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module", params=["merge", "roundabout"])
def world(request: pytest.FixtureRequest) -> TrafficWorld:
    return highway_env_world(3, seed=1, place=request.param)


def test_vehicles_are_on_the_lanes_of_the_map(world: TrafficWorld) -> None:
    world.reset([0])
    scene = world.observe()
    assert scene.history.shape == (1, 4, 10, 4)
    assert bool(scene.history_mask[:, 0].all())
    lanes, moment = world.simulator.lanes, world._log[-1]
    located = lanes.locate(moment.states[:, :2], moment.states[:, 2])
    assert (located.lane >= 0).all()
    assert np.abs(located.offset).max() < 2.0
    _, tangent = lanes.centrelines.at(located.lane, located.along)
    turned = moment.states[:, 2] - np.arctan2(tangent[:, 1], tangent[:, 0])
    assert np.abs(np.sin(turned)).max() < 0.6, "headings are mirrored with the map"
    assert np.cos(turned).min() > 0.8


def test_left_is_left(world: TrafficWorld) -> None:
    lanes = world.simulator.lanes
    for lane in np.flatnonzero(lanes.left_of >= 0):
        position = lanes.centre[lanes.left_of[lane]][1][None]
        _, offset = lanes.centrelines.project(np.array([lane]), position)
        assert 3.0 < float(offset[0]) < 5.0


def test_episodes_repeat_and_differ(world: TrafficWorld) -> None:
    first, other, again = (play(world, None, [episode]).outcome.states for episode in (0, 1, 0))
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


def test_planners_drive(world: TrafficWorld) -> None:
    forecaster = epo_lightning.load("highway_sim/hivt_m_epo")
    world.simulator.steps = 8
    for planner in (ForecastPlanner(forecaster), ResponsePlanner(world.energy, world.game, None, world.search)):
        episodes = play(world, planner, [2])
        assert bool(episodes.found.all())
        assert float(measure(episodes, world)["progress"][0]) > 3.0


def test_a_vehicle_that_merges_has_to_leave_its_lane() -> None:
    simulator = HighwayEnvSimulator(1, 1, "merge")
    ramp, road = np.array([280.0, -8.0, 0.0, 20.0]), np.array([280.0, -4.0, 0.0, 20.0])
    assert (simulator.position(ramp).line, simulator.position(road).line) == (0, 1)
    assert simulator.position(np.array([312.0, -8.0, 0.0, 20.0])).off_road
    assert not simulator.position(np.array([312.0, -4.0, 0.0, 20.0])).off_road
    assert simulator.position(np.array([400.0, -4.0, 0.0, 20.0])).arrived


def test_mistakes_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="episodes must be 1000 or fewer in world=highway_env, not 1001"):
        highway_env_world(1001)
    with pytest.raises(ConfigError, match="did you mean 'merge'"):
        highway_env_world(1, place="merges")
    monkeypatch.setitem(__import__("sys").modules, "highway_env", None)
    with pytest.raises(ConfigError, match=r"pip install 'epo_lightning\[drive\]'"):
        highway_env._environment("merge-v1")
