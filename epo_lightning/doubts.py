"""Doubts about scenes that a user has made: values that are allowed, and nearly always a mistake.

They are computed in numpy: for single scenes, every operation of PyTorch takes five times as long. Numbers that are not
finite are not doubted, because they have a warning of their own.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from epo_lightning.scene import HEADING, SPEED, Scene

SLACK, SHARE, NOISE = 0.5, 0.4, 0.1
"""Velocity [m/s], share of the larger one, and displacement [m] by which observed and stated motions may differ."""
FAR = 1e4
"""Distance [m] from the origin beyond which positions are taken for coordinates of a map."""
NAMED = 10
"""Largest number of scenes that a sentence names."""


def of_history(scene: Scene, trained: int | None) -> str | None:
    """A sentence on histories of another length than those of the training; None if they agree, or that is not known.

    Histories are as long as their tensor: steps that are padded by ``history_mask`` count.
    """
    steps = scene.history.shape[2]
    if trained is None or steps == trained:
        return None
    return f"the history has {steps} steps, and that of the training had {trained}: errors may be larger"


def of_game_end(scene: Scene, longest: int | None) -> str | None:
    """A sentence on games that go on after the forecast and whose ends are not given; None if there are none.

    Args:
        scene: the scenes.
        longest: steps of the longest game of the forecaster; None if its games end with the forecast.
    """
    if longest is None or scene.game_steps is not None:
        return None
    return (
        f"the scene has no game_steps, so each game is taken to last {longest} steps after t0: give the number of steps "
        "[B] to the end of each game, or errors may be larger"
    )


@np.errstate(invalid="ignore", over="ignore")
def of_coordinates(scene: Scene) -> str | None:
    """A sentence on scenes in the coordinates of a map; None if there are none."""
    far = abs(array(scene.current)[..., :2]).max(-1) > FAR
    if not (rows := _scenes(far & array(scene.agent_mask))):
        return None
    return (
        f"in {rows} agents are more than {FAR / 1000:.0f} km from the origin. Forecasters read positions as they are given, "
        "and single precision rounds these to a millimetre or more: epo_lightning.frames.aligned moves scenes to the origin"
    )


@np.errstate(invalid="ignore", over="ignore")
def of_motion(scene: Scene) -> str | None:
    """A sentence on scenes whose headings and speeds are not those of their positions; None if there are none."""
    if scene.history.shape[2] < 2 or not (rows := _scenes(_moves_otherwise(scene))):
        return None
    return (
        f"in {rows} agents do not move in the direction of their headings with their speeds: states are x, y [m], heading "
        "[rad], speed [m/s], oldest first, dt seconds apart"
    )


def shows_motion(scene: Scene) -> bool:
    """Whether an agent moves, so that :func:`of_motion` can tell if units and axes are right."""
    moves = abs(array(scene.current)[..., SPEED]) > SLACK  # False for NaN
    return scene.history.shape[2] > 1 and bool((moves & array(scene.agent_mask)).any())


@np.errstate(invalid="ignore", over="ignore")
def of_goal_headings(scene: Scene) -> str | None:
    """A sentence on scenes whose goal headings were wrapped; None if there are none."""
    if scene.goal_headings is None:
        return None
    assert scene.goal_mask is not None
    turn = abs(array(scene.goal_headings) - array(scene.current)[..., HEADING, None])
    exists = array(scene.goal_mask) & array(scene.agent_mask)[..., None]
    rows = _scenes((turn > math.pi + 1e-3) & np.isfinite(turn) & exists)
    if not rows:
        return None
    return (
        f"in {rows} a goal heading differs from the agent's heading at t0 by more than half a turn: headings are not "
        "wrapped, so add or subtract 2 pi unless the agent has to turn that far"
    )


def _moves_otherwise(scene: Scene) -> Bool[np.ndarray, "B N"]:
    """Mask of the agents whose mean observed velocity is not that of their headings and speeds."""
    seen = array(scene.history_mask)
    steps = seen[..., 1:] & seen[..., :-1] & array(scene.agent_mask)[..., None]
    time = scene.dt * steps.sum(-1).clip(1)
    states = array(scene.history)
    velocity = states[..., :-1, SPEED] * np.exp(1j * states[..., :-1, HEADING])  # in the plane, as complex numbers
    moved = np.diff(states[..., 0] + 1j * states[..., 1], axis=-1)
    stated = np.where(steps, velocity, 0.0).sum(-1) * scene.dt / time
    observed = np.where(steps, moved, 0.0).sum(-1) / time
    return contradict(observed, stated, time)


def contradict(one: np.ndarray, other: np.ndarray, time: np.ndarray | float) -> np.ndarray:
    """Mask of velocities, as complex numbers, that differ by more than noise of positions within a time [s] explains."""
    return np.asarray(abs(one - other) > SLACK + SHARE * np.maximum(abs(one), abs(other)) + NOISE / time)


def array(tensor: Tensor) -> np.ndarray:
    """A tensor's values on the CPU, in single or double precision."""
    tensor = tensor.detach().cpu().resolve_neg()
    if tensor.is_floating_point() and tensor.dtype not in (torch.float32, torch.float64):
        tensor = tensor.double()
    return np.asarray(tensor.numpy())


def _scenes(doubtful: np.ndarray) -> str:
    """The scenes with a doubtful entry, of many the first ones; empty if there are none."""
    rows = np.flatnonzero(doubtful.any(axis=tuple(range(1, doubtful.ndim)))).tolist()
    more = f" and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
    return f"scene(s) {', '.join(map(str, rows[:NAMED]))}{more} of the batch" if rows else ""
