"""Linear dynamics: points that accelerate along and across their heading at t0.

With them a squared linear residual of the motion is a convex function of the controls, so that games can be convex.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.circles import length_of
from epo_lightning.registry import register
from epo_lightning.scene import HEADING, SPEED, rotated

STANDING = 0.1
"""Speed [m/s] below which the heading at t0 is used instead of the direction of the velocity."""


@register("dynamics", "double_integrator")
@dataclass(frozen=True)
class DoubleIntegrator:
    """State x, y [m], heading [rad], speed [m/s]; controls are accelerations along and across the heading theta_0 [m/s^2].

    Explicit Euler, p_{k+1} = p_k + dt v_k and v_{k+1} = v_k + dt R(theta_0) u_k, with v_0 = speed e(theta_0). Positions and
    velocities are linear in the controls. Heading and speed are direction and length of the velocity: the heading within
    180 degrees of theta_0, and theta_0 itself where the speed is below 0.1 m/s. Agents can move sideways.
    """

    def rollout(
        self, initial: Float[Tensor, "*#batch 4"], controls: Float[Tensor, "*batch K 2"], dt: float
    ) -> Float[Tensor, "*batch K 4"]:
        """The states x_1 .. x_K that piecewise constant controls u_0 .. u_{K-1} lead to from x_0."""
        start = initial[..., None, :].expand(*controls.shape[:-2], 1, 4)
        velocity = _before(start) + dt * controls.cumsum(-2)  # along and across theta_0
        travelled = dt * torch.cat((_before(start), velocity[..., :-1, :]), -2).cumsum(-2)
        position = start[..., :2] + rotated(travelled, start[..., HEADING])
        ahead, aside = velocity.unbind(-1)
        moving = velocity.square().sum(-1) >= STANDING**2
        turned = torch.atan2(torch.where(moving, aside, 0.0), torch.where(moving, ahead, 1.0))
        heading = start[..., HEADING] + turned
        return torch.cat((position, heading[..., None], length_of(velocity)[..., None]), -1)


def _before(start: Float[Tensor, "*batch 1 4"]) -> Float[Tensor, "*batch 1 2"]:
    """The velocity at t0, along and across the heading."""
    return torch.stack((start[..., SPEED], torch.zeros_like(start[..., SPEED])), -1)
