"""Doubts about scenes that a user has made: values that are allowed, and nearly always a mistake."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from epo_lightning.scene import HEADING, SPEED, Scene

SLACK, SHARE, NOISE = 0.5, 0.4, 0.1
"""Velocity [m/s], share of the larger one, and displacement [m] by which observed and stated motions may differ."""


def doubts(scene: Scene) -> list[str]:
    """Sentences on scenes whose headings and speeds are not those of their positions, or whose goal headings are wrapped."""
    found = []
    if rows := _scenes(_moves_otherwise(scene)):
        found.append(
            f"in scene(s) {rows} agents do not move in the direction of their headings with their speeds: states are x, y "
            "[m], heading [rad], speed [m/s], oldest first, dt seconds apart"
        )
    if scene.goal_headings is not None:
        assert scene.goal_mask is not None
        turn = (scene.goal_headings - scene.current[..., None, HEADING]).abs()
        if rows := _scenes((turn > math.pi + 1e-3) & scene.goal_mask & scene.agent_mask[..., None]):
            found.append(
                f"in scene(s) {rows} a goal heading differs from the agent's heading at t0 by more than half a turn: "
                "headings are not wrapped, so add or subtract 2 pi unless the agent has to turn that far"
            )
    return found


def _moves_otherwise(scene: Scene) -> Tensor:
    """Mask [B, N] of the agents whose mean observed velocity is not that of their headings and speeds."""
    states, seen = scene.history, scene.history_mask & scene.agent_mask[..., None]
    steps = (seen[..., 1:] & seen[..., :-1])[..., None]
    time = scene.dt * steps.sum(2).clamp_min(1)
    heading, speed = states[..., :-1, HEADING], states[..., :-1, SPEED]
    stated = scene.dt * speed[..., None] * torch.stack((heading.cos(), heading.sin()), -1)
    observed = states[..., 1:, :2] - states[..., :-1, :2]
    stated, observed = (torch.where(steps, way, 0.0).sum(2) / time for way in (stated, observed))
    largest = torch.maximum(stated.norm(dim=-1), observed.norm(dim=-1))
    return (observed - stated).norm(dim=-1) > SLACK + SHARE * largest + NOISE / time[..., 0]


def _scenes(doubtful: Tensor) -> list[int]:
    """Indices of the scenes with a doubtful entry."""
    return doubtful.flatten(1).any(1).nonzero().flatten().tolist()
