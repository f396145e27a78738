"""Scenes in the coordinates of a map, which a refinement moves to the origin and back.

Such coordinates have few digits in single precision, and the game does not depend on the origin.
"""

from __future__ import annotations

import dataclasses
import warnings

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.scene import Scene

FAR, RESOLUTION = 1000.0, 0.01
"""Distance [m] from the origin above which a scene is moved to it, and the coarsest resolution [m] without a warning."""


def origin_of(scene: Scene, dtype: torch.dtype) -> Float[Tensor, "B 2"] | None:
    """The mean present position of the agents of scenes in coordinates of a map; None if all scenes are near the origin.

    Args:
        scene: the scenes.
        dtype: type of the futures.

    Warns:
        UserWarning: positions that the types of scenes or futures round to more than :data:`RESOLUTION`.
    """
    if float(scene.current[..., :2].abs().sum()) <= FAR:  # a quick answer for most scenes
        return None
    farthest = float(scene.current_or_zero[..., :2].abs().max())
    if farthest <= FAR:
        return None
    resolution = farthest * max(torch.finfo(kind).eps for kind in (dtype, scene.history.dtype))
    if resolution > RESOLUTION:
        warnings.warn(
            f"positions are up to {farthest:.0f} m from the origin, where single precision has a resolution of "
            f"{resolution:.2g} m: give scene and futures in double precision, or subtract an origin",
            stacklevel=3,
        )
    return scene.current_or_zero[..., :2].sum(1) / scene.agent_mask.sum(-1, keepdim=True).clamp_min(1)


def moved(states: Float[Tensor, "*batch X"], by: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch X"]:
    """States with other positions."""
    return torch.cat((states[..., :2] + by.to(states.dtype), states[..., 2:]), -1)


def moved_back(forecast: JointForecast, by: Float[Tensor, "B 1 1 1 2"]) -> JointForecast:
    """A forecast with other positions."""
    assert forecast.initial_states is not None
    assert forecast.solution is not None
    return dataclasses.replace(
        forecast,
        states=moved(forecast.states, by),
        initial_states=moved(forecast.initial_states, by),
        solution=dataclasses.replace(forecast.solution, states=moved(forecast.solution.states, by)),
    )
