"""Candidates from a model of motion instead of a network (DSDNet, Zeng et al., ECCV 2020).

A mixture of 30% straight lines, 20% circular arcs and 50% clothoids around how agents move now. What is drawn at random
there comes from a quasi-random sequence here: forecasts repeat, and few candidates still cover the ranges evenly.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.scene import SPEED

STRAIGHT, ARCS = 0.3, 0.2
"""Shares of lines and of circles; the rest are clothoids."""
_BASES = (2, 3, 5)
"""Of Halton's sequence: prime to each other, so that no two coordinates agree and no clothoid is a circle."""
_FIRST = 2
"""Halton's first number in base 2 is 1/2, an acceleration of zero: a straight line with it is the first candidate again."""


class Motions(nn.Module):
    """C strategies of every agent for the unicycle; nothing is learned.

    The first keeps speed and heading. The others accelerate constantly, a in [-A, A], until they stand, and follow a curve:
    none, one of constant curvature kappa, or a clothoid, whose curvature changes linearly with the way covered, from one
    value at the start to another at the end. The turn rate is v kappa, so who stands does not turn. Curvatures are uniform
    in [-kappa_max, kappa_max], or as far as A allows sideways, |kappa| v^2 <= A, where that is narrower: without that bound,
    most curves at the speed of a motorway are none that anybody can drive.

    The original moves a bicycle model; one whose steering angle is delta is about this unicycle with kappa = tan(delta) /
    wheelbase. Drawing quasi-randomly and the bound on sideways acceleration are departures from it.

    Args:
        horizon: number K of future steps.
        count: number C of candidates.
        acceleration: A [m/s^2].
        curvature: kappa_max [1/m].

    Raises:
        ValueError: a count or range that is not positive.
    """

    points: Tensor

    def __init__(self, horizon: int, count: int, acceleration: float, curvature: float) -> None:
        super().__init__()
        for name, value in (("horizon", horizon), ("count", count)):
            if value < 1:
                raise ValueError(f"{name} must be 1 or more, not {value}")
        for name, limit in (("acceleration", acceleration), ("curvature", curvature)):
            if not 0 < limit < math.inf:
                raise ValueError(f"{name} must be positive and finite, not {limit}")
        self.horizon, self.acceleration, self.curvature = horizon, acceleration, curvature
        self.register_buffer("points", _mixture(count), persistent=False)

    def forward(self, current: Float[Tensor, "B N 4"], dt: float) -> Float[Tensor, "B C N K 2"]:
        """Controls of all candidates: acceleration [m/s^2] and turn rate [rad/s].

        Args:
            current: states at t0. Agents do not matter to each other.
            dt: length of a time step [s].
        """
        speed = current[:, None, :, None, SPEED]
        accelerates, bends, bends_finally = self.points.to(current)[:, None, None].unbind(-1)
        step = torch.arange(self.horizon + 1, dtype=current.dtype, device=current.device)
        # Who drives backwards already may go on, but no faster.
        speeds = torch.maximum(speed + self.acceleration * accelerates * dt * step, speed.clamp_max(0.0))
        before = speeds[..., :-1]
        fastest = speeds.abs().amax(-1, keepdim=True)
        least = torch.finfo(current.dtype).tiny
        limit = (self.acceleration / fastest.square().clamp_min(least)).clamp_max(self.curvature)
        way = before.abs().cumsum(-1) - before.abs()  # covered before every step, in units of dt
        share = way / way[..., -1:].clamp_min(least)
        bend = limit * torch.lerp(bends.expand_as(share), bends_finally.expand_as(share), share)
        return torch.stack((speeds.diff(dim=-1) / dt, before * bend), -1)


def _mixture(count: int) -> Float[Tensor, "C 3"]:
    """Acceleration, first and last curvature of every candidate in units of their largest values."""
    others = count - 1
    lines, circles = round(STRAIGHT * others), round(ARCS * others)
    numbers = [[_radical_inverse(_FIRST + number, base) for base in _BASES] for number in range(others)]
    points = 2.0 * torch.tensor(numbers, dtype=torch.float64).view(others, len(_BASES)) - 1.0
    line = points[:lines].clone()
    line[:, 1:] = 0.0
    circle = points[:circles].clone()
    circle[:, 2] = circle[:, 1]
    return torch.cat((points.new_zeros(1, 3), line, circle, points[: others - lines - circles]))


def _radical_inverse(number: int, base: int) -> float:
    """The digits of a number mirrored at the point: 6 = 110 in base 2 becomes 0.011 = 3/8."""
    inverse, place = 0.0, 1.0 / base
    while number:
        number, digit = divmod(number, base)
        inverse += digit * place
        place /= base
    return inverse
