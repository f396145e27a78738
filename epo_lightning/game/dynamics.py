"""How controls become states: the dynamically extended unicycle of Appendix C.2, without a loop over time.

Speed and heading are cumulative sums of the controls, and positions are cumulative sums of the velocities that follow, so a
whole trajectory is three scans. The three integrators differ only in the velocity with which a position step is taken:

    p_{k+1} = p_k + dt (beta v_k e(theta_k) + (1 - beta) v_{k+1} e(theta_{k+1})),   e(theta) = (cos theta, sin theta),

with beta = 1 for explicit Euler (the paper), 0 for semi-implicit Euler and 1/2 for Heun's method.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import ACCELERATION, HEADING, SPEED, TURN_RATE

_BETA = {"euler": 1.0, "semi_implicit": 0.0, "heun": 0.5}


def _direction(heading: Float[Tensor, "..."]) -> Float[Tensor, "... 2"]:
    return torch.stack((heading.cos(), heading.sin()), -1)


def _turn_left(vector: Float[Tensor, "... 2"]) -> Float[Tensor, "... 2"]:
    """R(90 degrees) times a vector."""
    return torch.stack((-vector[..., 1], vector[..., 0]), -1)


@register("dynamics", "unicycle")
@dataclass(frozen=True)
class Unicycle:
    """State x, y [m], heading [rad], speed [m/s]; control acceleration [m/s^2], turn rate [rad/s] (Eq. 13).

    Attributes:
        integrator: ``euler`` (the paper's), ``semi_implicit`` or ``heun``.
    """

    integrator: str = "euler"

    def __post_init__(self) -> None:
        if self.integrator not in _BETA:
            raise ConfigError(f"unknown integrator {self.integrator!r}: {nearest(str(self.integrator), _BETA)}")

    def rollout(
        self, initial: Float[Tensor, "*#batch 4"], controls: Float[Tensor, "*batch K 2"], dt: float
    ) -> Float[Tensor, "*batch K 4"]:
        """The states x_1 .. x_K that piecewise constant controls u_0 .. u_{K-1} lead to from x_0."""
        beta = _BETA[self.integrator]
        # Node l = 0 .. K: heading and speed before the first and after every step.
        start = initial[..., None, :].expand(*controls.shape[:-2], 1, 4)
        scan = dt * controls.cumsum(-2)
        speed = torch.cat((start[..., SPEED], start[..., SPEED] + scan[..., ACCELERATION]), -1)
        heading = torch.cat((start[..., HEADING], start[..., HEADING] + scan[..., TURN_RATE]), -1)
        velocity = speed[..., None] * _direction(heading)
        step = beta * velocity[..., :-1, :] + (1.0 - beta) * velocity[..., 1:, :]
        position = start[..., :2] + dt * step.cumsum(-2)
        return torch.cat((position, heading[..., 1:, None], speed[..., 1:, None]), -1)

    def position_sensitivity(
        self, states: Float[Tensor, "*batch K 4"], initial: Float[Tensor, "*#batch 4"], dt: float
    ) -> Float[Tensor, "*batch K 2 K 2"]:
        """d p_k / d u_j in closed form, for positions k = 1 .. K (rows) and controls j = 0 .. K-1 (columns).

        A turn rate at step j rotates everything that is travelled after node j + 1 about that node, and an acceleration
        stretches it along the headings: with q_k = dt sum_l e_l weighted as the positions are,

            d p_k / d omega_j = dt [R90 (p_k - p_{j+1}) + (1 - beta) dt v_{j+1} R90 e_{j+1}],
            d p_k / d a_j     = dt [     q_k - q_{j+1}  + (1 - beta) dt           e_{j+1}],      k > j.
        """
        beta = _BETA[self.integrator]
        position, heading, speed = states[..., :2], states[..., HEADING], states[..., SPEED]
        direction = _direction(heading)
        before = torch.cat((_direction(initial[..., None, HEADING]).expand_as(direction[..., :1, :]), direction), -2)
        distance = dt * (beta * before[..., :-1, :] + (1.0 - beta) * before[..., 1:, :]).cumsum(-2)
        edge = (1.0 - beta) * dt * direction

        def since(path: Tensor, edge: Tensor) -> Tensor:
            return path[..., :, None, :] - (path - edge)[..., None, :, :]

        by_turn_rate = _turn_left(since(position, speed[..., None] * edge))
        by_acceleration = since(distance, edge)
        steps = states.shape[-2]
        reached = torch.ones(steps, steps, dtype=torch.bool, device=states.device).tril()
        sensitivity = dt * torch.stack((by_acceleration, by_turn_rate), -1)  # [*batch K K 2 2]: row, column, xy, u
        return sensitivity.mul(reached[:, :, None, None]).movedim(-2, -3)
