"""Dynamics, the map from controls to states: the dynamically extended unicycle of Appendix E.2, without a loop over time.

Speed and heading are cumulative sums of the controls, and positions are cumulative sums of the velocities that follow, so a
whole trajectory is three scans. The three integrators differ only in the velocity with which a position step is taken:

    p_{k+1} = p_k + dt (beta v_k e(theta_k) + (1 - beta) v_{k+1} e(theta_{k+1})),   e(theta) = (cos theta, sin theta),

with beta = 1 for explicit Euler (the paper), 0 for semi-implicit Euler and 1/2 for Heun's method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.checks import check_choice
from epo_lightning.registry import register
from epo_lightning.scene import ACCELERATION, HEADING, SPEED, TURN_RATE, heading_vector, velocities, wrapped

_BETA = {"euler": 1.0, "semi_implicit": 0.0, "heun": 0.5}


def _turn_left(vector: Float[Tensor, "... 2"]) -> Float[Tensor, "... 2"]:
    """R(90 degrees) times a vector."""
    return torch.stack((-vector[..., 1], vector[..., 0]), -1)


def controls_between(states: Float[Tensor, "*batch T 4"], dt: float) -> Float[Tensor, "*batch T-1 2"]:
    """Controls of a unicycle between its states: changes of speed and heading per second, turns being at most half a turn.

    Headings need not be continuous: a recording that wraps them at pi gives the same controls.
    """
    change = states[..., [SPEED, HEADING]].diff(dim=-2)
    return torch.stack((change[..., 0], wrapped(change[..., 1])), -1) / dt


@runtime_checkable
class Rollout(Protocol):
    """The map from controls to states, for every agent independently of the others."""

    def rollout(
        self, initial: Float[Tensor, "*#batch 4"], controls: Float[Tensor, "*batch K 2"], dt: float
    ) -> Float[Tensor, "*batch K 4"]:
        """The states x_1 .. x_K that piecewise constant controls u_0 .. u_{K-1} lead to from x_0."""
        ...


@runtime_checkable
class Dynamics(Rollout, Protocol):
    """The interface of dynamics whose derivative is known too."""

    def tangent(
        self, states: Float[Tensor, "*batch K 4"], direction: Float[Tensor, "directions *batch K 2"], dt: float
    ) -> Float[Tensor, "directions *batch K 4"]:
        """The change of the states of :meth:`rollout` along the directions of the controls."""
        ...


@register("dynamics", "unicycle")
@dataclass(frozen=True)
class Unicycle:
    """State x, y [m], heading [rad], speed [m/s]; control acceleration [m/s^2], turn rate [rad/s] (Eq. 13).

    Attributes:
        integrator: ``euler`` (the paper's), ``semi_implicit`` or ``heun``.
    """

    integrator: str = "euler"

    def __post_init__(self) -> None:
        check_choice("dynamics.integrator", self.integrator, _BETA)

    @property
    def beta(self) -> float:
        """Weight of the velocity before a step in the displacement of that step."""
        return _BETA[self.integrator]

    def rollout(
        self, initial: Float[Tensor, "*#batch 4"], controls: Float[Tensor, "*batch K 2"], dt: float
    ) -> Float[Tensor, "*batch K 4"]:
        """The states x_1 .. x_K that piecewise constant controls u_0 .. u_{K-1} lead to from x_0."""
        start = initial[..., None, :].expand(*controls.shape[:-2], 1, 4)
        scan = dt * controls.cumsum(-2)
        heading = start[..., HEADING] + scan[..., TURN_RATE]
        speed = start[..., SPEED] + scan[..., ACCELERATION]
        # Velocities at the nodes l = 0 .. K: before the first step and after every step.
        before = velocities(start)
        velocity = torch.cat((before, speed[..., None] * heading_vector(heading)), -2)
        position = start[..., :2] + self._travel(velocity, dt)
        return torch.cat((position, heading[..., None], speed[..., None]), -1)

    def tangent(
        self, states: Float[Tensor, "*batch K 4"], direction: Float[Tensor, "directions *batch K 2"], dt: float
    ) -> Float[Tensor, "directions *batch K 4"]:
        """The change of the states of :meth:`rollout` along the directions of the controls."""
        scan = dt * direction.cumsum(-2)
        by_heading, by_speed = scan[..., TURN_RATE, None], scan[..., ACCELERATION, None]
        ahead = heading_vector(states[..., HEADING])
        velocity = by_speed * ahead + states[..., SPEED, None] * by_heading * _turn_left(ahead)
        position = self._travel(torch.cat((torch.zeros_like(velocity[..., :1, :]), velocity), -2), dt)
        return torch.cat((position, by_heading, by_speed), -1)

    def _travel(self, velocity: Float[Tensor, "*batch nodes 2"], dt: float) -> Float[Tensor, "*batch nodes-1 2"]:
        """Displacement up to every step, from the velocities at the nodes."""
        if self.beta == 1.0:
            return dt * velocity[..., :-1, :].cumsum(-2)
        return dt * (self.beta * velocity[..., :-1, :] + (1.0 - self.beta) * velocity[..., 1:, :]).cumsum(-2)
