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
        start = initial[..., None, :].expand(*controls.shape[:-2], 1, 4)
        scan = dt * controls.cumsum(-2)
        heading = start[..., HEADING] + scan[..., TURN_RATE]
        speed = start[..., SPEED] + scan[..., ACCELERATION]
        # Velocities at the nodes l = 0 .. K: before the first step and after every step.
        before = start[..., SPEED, None] * _direction(start[..., HEADING])
        velocity = torch.cat((before, speed[..., None] * _direction(heading)), -2)
        position = start[..., :2] + self._travel(velocity, dt)
        return torch.cat((position, heading[..., None], speed[..., None]), -1)

    def tangent(
        self, states: Float[Tensor, "*batch K 4"], direction: Float[Tensor, "D *batch K 2"], dt: float
    ) -> Float[Tensor, "D *batch K 4"]:
        """How the states that :meth:`rollout` returned change along D directions of the controls."""
        scan = dt * direction.cumsum(-2)
        by_heading, by_speed = scan[..., TURN_RATE, None], scan[..., ACCELERATION, None]
        ahead = _direction(states[..., HEADING])
        velocity = by_speed * ahead + states[..., SPEED, None] * by_heading * _turn_left(ahead)
        position = self._travel(torch.cat((torch.zeros_like(velocity[..., :1, :]), velocity), -2), dt)
        return torch.cat((position, by_heading, by_speed), -1)

    def _travel(self, velocity: Float[Tensor, "*batch nodes 2"], dt: float) -> Float[Tensor, "*batch nodes-1 2"]:
        """Way covered up to every step, from the velocities at the nodes."""
        beta = _BETA[self.integrator]
        return dt * (beta * velocity[..., :-1, :] + (1.0 - beta) * velocity[..., 1:, :]).cumsum(-2)

    def anchors(
        self, states: Float[Tensor, "*batch K 4"], initial: Float[Tensor, "*#batch 4"], dt: float
    ) -> tuple[Float[Tensor, "*batch K 2 2"], Float[Tensor, "*batch K 2 2"]]:
        """Sensitivities of positions in closed form: d p_k / d u_j = tip_k - root_j for j < k, zero otherwise.

        A turn rate at step j rotates all that is travelled after node j + 1 about that node, and an acceleration stretches
        it along the headings: with q_k = dt sum_l e_l weighted as the positions are,

            d p_k / d omega_j = dt [R90 (p_k - p_{j+1}) + (1 - beta) dt v_{j+1} R90 e_{j+1}],
            d p_k / d a_j     = dt [     q_k - q_{j+1}  + (1 - beta) dt           e_{j+1}].

        Returns:
            tips of positions k = 1 .. K and roots of controls j = 0 .. K-1; the last dimensions are control and x, y.
        """
        ahead = _direction(states[..., HEADING])
        before = _direction(initial[..., None, HEADING]).expand_as(ahead[..., :1, :])
        position, distance = states[..., :2], self._travel(torch.cat((before, ahead), -2), dt)
        edge = (1.0 - _BETA[self.integrator]) * dt * ahead
        tip = torch.stack((distance, _turn_left(position)), -2)
        root = torch.stack((distance - edge, _turn_left(position - states[..., SPEED, None] * edge)), -2)
        return dt * tip, dt * root
