"""Frames of scenes: moved worlds, aligned scenes, and headings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from data.recorded.window_scenes import crowd, scenes_of
from epo_lightning.data.recorded.windows import WindowConfig

from .roads import curve, recording


@given(st.integers(0, 10_000), st.floats(-3.1, 3.1))
@settings(max_examples=15)
def test_moving_the_world_moves_the_frame_and_nothing_else(seed, turn):
    vehicles = crowd(seed, 6)
    config = WindowConfig(radius=None, lane_change=False)
    here, _ = scenes_of(recording(curve(900.0), vehicles), config, "aligned")
    there, _ = scenes_of(recording(curve(900.0, turn, (-7000.0, 2500.0)), vehicles), config, "aligned")
    for name in ("history", "future", "goal_candidates", "references", "reference_speed", "lanes"):
        one, other = getattr(here, name), getattr(there, name)
        torch.testing.assert_close(one, other, rtol=0, atol=5e-4)
    moved, _ = scenes_of(recording(curve(900.0, 0.0, (-7000.0, 2500.0)), vehicles), config)
    still, _ = scenes_of(recording(curve(900.0), vehicles), config)
    for name in ("history", "future", "goal_candidates", "references", "lanes"):
        torch.testing.assert_close(getattr(moved, name), getattr(still, name), rtol=0, atol=5e-4)


def test_an_aligned_scene_is_the_fixed_one_in_its_own_frame():
    of = recording(curve(700.0, 0.4, (4000.0, -900.0)))
    (fixed, _), (aligned, _) = scenes_of(of), scenes_of(of, frame="aligned")
    angle = aligned.frame[:, 2]
    assert angle.min() > 0.3
    cosine, sine = angle.cos(), angle.sin()
    rotation = torch.stack((torch.stack((cosine, -sine), -1), torch.stack((sine, cosine), -1)), -2)
    for name in ("history", "future", "goal_candidates", "references", "lanes"):
        here, there = (getattr(scene, name).double() for scene in (aligned, fixed))
        for ends in (slice(0, 2), slice(2, 4)) if name == "lanes" else (slice(0, 2),):
            turned = torch.einsum("bij,b...j->b...i", rotation, here[..., ends])
            torch.testing.assert_close(turned, there[..., ends], rtol=0, atol=2e-3)
        if name in ("history", "future"):
            torch.testing.assert_close(here[..., 2] + angle[:, None, None], there[..., 2], rtol=0, atol=1e-5)
            assert torch.equal(here[..., 3], there[..., 3])


def test_agents_that_head_against_each_other_are_aligned_with_the_focal_one():
    of = recording(vehicles=((1, 30.0, 0, 20.0, None), (2, 60.0, 1, 20.0, None)))
    away = of.tracks.agent == 1
    tracks = dataclasses.replace(
        of.tracks,
        heading=of.tracks.heading + np.where(away, np.pi, 0.0),
        velocity=of.tracks.velocity * np.where(away, -1.0, 1.0)[:, None],
    )
    config = WindowConfig(agents=2, least_agents=2, lane_change=False)
    for turn in (0.0, 1e-6, 1.0):
        cosine, sine = np.cos(turn), np.sin(turn)
        rotation = np.array([[cosine, -sine], [sine, cosine]])
        turned = dataclasses.replace(
            tracks,
            position=tracks.position @ rotation.T,
            heading=tracks.heading + turn,
            velocity=tracks.velocity @ rotation.T,
        )
        scene, _ = scenes_of(dataclasses.replace(of, tracks=turned, lanes=None), config, "aligned")
        torch.testing.assert_close(scene.current[:, 0, 2], torch.zeros(len(scene.history)), rtol=0, atol=1e-5)


@pytest.mark.parametrize("turn", [np.pi - 0.02, np.pi, 0.02 - np.pi, 7.0])
def test_aligned_headings_are_small_wherever_the_road_leads(turn):
    """Headings on both sides of half a turn, in the axes of the recording, are near each other in those of the scene."""
    scene, _ = scenes_of(recording(curve(None, turn)), frame="aligned")
    assert 0.05 < scene.history[..., 2].abs().max() < 0.5


def test_headings_begin_within_half_a_turn_and_go_on_without_a_jump():
    of = recording(curve(100.0, 2.5), vehicles=((1, 5.0, 0, 25.0, None),))
    scene, _ = scenes_of(of, WindowConfig(agents=1, least_agents=1, lane_change=False))
    current = scene.current[:, 0, 2]
    assert current.min() < -1.0, "the recording turns beyond half a turn"
    assert current.max() > 2.9
    assert (current.abs() <= np.pi + 1e-5).all()
    way = torch.cat((scene.history, scene.future), 2)[:, 0, :, 2]
    assert (way.diff(dim=1) - 25.0 * 0.2 / 100.0).abs().max() < 0.01
