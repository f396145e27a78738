"""Interactive scenes: hand-made ones, and random ones against a slow definition with polygons and loops."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from epo_lightning.metrics.functional import interactive_scenes
from epo_lightning.metrics.functional.interaction import along, interacting_pairs
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

from .slow_interaction import interact

DT, K = 0.5, 8
TIME = DT * torch.arange(K + 1, dtype=torch.float64)
VEHICLE, WALKER = (5.0, 2.0), (0.5, 0.5)


def track(
    x: Tensor | float, y: Tensor | float = 0.0, heading: Tensor | float = 0.0, speed: Tensor | float = 0.0
) -> Tensor:
    """States [K + 1, 4] of one agent from t0 on; numbers are the same for all steps."""
    columns = [torch.as_tensor(value, dtype=torch.float64).expand(K + 1) for value in (x, y, heading, speed)]
    return torch.stack(columns, -1)


def scene_of(*tracks: Tensor, size: tuple[float, float] = VEHICLE, road: bool = True) -> Scene:
    """One scene; with ``road`` it has a lane, which makes it a scene with a map."""
    states = torch.stack(tracks)[None]
    sizes = torch.tensor(size, dtype=torch.float64).expand(1, len(tracks), 2)
    lanes = torch.zeros(1, 1, 1, 4, dtype=torch.float64) if road else None
    return Scene(states[:, :, :1], dt=DT, future=states[:, :, 1:], size=sizes, lanes=lanes)


def is_interactive(*tracks: Tensor, shape: str = "box", size: tuple[float, float] = VEHICLE, road: bool = True) -> bool:
    return bool(interactive_scenes(scene_of(*tracks, size=size, road=road), shape))


def approach(gap: float, brake_from: float) -> tuple[Tensor, Tensor]:
    """A vehicle that closes a gap at 5 m/s until it has the speed of the vehicle ahead, from ``brake_from`` [s] on."""
    closing = 5.0 * TIME.clamp_max(brake_from)
    speed = torch.where(brake_from > TIME, 15.0, 10.0)
    return track(10.0 * TIME + closing, speed=speed), track(gap + VEHICLE[0] + 10.0 * TIME, speed=10.0)


def test_a_vehicle_that_brakes_behind_another_one_yields() -> None:
    # At 15 m/s it would be at the rear of the other one after 2 s; the horizon is 4 s.
    assert is_interactive(*approach(gap=10.0, brake_from=1.0))
    assert not is_interactive(*approach(gap=10.0, brake_from=10.0))  # they overlap in the recording


def test_the_last_second_belongs_to_the_time_to_collision() -> None:
    # The overlap would begin at 4.4 s: a time to collision of 0.4 s at the end of the horizon of 4 s.
    assert is_interactive(*approach(gap=22.0, brake_from=3.0))
    assert not is_interactive(*approach(gap=22.0, brake_from=10.0))  # nobody has yielded when the recording ends
    assert not is_interactive(*approach(gap=25.5, brake_from=3.0))  # 5.1 s: a time to collision of 1.1 s


def test_a_scene_without_conflict_is_calm() -> None:
    assert not is_interactive(track(10.0 * TIME, speed=10.0), track(20.0 + 10.0 * TIME, speed=10.0))


def test_agents_that_overlap_at_the_beginning_do_not_count() -> None:
    apart = torch.cat((torch.zeros(1), torch.full((K,), 8.0))).double()
    assert not is_interactive(track(0.0, speed=0.0), track(1.0 + apart, speed=0.0))


@pytest.mark.parametrize(("shape", "expected"), [("box", False), ("disc", True)])
def test_the_shape_is_the_one_of_the_overlap_rates(shape: str, expected: bool) -> None:
    # Two vehicles of 5 m by 2 m, 4 m apart sideways: the boxes pass each other, the discs would overlap at 2 s. One brakes.
    slow = 10.0 * TIME.clamp_max(1.0)
    first = track(slow, speed=torch.where(TIME < 1.0, 10.0, 0.0))
    assert is_interactive(first, track(20.0, y=4.0), shape=shape) is expected


def bend(radius: float, ahead: float, speed: float) -> Tensor:
    angle = (ahead + speed * TIME) / radius
    return track(radius * angle.sin(), radius * (1.0 - angle.cos()), angle, speed)


def test_a_bend_makes_no_conflict_on_a_road() -> None:
    # Two lanes of a bend, 3.5 m apart; straight on, the faster one would leave its lane and hit the other one.
    outer, inner = bend(200.0, 20.0, 15.0), bend(196.5, 0.0, 25.0)
    inner[:, 1] += 3.5
    assert not is_interactive(outer, inner)
    assert is_interactive(outer, inner, road=False)


def test_the_end_of_a_lane_change_makes_no_conflict_on_a_road() -> None:
    # At 1 m/s sideways it would go on into the vehicle two lanes further, if it did not follow its lane.
    sideways = TIME.clamp_max(2.0)
    heading = torch.where(TIME < 2.0, math.atan2(1.0, 20.0), 0.0)
    changes = track(20.0 * TIME, sideways, heading, torch.where(TIME < 2.0, math.hypot(1.0, 20.0), 20.0))
    other = track(20.0 * TIME, 5.0, speed=20.0)
    assert not is_interactive(changes, other)
    assert is_interactive(changes, other, road=False)


def test_a_vehicle_that_waits_for_another_one_to_merge_yields() -> None:
    # The merging vehicle is beside the other one at the same speed, and changes lane after 2 s; the other one lets it in.
    sideways = -3.5 + 1.75 * (TIME - 2.0).clamp_min(0.0)
    heading = torch.where(TIME < 2.0, 0.0, math.atan2(1.75, 20.0))
    merges = track(20.0 * TIME, sideways, heading, 20.0)
    lets_in = track(-1.0 + 20.0 * TIME - 3.0 * TIME.clamp_max(3.0), speed=torch.where(TIME == 0.0, 20.0, 17.0))
    stays = track(-1.0 + 20.0 * TIME, speed=20.0)
    assert is_interactive(merges, lets_in)
    assert not is_interactive(merges, stays)  # they overlap
    assert not is_interactive(merges, lets_in, road=False)  # straight on, it would stay on its lane


def test_a_walker_that_swerves_yields() -> None:
    swerving = track(-2.0 + 1.0 * TIME, 0.8 * (math.pi * TIME / 4.0).sin(), 0.0, 1.0)
    coming = track(2.0 - 1.0 * TIME, 0.0, math.pi, 1.0)
    assert is_interactive(swerving, coming, shape="disc", size=WALKER, road=False)
    straight = track(-2.0 + 1.0 * TIME, 0.8, 0.0, 1.0)
    assert not is_interactive(straight, coming, shape="disc", size=WALKER, road=False)


def test_crossing_walkers_are_not_missed_between_two_steps() -> None:
    # Discs of 0.5 m that cross at 4 m/s overlap for about 0.18 s, less than a step of 0.5 s.
    one = track(-2.9 + 2.0 * TIME.clamp_max(1.0), 0.0, 0.0, torch.where(TIME < 1.0, 2.0, 0.0))
    other = track(0.0, -2.9 + 2.0 * TIME, math.pi / 2, 2.0)
    assert is_interactive(one, other, shape="disc", size=WALKER, road=False)


def test_agents_that_are_absent_or_not_observed_to_the_end_do_not_count() -> None:
    scene = scene_of(*approach(gap=10.0, brake_from=1.0), track(0.0, 50.0))
    assert interacting_pairs(scene, "box").tolist() == [[True, False, False]]
    for agent in (0, 1):
        absent, unseen = scene.agent_mask.clone(), torch.ones(1, 3, K, dtype=torch.bool)
        absent[0, agent], unseen[0, agent, -1] = False, False
        assert not interactive_scenes(dataclasses.replace(scene, agent_mask=absent), "box")
        assert not interactive_scenes(dataclasses.replace(scene, future_mask=unseen), "box")


def test_scenes_without_futures_or_sizes_and_unknown_shapes_are_refused() -> None:
    scene = scene_of(*approach(gap=10.0, brake_from=1.0))
    with pytest.raises(ValueError, match=r"scene\.future"):
        interactive_scenes(dataclasses.replace(scene, future=None, future_mask=None))
    with pytest.raises(ValueError, match=r"scene\.size"):
        interactive_scenes(dataclasses.replace(scene, size=None))
    with pytest.raises(ConfigError, match="did you mean 'box'"):
        interactive_scenes(scene, "boxes")


def test_a_way_is_followed_at_constant_speed_and_straight_on_at_its_end() -> None:
    way = torch.tensor([[0.0, 0.0, 0.0, 9.0], [3.0, 0.0, 0.0, 9.0], [3.0, 4.0, math.pi / 2, 9.0]])
    found = along(way, torch.tensor(2.0), torch.tensor([0.0, 1.0, 1.5, 2.5, 3.5, 5.0]))
    expected = [[0.0, 0.0], [2.0, 0.0], [3.0, 0.0], [3.0, 2.0], [3.0, 4.0], [3.0, 7.0]]
    torch.testing.assert_close(found[:, :2], torch.tensor(expected), atol=1e-6, rtol=0)
    assert found[3, 2] == pytest.approx(math.pi / 4)
    assert (found[:, 3] == 2.0).all()
    assert (along(way, torch.tensor(-1.0), torch.tensor([1.0]))[:, :2] == 0.0).all()


def test_headings_turn_the_short_way() -> None:
    way = torch.tensor([[0.0, 0.0, 3.1, 1.0], [-1.0, 0.0, -3.1, 1.0]])
    (heading,) = along(way, torch.tensor(1.0), torch.tensor([0.5]))[:, 2]
    assert abs(math.remainder(float(heading) - math.pi, 2 * math.pi)) < 1e-5


def random_scene(seed: int, scenes: int, road: bool, agents: int = 3) -> Scene:
    """Agents on their way to a common point that brake and turn; some are absent, and some not observed to the end."""
    draw = torch.Generator().manual_seed(seed)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(scenes, agents, *shape, dtype=torch.float64, generator=draw)

    speed = (between(-0.5, 8.0, 1) + between(-4.0, 1.0, 1) * TIME).clamp_min(-0.3)
    start, bearing = between(4.0, 16.0, 1), between(-math.pi, math.pi, 1)
    heading = bearing + math.pi + between(-0.4, 0.4, 1) + between(-0.2, 0.2, 1) * TIME
    step = DT * speed[..., :-1, None] * torch.stack((heading.cos(), heading.sin()), -1)[..., :-1, :]
    place = torch.cat((start * bearing.cos(), start * bearing.sin()), -1)[..., None, :]
    place = place + torch.cat((torch.zeros(scenes, agents, 1, 2), step.cumsum(-2)), -2)
    states = torch.cat((place, heading[..., None], speed[..., None]), -1)
    seen = torch.ones(scenes, agents, K, dtype=torch.bool)
    seen[..., -1] = torch.rand(scenes, agents, generator=draw) < 0.97
    present = torch.rand(scenes, agents, generator=draw) < 0.97
    size = torch.cat((between(1.0, 5.0, 1), between(0.5, 2.0, 1)), -1)
    lanes = torch.zeros(scenes, 1, 1, 4, dtype=torch.float64) if road else None
    return Scene(
        states[:, :, :1], DT, agent_mask=present, future=states[:, :, 1:], future_mask=seen, size=size, lanes=lanes
    )


@given(st.integers(0, 2**31), st.sampled_from(["box", "disc"]), st.booleans())
@settings(max_examples=25, deadline=None)
def test_random_scenes_equal_the_slow_definition(seed: int, shape: str, road: bool) -> None:
    scene = random_scene(seed, 6, road)
    found = interacting_pairs(scene, shape)
    for row in range(6):
        pairs = [(i, j) for i in range(3) for j in range(i + 1, 3)]
        assert found[row].tolist() == [interact(scene, row, i, j, shape) for i, j in pairs]
    assert interactive_scenes(scene, shape).tolist() == found.any(1).tolist()


@pytest.mark.parametrize("road", [False, True])
def test_random_scenes_are_of_both_kinds(road: bool) -> None:
    assert 0.1 < interactive_scenes(random_scene(0, 500, road), "box").double().mean() < 0.9


@given(st.integers(0, 2**31), st.floats(-3.0, 3.0), st.booleans())
@settings(max_examples=10, deadline=None)
def test_frames_and_the_order_of_agents_have_no_influence(seed: int, angle: float, road: bool) -> None:
    scene = random_scene(seed, 40, road)

    def moved(states: Tensor) -> Tensor:
        c, s = math.cos(angle), math.sin(angle)
        x, y = states[..., 0], states[..., 1]
        return torch.stack((c * x - s * y + 30.0, s * x + c * y - 7.0, states[..., 2] + angle, states[..., 3]), -1)

    assert scene.future is not None
    other = dataclasses.replace(scene, history=moved(scene.history), future=moved(scene.future))
    expected = interactive_scenes(scene, "box")
    assert (interactive_scenes(other, "box") == expected).all()
    order = torch.tensor([2, 0, 1])
    names = ("history", "history_mask", "agent_mask", "future", "future_mask", "size")
    mixed = dataclasses.replace(scene, **{name: getattr(scene, name)[:, order] for name in names})
    assert (interactive_scenes(mixed, "box") == expected).all()
