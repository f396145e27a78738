"""Scenes of data without a map, in the form that forecasters of mapped roads read.

A forecaster that learned on roads reads lanes, chooses a goal among candidates on lanes, and has costs of the distance from
a lane's centre and from a reference speed. Open space has none of them. :func:`in_open_space` adds, without reading the
future:

- a map without lanes: one polyline whose vectors are all masked, so that no attention reads it;
- goal candidates on seven curves of constant curvature, which begin at the agent with its heading;
- a reference line that does not exist (``reference_mask`` is False), so that the cost of lanes is zero;
- the present speed as the reference speed.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.data.datamodule import SceneDataset
from epo_lightning.data.recorded.routes import ACCELERATING, BRAKING, PER_LINE, SHORTEST
from epo_lightning.scene import HEADING, KINDS, SPEED, Scene

VERSION = 1
"""Version of the candidates: raised whenever the same scene would get others."""
ON_FOOT = 1.0
"""Largest acceleration of pedestrians [m/s^2], forwards and sideways; ``ACCELERATING`` for all other agents."""
CURVES = (1.0, 4 / 9, 1 / 9, 0.0, -1 / 9, -4 / 9, -1.0)
"""Curvatures of the curves, as shares of the largest one, from left to right. They are dense near straight ahead: the third
curve of an agent that moves with 3 m/s^2 sideways at most ends about one lane beside the middle one after 4 s."""


def in_open_space(scene: Scene) -> Scene:
    """The scene with an empty map and with goal candidates by heading and speed; unchanged if it has lanes.

    A candidate lies between the distance that an agent covers when it brakes and the one when it accelerates until the end
    of the future, as on a road (:meth:`~epo_lightning.data.recorded.routes.Routes.of`). The largest curvature keeps the
    lateral acceleration v^2 kappa within the agent's limit, and the whole curve within half a turn.

    Raises:
        ValueError: the scene has no future, whose number of steps is the horizon of the goals.
    """
    if scene.lanes is not None:
        return scene
    if scene.future is None:
        raise ValueError("goal candidates reach as far as scene.future [B, N, K, 4], which is None")
    batch, agents = scene.agent_mask.shape
    current = scene.current_or_zero
    limit = torch.full_like(current[..., SPEED], ACCELERATING)
    if scene.kind is not None:
        limit = limit.masked_fill(scene.kind == KINDS.index("pedestrian"), ON_FOOT)
    candidates = _candidates(current, limit, scene.future.shape[2] * scene.dt)
    exists = scene.agent_mask[..., None].expand(candidates.shape[:3])
    nothing = current.new_zeros(batch, agents, 1, 2, 2)
    return dataclasses.replace(
        scene,
        lanes=current.new_zeros(batch, 1, 1, 4),
        lane_mask=scene.agent_mask.new_zeros(batch, 1, 1),
        goal_candidates=candidates,
        goal_mask=exists,
        goal_reference=torch.zeros_like(exists, dtype=torch.long),
        references=nothing,
        reference_mask=scene.agent_mask.new_zeros(batch, agents, 1),
        reference_speed=current[..., SPEED].clamp_min(0.0),
    )


def _candidates(current: Float[Tensor, "B N 4"], limit: Float[Tensor, "B N"], time: float) -> Float[Tensor, "B N G 2"]:
    """Goal candidates [m] of all agents, curve by curve and from near to far.

    Args:
        current: states at t0.
        limit: largest acceleration of each agent [m/s^2], forwards and sideways.
        time: time within which goals are reached [s].
    """
    speed = current[..., SPEED].clamp_min(0.0)
    far = speed * time + limit * time**2 / 2
    stopping = (speed / BRAKING).clamp_max(time)
    near = torch.minimum(speed * stopping - BRAKING * stopping**2 / 2, far - SHORTEST).clamp_min(0.0)
    way = torch.linspace(0.0, 1.0, PER_LINE, dtype=current.dtype, device=current.device)
    along = (near[..., None] + (far - near)[..., None] * way)[:, :, None]
    # A standing agent has no lateral acceleration, and the limit of half a turn decides.
    largest = torch.minimum(limit / speed.square().clamp_min(1e-6), math.pi / far)
    curvature = largest[..., None] * torch.tensor(CURVES, dtype=current.dtype, device=current.device)
    half = 0.5 * curvature[..., None] * along
    chord = along * torch.sinc(half / math.pi)
    direction = current[..., HEADING, None, None] + half
    found = torch.stack((chord * direction.cos(), chord * direction.sin()), -1).flatten(2, 3)
    return current[..., None, :2] + found


class OpenSpace:
    """Scenes of a data set without a map, with the additions of :func:`in_open_space`.

    Args:
        whole: scenes without lanes.
    """

    def __init__(self, whole: SceneDataset) -> None:
        self.whole = whole

    def __len__(self) -> int:
        return len(self.whole)

    @property
    def provenance(self) -> Any:
        """Provenance of the scenes of the underlying data set, if it has any."""
        return getattr(self.whole, "provenance", None)

    def __getitem__(self, indices: Tensor) -> Scene:
        return in_open_space(self.whole[indices])

    def set_epoch(self, epoch: int) -> None:
        """Prepare the samples of an epoch of the whole data set."""
        self.whole.set_epoch(epoch)
