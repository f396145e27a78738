"""SUMO's ramps as a world: the same episodes for all planners, and drivers that react."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from multiprocessing import Pipe

import numpy as np
import pytest
import torch

import epo_lightning
from benchmarks import forecast_speed
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.drive.episodes import play
from epo_lightning.drive.measures import measure
from epo_lightning.drive.planners import ForecastPlanner, Plan, Planner, ResponsePlanner
from epo_lightning.drive.ride import SEEN, Moment
from epo_lightning.drive.traffic import TrafficWorld
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)

from epo_lightning.drive.sumo import SumoSimulation, SumoSimulator, lanes_of, sumo_world
from epo_lightning.drive.sumo_process import END, Branch, Vehicles, _closed, _episode, _Road, _stream


@pytest.fixture(scope="module")
def world() -> Iterator[TrafficWorld]:
    world = sumo_world(4, seed=1, style="free")
    world.simulator.steps = 12
    yield world
    world.close()


def keeps(control: float) -> Planner:
    """A planner with constant acceleration."""

    def planner(scene: Scene, previous: Plan | None) -> Plan:
        count = len(scene.history)
        controls = torch.zeros(count, 20, 2)
        controls[..., 0] = control
        return Plan(controls, scene.current[:, :, None].expand(-1, -1, 20, -1), torch.ones(count, dtype=torch.bool))

    return planner


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_positions_on_a_road_are_found_again(layout: Layout) -> None:
    random = np.random.default_rng(0)
    s, d = random.uniform(50, layout.length - 50, 200), random.uniform(-15, 12, 200)
    found = layout.project(layout.locate(s, d))
    np.testing.assert_allclose(found, (s, d), atol=2e-3)


def test_an_episode_is_the_same_again_until_the_vehicle_is_driven_otherwise(world: TrafficWorld) -> None:
    own, again = (play(world, None, [1]).outcome for _ in range(2))
    assert torch.equal(own.states, again.states), "an episode can be begun again, after others as well"
    braked, hurried = (play(world, keeps(control), [1]).outcome for control in (-4.0, 1.0))
    assert torch.equal(braked.states[:, 0, 0], own.states[:, 0, 0]), "they begin alike"
    ego = [outcome.states[0, 0, -1, 3] for outcome in (braked, hurried)]
    assert float(ego[1] - ego[0]) == pytest.approx(12 * 0.2 * 5.0, abs=0.1)


def test_episodes_differ_and_begin_on_the_ramp(world: TrafficWorld) -> None:
    begun = []
    for episode in range(4):
        world.reset([episode])
        scene = world.observe()
        begun.append(scene.history.clone())
        assert scene.history.shape == (1, SEEN, 10, 4)
        assert scene.future is None
        assert bool(scene.history_mask[:, 0].all())
        (ride,) = world.rides
        simulation = ride.simulation
        assert isinstance(simulation, SumoSimulation)
        s, _ = simulation.layout.project(ride.now.states[0, :2])
        assert 40.0 < simulation.ramp.join - float(s) <= 60.0
    assert not any(torch.equal(a, b) for a, b in pairwise(begun))


def following_the_ramp(world: TrafficWorld, acceleration: float) -> list[Moment]:
    """All moments of five seconds in which the planned vehicle stays in the middle of its lane, whatever it touches."""
    world.reset([1])
    (ride,) = world.rides
    simulation = ride.simulation
    assert isinstance(simulation, SumoSimulation)
    layout, ramp, moments = simulation.layout, simulation.ramp, [ride.now]
    state = ride.now.states[0]
    (s, _), speed = layout.project(state[:2]), state[3]
    for _ in range(25):
        s, speed = s + 0.2 * speed, speed + 0.2 * acceleration
        before, state = state, np.array([*layout.locate(s, layout.offset(ramp, s)), layout.direction(ramp, s), speed])
        simulation.step((before, state))
        moments.append(simulation.moment())
        np.testing.assert_array_equal(moments[-1].states[0], state)
    return moments


def test_drivers_behind_react_to_the_planned_vehicle(world: TrafficWorld) -> None:
    """The nearest driver on the same lane, 50 m behind, brakes for a vehicle that does, and speeds up behind another one."""
    braked, kept = following_the_ramp(world, -4.0), following_the_ramp(world, 0.0)
    begin = braked[0]
    assert begin.names == kept[0].names
    assert np.array_equal(begin.states, kept[0].states)
    s, d = LAYOUTS[1].project(begin.states[:, :2])
    ramp = LAYOUTS[1].lanes[3]
    on_ramp = np.abs(d - LAYOUTS[1].offset(ramp, s)) < 1.0
    gaps = {name: float(s[0] - s[row]) for name, row in begin.rows.items() if on_ramp[row] and s[row] < s[0]}
    gap, follower = min((gap, name) for name, gap in gaps.items())
    assert 30.0 < gap < 60.0
    first, slow, fast = (moment.states[moment.rows[follower], 3] for moment in (begin, braked[-1], kept[-1]))
    assert slow < first - 3.0
    assert fast > first + 1.0
    assert fast - slow > 5.0


def test_sumo_moves_the_planned_vehicle_to_where_it_is_put(world: TrafficWorld) -> None:
    """Down the ramp, and then to the lane beside it: what others see is the vehicle in SUMO, at the place that was meant."""
    world.reset([1])
    (ride,) = world.rides
    simulation, state = ride.simulation, ride.now.states[0]
    assert isinstance(simulation, SumoSimulation)
    layout, ramp = simulation.layout, simulation.ramp
    s, _ = layout.project(state[:2])
    strips = []
    for _ in range(25):
        s += 5.0
        d = layout.offset(ramp, s) + layout.width * np.clip((s - ramp.join) / 50.0, 0.0, 1.0)
        before, state = state, np.array([*layout.locate(s, d), state[2], 25.0])
        simulation.step((before, state))
        vehicles = simulation._answer()
        row = vehicles.names.index(simulation._name)
        front, aside, speed, _, length, *_ = vehicles.values[row]
        lane = layout.lanes[vehicles.strip[row]]
        assert front - length / 2 == pytest.approx(float(s), abs=0.01)
        assert layout.offset(lane, s) + aside == pytest.approx(float(d), abs=0.01)
        strips.append(vehicles.strip[row])
    assert (strips[0], strips[-1]) == (3, 0), "from the ramp to the right one of the road's three lanes"
    assert speed == pytest.approx(25.0, abs=0.1)


def test_a_vehicle_on_the_ramp_has_to_leave_it_and_arrives_behind_its_end(world: TrafficWorld) -> None:
    """The acceleration lane touches the road at 640 m and ends at 960 m; lanes are 3.75 m wide, and the right one of three
    on the road has its middle at 0 m. At 600 m the ramp is still 0.6 m farther to the right."""
    world.reset([1])
    (ride,) = world.rides
    simulation = ride.simulation
    assert isinstance(simulation, SumoSimulation)
    begin, _ = simulation.layout.project(ride.now.states[0, :2])
    places = [  # s, d, arrived, off_road, line
        (600.0, -4.35, False, False, 1),
        (639.0, -3.75, False, False, 1),
        (641.0, -3.75, False, False, 0),
        (950.0, -3.75, False, False, 0),
        (700.0, -2.0, False, False, 0),
        (700.0, -1.75, False, False, 1),
        (641.0, 0.0, False, False, 1),
        (700.0, 7.5, False, False, 1),
        (700.0, -3.75 - 1.875 - 0.29, False, False, 0),
        (700.0, -3.75 - 1.875 - 0.31, False, True, 0),
        (700.0, 7.5 + 1.875 + 0.29, False, False, 1),
        (700.0, 7.5 + 1.875 + 0.31, False, True, 1),
        (600.0, -4.35 - 1.875 - 0.4, False, True, 1),
        (965.0, -3.75, False, True, 1),
        (965.0, -1.875 - 0.29, False, False, 1),
        (1009.9, 0.0, False, False, 1),
        (1010.1, 0.0, True, False, 1),
        (1010.1, 7.5, True, False, 1),
        (1010.1, -1.875 - 0.31, False, True, 1),
    ]
    for s, d, arrived, off_road, line in places:
        x, y = simulation.layout.locate(np.array(s), np.array(d))
        found = simulation.position(np.array([x, y, 0.0, 20.0]))
        assert found.progress == pytest.approx(s - float(begin), abs=0.01)
        assert (found.arrived, found.off_road, found.line) == (arrived, off_road, line), (s, d)


def test_a_vehicle_that_takes_the_next_exit_does_not_arrive(world: TrafficWorld) -> None:
    """On the weaving section, the lane of the ramp becomes an exit at 1080 m. Lanes are 3.5 m wide, and at
    1135 m the exit has turned away by 1.2 m."""
    world.reset([3])
    simulation = world.rides[0].simulation
    assert isinstance(simulation, SumoSimulation)
    assert simulation.layout.name == "weave"
    for s, d, arrived in ((1129.9, 0.0, False), (1130.1, 0.0, True), (1130.1, 3.5, True), (1135.0, -4.7, False)):
        x, y = simulation.layout.locate(np.array(s), np.array(d))
        found = simulation.position(np.array([x, y, 0.0, 20.0]))
        assert (found.arrived, found.off_road) == (arrived, False), (s, d)


def test_a_forecaster_and_a_response_drive(world: TrafficWorld) -> None:
    forecaster = epo_lightning.load("highway_sim/hivt_m_epo")
    response = ResponsePlanner(world.energy, world.game, forecaster, agents=world.agents)
    for planner in (ForecastPlanner(forecaster, world.agents), response):
        episodes = play(world, planner, [2], keep_plans=True)
        found = measure(episodes, world)
        assert bool(episodes.found.all())
        assert {"arrived", "off_road", "hit_from_behind", "speed"} <= set(found)
        assert float(found["progress"][0]) > 10.0
        ego = episodes.plans[0][0, 0]
        here = episodes.outcome.states[0, 0, 0, :2]
        assert float((ego[0] - here).norm()) < 10.0, "plans are kept in the world's frame"


def test_the_end_of_the_process_is_told() -> None:
    simulator = SumoSimulator(1, 0, "free")
    pipe, other = Pipe()
    simulation = SumoSimulation(pipe, simulator.branch(0), lanes_of(LAYOUTS[0]))
    other.close()
    for ask in (simulation.moment, lambda: simulation.step(None)):
        with pytest.raises(ConfigError, match="the process of SUMO ended: is there enough memory"):
            ask()
    simulation.end()  # nothing more is sent


class Unsendable(RuntimeError):
    """Error that no process can send to another one."""

    def __reduce__(self) -> str:
        raise TypeError("no copy of this error")


@pytest.mark.parametrize(
    ("error", "status"), [(Unsendable(), 1), (RuntimeError("a sign of SUMO"), 0), (EOFError(), 0)], ids=repr
)
def test_an_episode_ends_with_a_status_of_its_own_where_its_error_was_not_told(
    monkeypatch: pytest.MonkeyPatch, error: Exception, status: int
) -> None:
    """Without one, the process that waits for an answer would wait for ever: the simulation tells it by that status."""

    class BrokenRoad:
        taken = "planned"

        @property
        def history(self) -> list[object]:
            raise error

    def end(status: int) -> None:
        raise SystemExit(status)

    monkeypatch.setattr("os._exit", end)
    here, there = Pipe()
    with pytest.raises(SystemExit) as ended:
        _episode(there, BrokenRoad(), Branch(0, 0, "free", 0))  # type: ignore[arg-type]
    assert ended.value.code == status
    assert here.poll() == (type(error) is RuntimeError), "this error alone was sent"


def test_a_simulation_ends_when_no_process_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step of the warm-up is the last one."""
    steps: list[None] = []
    advance = _Road.advance

    def counted(road: _Road, path: np.ndarray | None) -> Vehicles:
        steps.append(None)
        return advance(road, path)

    monkeypatch.setattr(_Road, "advance", counted)
    pipe, other = Pipe()
    assert not _closed(pipe)
    other.send(END)
    assert not _closed(pipe), "a message that waits is no end"
    streaming = _stream(SumoSimulator(1, 0, "free").branch(0), pipe)
    other.close()
    assert _closed(pipe)
    with pytest.raises(EOFError):
        next(streaming)
    assert len(steps) == 1


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="did you mean 'dense'"):
        sumo_world(1, style="dens")
    with pytest.raises(ConfigError, match="episodes must be a whole number, 1 or more, not 0"):
        sumo_world(0)
    with pytest.raises(ConfigError, match="episodes must be 4000 or fewer in world=sumo, not 4001"):
        sumo_world(4001)


def test_no_episode_is_one_of_another_seed() -> None:
    first, second = (SumoSimulator(4000, seed, "free") for seed in (0, 1))
    streams = {first.branch(episode).seed for episode in range(4000)}
    assert len({first.branch(episode) for episode in range(4000)}) == 4000
    assert max(streams) < second.branch(0).seed
    assert not streams & {second.branch(episode).seed for episode in range(4000)}


def test_episodes_that_are_driven_together_do_not_depend_on_each_other(world: TrafficWorld) -> None:
    """On several maps, with one episode that ends before the others."""
    planner = ResponsePlanner(world.energy, world.game, None, world.search)
    together = play(world, planner, [2, 0, 3, 1]).outcome
    for place, episode in enumerate([2, 0, 3, 1]):
        alone = play(world, planner, [episode]).outcome
        seen = int(alone.agent_mask[0].any(1).sum())
        torch.testing.assert_close(together.states[place, :seen, :13], alone.states[0, :seen], rtol=0, atol=1e-5)
        assert torch.equal(together.agent_mask[place, :seen], alone.agent_mask[0, :seen])


def test_forecasts_are_compared_with_what_happens(world: TrafficWorld) -> None:
    errors = forecast_speed.watch(world, {}, 2)[forecast_speed.KEEPING]
    along, distance = errors[2].T
    assert len(along) > 3
    assert (np.abs(along) <= distance + 1e-9).all()
    assert distance.max() < 20.0, "vehicles are not mistaken for others"
    assert not len(errors[4]), "the episodes are shorter"


@pytest.mark.parametrize("change", [0.5, -40.0])
def test_others_are_expected_to_accelerate_by_a_constant_and_never_backwards(
    change: float, world: TrafficWorld
) -> None:
    world.reset([0])
    scene = world.observe().to(torch.float64)
    game = world.game(scene)
    usual = ResponsePlanner(world.energy, world.game, None, world.search).expected(scene, game)
    controls = forecast_speed.Accelerated(change, world.energy, world.game, None, world.search).expected(scene, game)
    states = world.energy.dynamics.rollout(scene.current[:, None], controls, scene.dt)
    there = scene.agent_mask[0]
    assert torch.equal(controls[..., 1], usual[..., 1])
    if change > 0:
        torch.testing.assert_close(controls[..., 0][:, :, there], usual[..., 0][:, :, there] + change)
    assert float(states[0, 0, there, :, 3].min()) > -1e-9
