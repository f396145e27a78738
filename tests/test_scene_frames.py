"""Frames: scenes of a map are aligned as recorded data are, and forecasts lead back to the map."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import highway_scene
from torch.testing import assert_close

from epo_lightning import Scene, pretrained
from epo_lightning.frames import aligned, in_world
from epo_lightning.scene import HEADING, wrapped


def moved(scene: Scene, angle: float, by: tuple[float, float]) -> Scene:
    """The scene in other coordinates: rotated to the left by an angle, and shifted."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotation, shift = torch.tensor([[cos, -sin], [sin, cos]]).double(), torch.tensor(by).double()

    def points(values: torch.Tensor) -> torch.Tensor:
        return values @ rotation.T + shift

    def states(values: torch.Tensor) -> torch.Tensor:
        return torch.cat((points(values[..., :2]), values[..., 2:3] + angle, values[..., 3:]), -1)

    scene = scene.to(torch.float64)
    lanes = scene.lanes
    return dataclasses.replace(
        scene,
        history=states(scene.history),
        future=states(scene.future),
        goal_candidates=points(scene.goal_candidates),
        lanes=torch.cat((points(lanes[..., :2]), points(lanes[..., 2:])), -1),
        references=points(scene.references),
        frame=None,
    )


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5, 3.1])
def test_recorded_scenes_come_back_from_a_map(angle: float) -> None:
    """Scenes of the data are aligned; in other coordinates, `aligned` gives them again."""
    given = pretrained.examples("highway_sim/hivt_m_epo")
    found = aligned(moved(given, angle, (5e5, -4e6)))
    masks = {
        "history": given.history_mask & given.agent_mask[..., None],
        "future": given.future_mask & given.agent_mask[..., None],
        "goal_candidates": given.agent_mask,
        "references": given.agent_mask,
        "lanes": given.lane_mask,
    }
    for name, mask in masks.items():
        assert_close(getattr(found, name)[mask], getattr(given, name)[mask].double(), rtol=0, atol=2e-4)


def test_states_lead_back_to_the_world() -> None:
    world = moved(highway_scene(3), 1.0, (300.0, -200.0))
    scene = aligned(world)
    states = in_world(scene.history, scene.frame)
    assert_close(states[..., :2], world.history[..., :2], rtol=0, atol=1e-9)
    assert_close(wrapped(states[..., HEADING] - world.history[..., HEADING]).abs().amax(), torch.tensor(0.0).double())
    assert_close(in_world(scene.future[..., :2], scene.frame), world.future[..., :2], rtol=0, atol=1e-9)
    current = torch.where(scene.agent_mask[..., None], scene.current, 0.0)
    assert_close(current[..., :2].sum(1), torch.zeros(3, 2).double(), rtol=0, atol=1e-9)


def test_headings_keep_their_turns() -> None:
    """A wanted heading stays as many turns away from the present one as it was."""
    history = torch.tensor([[[[0.0, 0.0, 7.0, 1.0]], [[4.0, 0.0, 0.5, 1.0]]]], dtype=torch.float64)
    goals = torch.zeros(1, 2, 1, 2, dtype=torch.float64)
    wanted = torch.tensor([[[7.0 + 5.0], [0.5 - 5.0]]], dtype=torch.float64)
    scene = aligned(Scene(history, dt=0.1, goal_candidates=goals, goal_headings=wanted))
    assert_close(scene.goal_headings[..., 0] - scene.current[..., HEADING], torch.tensor([[5.0, -5.0]]).double())
    assert scene.current[..., HEADING].abs().amax() <= math.pi


def test_opposed_headings_take_the_first_agent() -> None:
    history = torch.tensor([[[[0.0, 0.0, 1.0, 5.0]], [[9.0, 9.0, 1.0 + math.pi, 5.0]]]])
    assert float(aligned(Scene(history, dt=0.1)).current[0, 0, HEADING]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("off", "expected"),
    [
        (0.5, 1.0),  # the mean direction has the length sin(0.25) / 2 = 0.12: the heading of the first agent
        (1.0, 0.5 + math.pi / 2),  # sin(0.5) / 2 = 0.24: the direction itself, halfway between 1.0 and off - pi + 1.0
    ],
)
def test_directions_agree_by_the_length_of_their_mean(off: float, expected: float) -> None:
    """Four agents: a sum of directions is four times as long as their mean."""
    history = torch.zeros(1, 4, 1, 4).double()
    history[0, :, 0, HEADING] = torch.tensor([1.0, 1.0, 1.0 - math.pi, 1.0 + math.pi - off])
    assert float(aligned(Scene(history, dt=0.1)).frame[0, 2]) == pytest.approx(expected)


def test_the_first_agent_may_be_absent_and_scenes_empty() -> None:
    history = torch.tensor([[[[7.0, 7.0, 2.0, 1.0]], [[0.0, 0.0, 1.0, 5.0]], [[9.0, 9.0, 1.0 + math.pi, 5.0]]]])
    scene = aligned(Scene(history, dt=0.1, agent_mask=torch.tensor([[False, True, True]])))
    assert float(scene.current[0, 1, HEADING]) == pytest.approx(0.0, abs=1e-6)
    for empty in (
        Scene(history, dt=0.1, agent_mask=torch.zeros(1, 3, dtype=torch.bool)),
        Scene(torch.zeros(2, 0, 1, 4), dt=0.1),
        Scene(torch.zeros(0, 2, 1, 4), dt=0.1),
    ):
        assert aligned(empty).frame.isfinite().all()


def test_absent_agents_do_not_move_the_frame() -> None:
    history = torch.tensor([[[[2.0, 1.0, 0.3, 5.0]], [[math.nan] * 4]]])
    scene = aligned(Scene(history, dt=0.1, agent_mask=torch.tensor([[True, False]])))
    assert_close(scene.frame, torch.tensor([[2.0, 1.0, 0.3]]))
    assert_close(scene.current[0, 0], torch.tensor([0.0, 0.0, 0.0, 5.0]))


def test_a_scene_with_a_frame_is_refused() -> None:
    scene = aligned(moved(highway_scene(2), 0.0, (0.0, 0.0)))
    with pytest.raises(ValueError, match="frame already"):
        aligned(scene)
