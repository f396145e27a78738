"""The order of a pair of agents: which of them goes first, or on which side they pass each other.

An order is a sign s_ij = +1 or -1 for every pair. An energy that takes orders as given declares them by
:attr:`~epo_lightning.game.energy.Energy.pair_order`; a decoder predicts them, objectives learn from observed ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.scene import HEADING, Scene, heading_vector, observed_future, velocities

ALONG, ACROSS = "along", "across"
DIRECTIONS = (ALONG, ACROSS)
_STILL = 1e-3
"""Speed [m/s], distance [m] or length below which a vector has no direction."""


@dataclass(frozen=True)
class PairOrder:
    """The meaning of an order +1 or -1: agent i of a pair (i, j) is ahead of j in a direction n_ij, or behind.

    - ``along``: n_ij is the mean heading of both agents at t0, and the order says which agent goes first (merges). Swapping
      the agents changes its sign. If the headings are opposite, n_ij is their common line towards positive x.
    - ``across``: n_ij is the relative velocity v_i - v_j at t0, turned left by 90 degrees, and the order says on which side
      they pass: +1 if each agent has the other on its right. Swapping the agents does not change it. Without a relative
      velocity, n_ij is the turned direction from j to i; if the positions are the same as well, n_ij is the y axis.

    Attributes:
        direction: ``along`` or ``across``.
        within: distance [m] up to which two agents are near each other, so that their order matters.
    """

    direction: str
    within: float

    @property
    def symmetric(self) -> bool:
        """Whether the order keeps its sign when the two agents are swapped."""
        return self.direction == ACROSS

    def directions(self, scene: Scene) -> Float[Tensor, "B P 2"]:
        """The unit vectors n_ij, in which i is ahead of j for an order of +1. Constants of the scene."""
        initial = scene.current_or_zero
        first, second = pairs(initial.shape[1], initial.device)
        axis = heading_vector(initial[..., HEADING])
        if self.direction == ALONG:
            line = axis[:, first]
            # Towards positive x (positive y for lines parallel to y), so that the result does not depend on the agent.
            upright = line[..., 0].abs() < _STILL
            towards = torch.where(upright, line[..., 1], line[..., 0])
            line = torch.where((towards < 0)[..., None], -line, line)
            return _unit_or(axis[:, first] + axis[:, second], line)
        velocity = velocities(initial)
        joining = initial[:, first, :2] - initial[:, second, :2]
        upwards = torch.stack((torch.ones_like(joining[..., 0]), torch.zeros_like(joining[..., 0])), -1)
        towards = _unit_or(velocity[:, first] - velocity[:, second], _unit_or(joining, upwards))
        return torch.stack((-towards[..., 1], towards[..., 0]), -1)

    def near(self, scene: Scene, steps: int) -> Bool[Tensor, "B P K"]:
        """The steps 1 .. K at which both agents would be near each other at constant velocity."""
        initial = scene.current_or_zero
        first, second = pairs(initial.shape[1], initial.device)
        time = scene.dt * torch.arange(1, steps + 1, dtype=initial.dtype, device=initial.device)
        position = initial[..., None, :2] + time[:, None] * velocities(initial)[..., None, :]
        return (position[:, first] - position[:, second]).square().sum(-1) <= self.within**2

    def in_one_lane(
        self, scene: Scene, goals: Float[Tensor, "B M N 2"], steps: int, lane: float
    ) -> Bool[Tensor, "B M P K"]:
        """The steps 1 .. K at which both agents, on straight lines to their goals, are within ``lane`` [m] across n_ij."""
        present = scene.agent_mask[:, None, :, None]
        start, goals = (
            torch.where(present, scene.current_or_zero[:, None, :, :2], 0.0),
            torch.where(present, goals, 0.0),
        )
        first, second = pairs(goals.shape[2], goals.device)
        ahead = self.directions(scene)[:, None]
        aside = torch.stack((-ahead[..., 1], ahead[..., 0]), -1)
        before, after = (((at[:, :, first] - at[:, :, second]) * aside).sum(-1, keepdim=True) for at in (start, goals))
        share = torch.arange(1, steps + 1, dtype=goals.dtype, device=goals.device) / steps
        return (before + share * (after - before)).abs() <= lane

    def matters(self, scene: Scene, steps: int) -> Bool[Tensor, "B P"]:
        """The pairs whose order matters: both agents are present, and near each other at one step 1 .. K at least."""
        return pair_mask(scene) & self.near(scene, steps).any(-1)

    def observed(self, scene: Scene) -> tuple[Float[Tensor, "B P"], Bool[Tensor, "B P"]]:
        """The orders in the observed future, +1 where unknown, and the pairs whose order is known.

        ``along`` is read at the last step at which both agents were observed: the agent that is ahead there goes first. (The
        step of the smallest distance would not do, because during overtaking neither agent is ahead there.) ``across`` is
        read at the step of the smallest distance at which both were observed. An order is known for pairs that were observed
        together at some step, if it matters (:meth:`matters`).

        Raises:
            ValueError: the scene has no future.
        """
        future, observed = observed_future(scene, "observed orders are read from")
        first, second = pairs(scene.agent_mask.shape[1], scene.agent_mask.device)
        together = observed[:, first] & observed[:, second]
        position = torch.where(observed[..., None], future[..., :2], 0.0)
        apart = position[:, first] - position[:, second]
        if self.direction == ACROSS:
            decisive = torch.where(together, apart.square().sum(-1), torch.inf).argmin(-1)
        else:
            step = torch.arange(together.shape[-1], device=together.device)
            decisive = torch.where(together, step, -1).argmax(-1)
        way = apart.gather(2, decisive[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
        known = together.any(-1) & self.matters(scene, together.shape[-1])
        behind = known & ((self.directions(scene) * way).sum(-1) < 0)
        return torch.where(behind, -1.0, 1.0).to(position.dtype), known


def _unit_or(vector: Float[Tensor, "*batch 2"], otherwise: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """The unit vector, or ``otherwise`` where the vector vanishes."""
    length = vector.norm(dim=-1, keepdim=True)
    return torch.where(length > _STILL, vector / length.clamp_min(_STILL), otherwise)
