"""Scenes on roads: the same as those of recorded data, and the costs that planners are told there."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from epo_lightning.data.recorded.road_scenes import RoadScenes
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.drive.planners import GamePlanner, Plan, ResponsePlanner
from epo_lightning.drive.road_game import ENERGY, keep_going, road_game
from epo_lightning.drive.traffic import TrafficWorld
from epo_lightning.drive.world import Search
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.registry import lookup
from epo_lightning.scene import TURN_RATE, Scene, rotated

RECORDINGS = Path(__file__).parents[1] / "fixtures" / "exid_sim"


@pytest.fixture(scope="module")
def recorded() -> tuple[RecordedScenes, RoadScenes, np.ndarray]:
    """Scenes of a recording, the maker of scenes for its map, and the origins of the recorded ones."""
    source = lookup("format", "exid")(RECORDINGS)[0]
    recording = source.read()
    config = WindowConfig(horizon=10, lane_change=False)
    tables, _ = extract(recording, config)
    assert tables is not None
    assert recording.lanes is not None
    columns = {name: torch.as_tensor(values) for name, values in tables.columns().items()}
    return RecordedScenes(columns, config.dt, "aligned", ("",)), RoadScenes(recording.lanes, config), tables.origin[0]


def test_scenes_are_those_of_recorded_data(recorded: tuple[RecordedScenes, RoadScenes, np.ndarray]) -> None:
    scenes, make, origin = recorded
    for index in (0, len(scenes) // 2, len(scenes) - 1):
        wanted = scenes[torch.tensor([index])]
        rows = scenes.tables["agents"][index].long()
        history = scenes.tables["history"][rows].double().numpy()
        history[..., :2] += origin
        made = make(
            history[None],
            scenes.tables["size"][rows].numpy()[None],
            wanted.history_mask.numpy(),
            wanted.agent_mask.numpy(),
            scenes.tables["kind"][rows].numpy()[None],
        )
        for name in ("history", "size", "lanes", "goal_candidates", "references", "reference_speed", "frame"):
            torch.testing.assert_close(getattr(made, name), getattr(wanted, name), rtol=1e-5, atol=2e-4)
        for name in (
            "history_mask",
            "agent_mask",
            "kind",
            "lane_mask",
            "goal_mask",
            "goal_reference",
            "reference_mask",
        ):
            assert torch.equal(getattr(made, name), getattr(wanted, name)), name
        assert made.future is None


def vehicles(scenes: RecordedScenes, origin: np.ndarray) -> dict[str, np.ndarray]:
    """The vehicles of a recorded scene, as the maker of scenes takes them."""
    index = len(scenes) // 2
    rows = scenes.tables["agents"][index].long()
    rows = rows[rows >= 0]
    history = scenes.tables["history"][rows].double().numpy()
    history[..., :2] += origin
    everyone = np.ones((1, len(rows)), dtype=bool)
    columns = {name: scenes.tables[name][rows].numpy()[None] for name in ("history_mask", "size", "kind")}
    return {"history": history[None], "agent_mask": everyone, **columns}


def test_what_a_scene_of_vehicles_does_not_depend_on(recorded: tuple[RecordedScenes, RoadScenes, np.ndarray]) -> None:
    scenes, make, origin = recorded
    given = vehicles(scenes, origin)
    plain = make(**given)
    turned = given["history"] + np.array([0.0, 0.0, 2000 * np.pi, 0.0])  # a simulation does not wrap headings
    torch.testing.assert_close(make(**{**given, "history": turned}).history, plain.history, rtol=0, atol=2e-6)
    given["history_mask"][0, 1, :3] = False
    unseen = given["history"].copy()
    unseen[0, 1, :3] = np.nan
    made = make(**{**given, "history": unseen})
    assert made.history.isfinite().all()
    absent = np.concatenate([given["agent_mask"], [[False]]], 1)
    wider = {name: np.concatenate([values, values[:, :1]], 1) for name, values in given.items()}
    wider["history"][:, -1] += 50.0
    padded = make(**{**wider, "agent_mask": absent})
    torch.testing.assert_close(padded.frame, made.frame)
    torch.testing.assert_close(padded.history[:, :-1], made.history)
    assert torch.equal(padded.agent_mask, torch.as_tensor(absent))


def test_some_vehicles_decide_on_the_frame(recorded: tuple[RecordedScenes, RoadScenes, np.ndarray]) -> None:
    scenes, make, origin = recorded
    given = vehicles(scenes, origin)
    only = make(**{name: values[:, :1] for name, values in given.items()})
    torch.testing.assert_close(make(**given, framed=1).frame, only.frame)
    assert not torch.allclose(make(**given).frame[0, :2], only.frame[0, :2], atol=1.0)


def test_vehicles_in_all_directions_have_the_frame_of_the_first(
    recorded: tuple[RecordedScenes, RoadScenes, np.ndarray],
) -> None:
    scenes, make, origin = recorded
    given = {name: np.concatenate([values[:, :1]] * 2, 1) for name, values in vehicles(scenes, origin).items()}
    given["history"][0, 1, :, 2] += np.pi
    heading = torch.tensor(given["history"][0, 0, -1, 2])
    with pytest.raises(ValueError, match="agent 1 of scene 0 is on no lane"):
        make(**given)
    made = make(**given, on_lanes_only=False)
    torch.testing.assert_close(made.frame[0, 2].double(), heading, atol=1e-5, rtol=0)


def test_lanes_without_a_limit_have_that_of_the_windows(
    recorded: tuple[RecordedScenes, RoadScenes, np.ndarray],
) -> None:
    scenes, make, origin = recorded
    unlimited = dataclasses.replace(make.lanes, speed_limit=np.full(len(make.lanes.ids), np.nan))
    made = RoadScenes(unlimited, make.windows)(**vehicles(scenes, origin))
    assert made.reference_speed is not None
    assert bool((made.reference_speed == make.windows.speed_limit).all())


def test_agents_that_keep_going_stay_on_their_lanes() -> None:
    radius, speed = 400.0, 20.0
    angle = torch.linspace(-0.02, 0.25, 24, dtype=torch.double)
    line = radius * torch.stack((angle.sin(), 1.0 - angle.cos()), -1)
    history = torch.tensor([[[[0.0, 0.0, 0.0, speed]]]], dtype=torch.double)
    scene = Scene(history=history, dt=0.2, references=line.expand(1, 1, 3, -1, -1))
    controls = keep_going(scene, 20)
    assert bool((controls[..., 0] == 0).all())
    assert float(controls[..., 1].mean()) == pytest.approx(speed / radius, rel=0.02)
    end = Unicycle().rollout(scene.current, controls, scene.dt)[0, 0, -1, :2]
    assert float((end - torch.tensor([0.0, radius])).norm()) == pytest.approx(radius, abs=0.5), (
        "straight on it were 8 m"
    )


def bend(speed: float, towards: float) -> Scene:
    """Two vehicles on a lane, 20 m before it turns to the left by a circle of 50 m, which ends after 85 m."""
    way = torch.linspace(0.0, 115.0, 24, dtype=torch.double)
    angle = ((way - 30.0) / 50.0).clamp_min(0.0)
    line = torch.stack((way.clamp_max(30.0) + 50.0 * angle.sin(), 50.0 * (1.0 - angle.cos())), -1)
    turn = torch.tensor(towards, dtype=torch.double)
    place = rotated(torch.tensor([10.0, 0.0], dtype=torch.double), turn)
    history = torch.tensor([[[[*place.tolist(), towards, speed]]] * 2], dtype=torch.double)
    return Scene(
        history=history,
        dt=0.2,
        references=rotated(line, turn).expand(1, 2, 3, -1, -1),
        reference_speed=torch.full((1, 2), speed, dtype=torch.double),
    )


@pytest.mark.parametrize("towards", [0.0, 3.0])
@pytest.mark.parametrize(("speed", "turned"), [(15.0, (70.0 - 30.0) / 50.0), (40.0, (112.5 - 30.0) / 50.0)])
def test_agents_turn_by_as_much_as_their_lane_does_ahead(speed: float, turned: float, towards: float) -> None:
    """In 4 s; a lane goes straight on from the middle of its last piece on. Headings may pass pi."""
    rate = keep_going(bend(speed, towards), 20)[..., TURN_RATE]
    torch.testing.assert_close(4.0 * rate, torch.full_like(rate, turned), rtol=0, atol=0.02)


def test_controls_of_the_planned_vehicle_cost_in_themselves_and_those_of_others_where_they_differ() -> None:
    scene = bend(15.0, 0.0)
    usual = road_game(scene, torch.tensor([1]), 20).reference_controls
    assert usual is not None
    assert not usual[0, 0, 0].any()
    assert torch.equal(usual[0, 0, 1], keep_going(scene, 20)[0, 1])
    assert usual[0, 0, 1].any()


@pytest.mark.parametrize(("speed", "scale"), [(20.0, 20.0), (1.5, 1.5), (0.2, 1.0), (0.0, 1.0)])
def test_the_planned_vehicle_pays_for_the_share_of_its_reference_speed(speed: float, scale: float) -> None:
    """Below 1 m/s, as in front of a closed lane, the weight does not grow further."""
    scene = dataclasses.replace(bend(15.0, 0.0), reference_speed=torch.full((1, 2), speed, dtype=torch.double))
    weights = road_game(scene, torch.tensor([1]), 20, turning=0.5).own_weights
    torch.testing.assert_close(weights["velref"], torch.tensor([[[1.0 / scale, 0.0]]], dtype=torch.double))
    torch.testing.assert_close(weights["turnacc"], torch.tensor([[[2.5, 2.5]]], dtype=torch.double))
    torch.testing.assert_close(weights["accref"], torch.tensor([[[0.5, 0.7]]], dtype=torch.double))


def queue(gap: float) -> Scene:
    """A vehicle at 20 m/s on a straight lane, and one that stands ``gap`` metres ahead of it."""
    history = torch.tensor([[[[0.0, 0.0, 0.0, 20.0]], [[gap, 0.0, 0.0, 0.0]]]], dtype=torch.double)
    line = torch.stack((torch.linspace(-5.0, 300.0, 24), torch.zeros(24)), -1).double()
    beside = torch.tensor([0.0, 3.5], dtype=torch.double)
    return Scene(
        history=history,
        dt=0.2,
        size=torch.tensor([[[4.5, 1.8], [4.5, 1.8]]], dtype=torch.double),
        references=torch.stack((line + beside, line, line - beside), 0).expand(1, 2, -1, -1, -1),
        reference_speed=torch.full((1, 2), 25.0, dtype=torch.double),
    )


def test_a_planned_vehicle_brakes_for_a_queue_and_changes_lanes_when_it_wants_to() -> None:
    def plan(scene: Scene, line: int) -> torch.Tensor:
        lines = torch.tensor([line])
        return ResponsePlanner(ENERGY, lambda scene: road_game(scene, lines, 20), None, TrafficWorld.search)(
            scene, None
        ).states[0]

    free = plan(queue(300.0), 1)
    assert float(free[0, -1, 3]) > 20.0, "it approaches the reference speed"
    braked = plan(queue(60.0), 1)
    assert float(braked[0, -1, 0]) < 60.0 - 4.5
    assert float(braked[1, :, 3].abs().max()) == 0.0, "who stands keeps standing"
    left = plan(queue(300.0), 0)
    assert float(left[0, -1, 1]) > 2.0


def test_a_response_starts_at_the_last_plan_of_the_planned_vehicle_alone() -> None:
    lines, joint = torch.tensor([1]), torch.zeros(1, 1, 2, 20, 2, dtype=torch.double)
    joint[..., 0] = torch.linspace(-1.0, 0.0, 20)
    previous = Plan(torch.zeros(1, 20, 2), torch.zeros(1, 2, 20, 4), torch.ones(1, dtype=torch.bool), joint)
    planner = ResponsePlanner(ENERGY, lambda scene: road_game(scene, lines, 20), None, Search(steps=0))
    plan = planner(queue(300.0), previous)
    assert plan.joint is not None
    torch.testing.assert_close(plan.controls[:, :-1], joint[:, 0, 0, 1:])
    assert not plan.joint[:, 0, 1].any()


def test_the_best_response_of_another_vehicle_does_not_move_the_planned_one() -> None:
    """The planned vehicle brakes in a further start of its own search, not while it is held by a costly strategy."""
    scene, lines = queue(15.0), torch.tensor([1])
    found = []
    for search in (TrafficWorld.search, Search(steps=TrafficWorld.search.steps)):
        planner = GamePlanner(ENERGY, lambda scene: road_game(scene, lines, 20), 1, search)
        game, start = planner._start(scene, None)
        start[0, 0, 0, ::2, 0], start[0, 0, 0, 1::2, 0] = 4.0, -4.0
        controls, fine = planner._descend(scene, game, start, 1)
        assert fine.all()
        found.append(controls)
    torch.testing.assert_close(found[0], found[1])
    assert found[0][0, 0, 1].any(), "it gives way to the planned vehicle behind it"
