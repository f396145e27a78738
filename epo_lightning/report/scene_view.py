"""A scene and its joint forecasts in the frame of their picture, where the main direction of traffic points right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from epo_lightning.forecast import JointForecast
from epo_lightning.scene import HEADING, KINDS, SPEED, Scene

LONGEST = 250.0
"""Largest length of road in a picture [m], as in the paper."""


@dataclass(frozen=True)
class JointMode:
    """One joint mode of a forecast: states of the agents, and goals if the game has them."""

    title: str
    states: Float[np.ndarray, "N K 4"]
    goals: Float[np.ndarray, "N 2"] | None


@dataclass(frozen=True)
class SceneView:
    """One scene in the frame of its picture: rotated so that traffic moves right, with the agents' mean at the origin.

    Absent agents are left out. History and future are one sequence of T steps, in which index ``now`` is t0.
    """

    states: Float[np.ndarray, "N T 4"]
    seen: Bool[np.ndarray, "N T"]
    now: int
    dt: float
    present: Bool[np.ndarray, " A"]
    names: Sequence[str]
    size: Float[np.ndarray, "N 2"] | None
    disc: Bool[np.ndarray, " N"]
    road: Float[np.ndarray, "segments 2 2"] | None
    origin: Float[np.ndarray, " 2"]
    angle: float

    @classmethod
    def of(cls, scene: Scene) -> SceneView:
        """The view of one scene (B = 1).

        Raises:
            ValueError: not exactly one scene, or no agent is observed at t0.
        """
        if len(scene.history) != 1:
            raise ValueError(f"a picture shows one scene, not {len(scene.history)}: choose one with scene[index]")
        present = _array(scene.agent_mask)
        states, seen = _array(scene.history)[present], _array(scene.history_mask)[present]
        now = states.shape[1] - 1
        if scene.future is not None:
            states = np.concatenate([states, _array(scene.future)[present]], axis=1)
            seen = np.concatenate([seen, _array(scene.future_mask)[present]], axis=1)
        seen = seen & np.isfinite(states).all(-1)
        if not seen[:, now].any():
            raise ValueError("scene without an observed agent at t0: there is nothing to draw")

        size = None if scene.size is None else _array(scene.size)[present]
        kinds = None if scene.kind is None else [KINDS[kind] for kind in _array(scene.kind)[present]]
        if kinds is not None:
            disc = np.array([kind == "pedestrian" for kind in kinds])
        else:
            disc = np.zeros(len(states), bool) if size is None else size[:, 0] == size[:, 1]
        numbers = [i + 1 for i in np.flatnonzero(present)]
        names = (
            [f"agent {n}" for n in numbers]
            if kinds is None
            else [f"{n} {k}" for n, k in zip(numbers, kinds, strict=True)]
        )

        road = None
        if scene.lanes is not None:
            road = _array(scene.lanes)[_array(scene.lane_mask)]
            road = road[np.isfinite(road).all(-1)].reshape(-1, 2, 2)
        origin, angle = np.zeros(2), 0.0
        if road is not None or not disc.all():
            current = states[seen[:, now], now]
            origin, angle = current[:, :2].mean(0), _direction(current[:, HEADING], current[:, SPEED])
            states = _turned(states, origin, angle)
            road = None if road is None else _rotated(road, origin, angle)
        return cls(states, seen, now, scene.dt, present, names, size, disc, road, origin, angle)

    @property
    def is_road(self) -> bool:
        """Whether the scene has lanes or vehicles, and so a main direction."""
        return self.road is not None or not self.disc.all()

    def turned(self, future: JointMode) -> JointMode:
        """A joint mode of this scene in the frame of the picture, without absent agents."""
        states = _turned(future.states[self.present], self.origin, self.angle)
        goals = None if future.goals is None else _rotated(future.goals[self.present], self.origin, self.angle)
        return JointMode(future.title, states, goals)

    def region(self, futures: Sequence[JointMode]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m] of the shown region: all observations, and forecasts as far as they stay near them."""
        margin, least, beyond = (5.0, (80.0, 18.0), (LONGEST, 12.0)) if self.is_road else (1.0, (8.0, 6.0), (8.0, 5.0))
        reach = 0.0 if self.size is None else float(np.nanmax(self.size[:, 0])) / 2
        known = self.states[..., :2][self.seen]
        low, high = known.min(0), known.max(0)
        points = [f.states[..., :2].reshape(-1, 2) for f in futures] + [f.goals for f in futures if f.goals is not None]
        forecast = np.concatenate(points)
        forecast = forecast[np.isfinite(forecast).all(-1)].clip(low - beyond, high + beyond)
        everything = np.concatenate([known, forecast])
        around = np.array([margin + reach, margin])
        low, high = everything.min(0) - around, everything.max(0) + around
        missing = np.maximum(least - (high - low), 0) / 2
        low, high = low - missing, high + missing
        now = np.median(self.states[self.seen[:, self.now], self.now, :2], axis=0)
        for axis, behind in (
            (0, 1 / 3),
            (1, 1 / 2),
        ):  # keep t0 in the picture, with more of the future than of the past
            if high[axis] - low[axis] > LONGEST:
                low[axis] = np.clip(now[axis] - behind * LONGEST, low[axis], high[axis] - LONGEST)
                high[axis] = low[axis] + LONGEST
        return low, high


def _array(values: Any) -> np.ndarray:
    """The first scene of a tensor as an array; floating-point numbers in double precision."""
    values = values[0].detach().cpu()
    return (values.double() if values.is_floating_point() else values).numpy()


def by_probability(forecast: JointForecast) -> list[int]:
    """Indices of the joint modes, most likely first."""
    return [int(m) for m in np.argsort(-_array(forecast.probabilities), kind="stable")]


def joint_mode(forecast: JointForecast, mode: int, name: str) -> JointMode:
    """Joint mode number ``mode`` of a forecast, with its name and probability as title."""
    goals = None if forecast.parameters is None else forecast.parameters.goals
    title = f"p = {_array(forecast.probabilities)[mode]:.2f}"
    return JointMode(
        f"{name},  {title}" if name else title,
        _array(forecast.states)[mode],
        None if goals is None else _array(goals)[mode],
    )


def _direction(heading: Float[np.ndarray, " N"], speed: Float[np.ndarray, " N"]) -> float:
    """Main direction of traffic [rad]; oncoming vehicles count for the same axis, and the majority gives the sign."""
    weight = np.abs(speed) + 0.1
    angle = float(np.angle((weight * np.exp(2j * heading)).sum())) / 2
    return angle if (weight * np.cos(heading - angle)).sum() >= 0 else angle + np.pi


def _rotated(points: Float[np.ndarray, "*shape 2"], origin: np.ndarray, angle: float) -> Float[np.ndarray, "*shape 2"]:
    """Points in the frame at ``origin`` whose x axis has direction ``angle``."""
    x, y = np.moveaxis(points - origin, -1, 0)
    with np.errstate(invalid="ignore"):  # infinity times zero; points that are not finite are left out later
        return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x], axis=-1)


def _turned(states: Float[np.ndarray, "*shape 4"], origin: np.ndarray, angle: float) -> Float[np.ndarray, "*shape 4"]:
    """States in the frame at ``origin`` whose x axis has direction ``angle``."""
    heading = states[..., HEADING, None] - angle
    return np.concatenate([_rotated(states[..., :2], origin, angle), heading, states[..., SPEED, None]], axis=-1)
