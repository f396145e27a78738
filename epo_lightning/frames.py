"""Frames of scenes: from coordinates of a map to those in which forecasters were trained, and back.

Forecasters of highways and urban roads read positions in the frame of their scene, which has its origin at the mean present
position of the agents and its x axis along their mean heading::

    scene = aligned(scene)
    forecast = forecaster.predict(scene)
    states = in_world(forecast.states, scene.frame)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.scene import HEADING, Scene, heading_vector, rotated

AGREE = 0.2
"""Smallest length of the mean of the agents' unit directions; below it, they have no common direction."""


def aligned(scene: Scene) -> Scene:
    """The scenes in the frames of recorded data: the agents' mean present position is the origin, their mean heading x.

    If headings oppose each other, their mean has no meaning, and the heading of the first agent is x. At t0, headings lie
    within half a turn of x; other headings keep their differences from them. Coordinates of a map need double precision,
    which the result keeps.

    Returns:
        scenes whose ``frame`` leads back (:func:`in_world`), but for whole turns of headings.

    Raises:
        ValueError: scenes that have a frame already.
    """
    if scene.frame is not None:
        raise ValueError(
            "the scene has a frame already (scene.frame): aligned() takes scenes in coordinates of the world"
        )
    there, current = scene.agent_mask[..., None], scene.current_or_zero
    count = there.sum(1).clamp_min(1)
    origin = current[..., :2].sum(1) / count
    heading = current[..., HEADING]
    direction = torch.where(there, heading_vector(heading), 0.0).sum(1) / count
    first = torch.where(scene.agent_mask & (scene.agent_mask.cumsum(1) == 1), heading, 0.0).sum(1)
    angle = torch.where(direction.norm(dim=-1) < AGREE, first, torch.atan2(direction[:, 1], direction[:, 0]))
    turns = 2 * math.pi * torch.round((heading - angle[:, None]) / (2 * math.pi))

    def points(values: Tensor) -> Tensor:
        """Positions, or lines from one position to the next, in the frames."""
        batch = (len(values), *[1] * (values.dim() - 2))
        ends = [rotated(end - origin.view(*batch, 2), -angle.view(batch)) for end in values.split(2, -1)]
        return torch.cat(ends, -1)

    def states(values: Tensor) -> Tensor:
        headings = values[..., HEADING] - (angle[:, None] + turns)[..., None]
        return torch.cat((points(values[..., :2]), headings[..., None], values[..., HEADING + 1 :]), -1)

    ways: dict[str, Callable[[Tensor], Tensor]] = {
        **dict.fromkeys(("history", "future"), states),
        **dict.fromkeys(("goal_candidates", "lanes", "references"), points),
        "goal_headings": lambda headings: headings - (angle[:, None] + turns)[..., None],
    }
    moved: dict[str, Any] = {"frame": torch.cat((origin, angle[:, None]), -1)}
    moved |= {name: way(getattr(scene, name)) for name, way in ways.items() if getattr(scene, name) is not None}
    return dataclasses.replace(scene, **moved)


def in_world(states: Float[Tensor, "B *batch X"], frame: Float[Tensor, "B 3"]) -> Float[Tensor, "B *batch X"]:
    """States x, y, heading, speed, or positions x, y, of scenes in coordinates of the world, as precise as the frame."""
    batch = (len(states), *[1] * (states.dim() - 2))
    values, angle = states.to(frame.dtype), frame[:, 2].view(batch)
    position = rotated(values[..., :2], angle) + frame[:, :2].view(*batch, 2)
    if values.shape[-1] == 2:
        return position
    return torch.cat((position, (values[..., HEADING] + angle)[..., None], values[..., HEADING + 1 :]), -1)
