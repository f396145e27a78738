"""Doubts about scenes that a user has made: values that are allowed, and nearly always a mistake."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from epo_lightning.scene import HEADING, SPEED, Scene

SLACK, SHARE, NOISE = 0.5, 0.4, 0.1
"""Velocity [m/s], share of the larger one, and displacement [m] by which observed and stated motions may differ."""
NAMED = 10
"""Largest number of scenes that a sentence names."""


@np.errstate(invalid="ignore", over="ignore")  # numbers that are not finite have a warning of their own
def doubts(scene: Scene) -> list[str]:
    """Sentences on scenes whose headings and speeds are not those of their positions, or whose goal headings are wrapped.

    They are computed in numpy: for single scenes, every operation of PyTorch takes five times as long.
    """
    found = []
    if rows := _scenes(_moves_otherwise(scene)):
        found.append(
            f"in {rows} agents do not move in the direction of their headings with their speeds: states are x, y [m], "
            "heading [rad], speed [m/s], oldest first, dt seconds apart"
        )
    if scene.goal_headings is not None:
        assert scene.goal_mask is not None
        turn = abs(_array(scene.goal_headings) - _array(scene.current)[..., HEADING, None])
        exists = _array(scene.goal_mask) & _array(scene.agent_mask)[..., None]
        if rows := _scenes((turn > math.pi + 1e-3) & np.isfinite(turn) & exists):
            found.append(
                f"in {rows} a goal heading differs from the agent's heading at t0 by more than half a turn: headings are "
                "not wrapped, so add or subtract 2 pi unless the agent has to turn that far"
            )
    return found


def _moves_otherwise(scene: Scene) -> Bool[np.ndarray, "B N"]:
    """Mask of the agents whose mean observed velocity is not that of their headings and speeds."""
    states, seen = _array(scene.history), _array(scene.history_mask)
    steps = seen[..., 1:] & seen[..., :-1] & _array(scene.agent_mask)[..., None]
    time = scene.dt * steps.sum(-1).clip(1)
    heading, speed = states[..., :-1, HEADING], states[..., :-1, SPEED]
    stated = scene.dt * speed * np.exp(1j * heading)  # velocities in the plane, as complex numbers
    moved = states[..., 1:, :2] - states[..., :-1, :2]
    observed = moved[..., 0] + 1j * moved[..., 1]
    stated, observed = (np.where(steps, way, 0.0).sum(-1) / time for way in (stated, observed))
    allowed = SLACK + SHARE * np.maximum(abs(stated), abs(observed)) + NOISE / time
    return abs(observed - stated) > allowed


def _array(tensor: Tensor) -> np.ndarray:
    tensor = tensor.detach().cpu().resolve_neg()
    return np.asarray((tensor.double() if tensor.is_floating_point() else tensor).numpy())


def _scenes(doubtful: np.ndarray) -> str:
    """The scenes with a doubtful entry, of many the first ones; empty if there are none."""
    rows = np.flatnonzero(doubtful.any(axis=tuple(range(1, doubtful.ndim)))).tolist()
    more = f" and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
    return f"scene(s) {', '.join(map(str, rows[:NAMED]))}{more} of the batch" if rows else ""
