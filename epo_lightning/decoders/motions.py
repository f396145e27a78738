"""Candidate strategies from a model of motion instead of a network (DSDNet, Zeng et al., ECCV 2020).

A mixture of 30% straight lines, 20% circular arcs and 50% clothoids that continue the present motion. DSDNet draws them at
random; here they come from a quasi-random sequence, so that forecasts repeat and few candidates cover the ranges evenly.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.scene import SPEED, Scene

STRAIGHT, ARCS = 0.3, 0.2
"""Shares of straight lines and of circular arcs; the rest are clothoids."""
_BASES = (2, 3, 5)
"""Bases of Halton's sequence: coprime, so that no two coordinates agree and no clothoid is a circle."""
_FIRST = 2
"""Index of the first Halton number in use. Number 1 is 1/2 in base 2, an acceleration of zero; a straight line with zero
acceleration would repeat the first candidate."""


class Motions(nn.Module):
    """C candidate strategies of every agent for the unicycle; nothing is learned.

    The first candidate keeps speed and heading. The others have a constant acceleration a in [-A, A] (braking ends at a
    standstill) and follow a straight line, an arc of constant curvature kappa, or a clothoid, whose curvature changes
    linearly with the distance covered. The turn rate is v kappa, so a standing agent does not turn. Curvatures are
    uniform in [-kappa_max, kappa_max], or in the narrower range that keeps the lateral acceleration |kappa| v^2 <= A:
    without that bound, most curves could not be driven at motorway speed.

    Differences from the original: DSDNet uses a bicycle model, which with steering angle delta is about this unicycle with
    kappa = tan(delta) / wheelbase; and it has neither the quasi-random sequence nor the bound on lateral acceleration.

    Args:
        count: number C of candidates.
        horizon: number K of future steps.
        acceleration: A [m/s^2].
        curvature: kappa_max [1/m].

    Raises:
        ValueError: a count or range that is not positive.
    """

    points: Tensor

    def __init__(self, count: int, horizon: int, acceleration: float, curvature: float) -> None:
        super().__init__()
        for name, value in (("count", count), ("horizon", horizon)):
            if value < 1:
                raise ValueError(f"{name} must be 1 or more, not {value}")
        for name, limit in (("acceleration", acceleration), ("curvature", curvature)):
            if not 0 < limit < math.inf:
                raise ValueError(f"{name} must be positive and finite, not {limit}")
        self.horizon, self.acceleration, self.curvature = horizon, acceleration, curvature
        self.register_buffer("points", _mixture(count), persistent=False)

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B C N K 2"]:
        """Controls of all candidates: acceleration [m/s^2] and turn rate [rad/s]; ``z`` is not read."""
        return self.controls(scene.current_or_zero, scene.dt)

    def controls(self, current: Float[Tensor, "B N 4"], dt: float) -> Float[Tensor, "B C N K 2"]:
        """Controls of all candidates, for each agent independently of the others.

        Args:
            current: states at t0.
            dt: length of a time step [s].
        """
        speed = current[:, None, :, None, SPEED]
        acceleration, curvature, last_curvature = self.points.to(current)[:, None, None].unbind(-1)
        step = torch.arange(self.horizon + 1, dtype=current.dtype, device=current.device)
        # Braking ends at a standstill; an agent that drives backwards already keeps at most its speed.
        speeds = torch.maximum(speed + self.acceleration * acceleration * dt * step, speed.clamp_max(0.0))
        before = speeds[..., :-1]
        fastest = speeds.abs().amax(-1, keepdim=True)
        least = torch.finfo(current.dtype).tiny
        limit = (self.acceleration / fastest.square().clamp_min(least)).clamp_max(self.curvature)
        covered = before.abs().cumsum(-1) - before.abs()  # distance before every step, in units of dt
        share = covered / covered[..., -1:].clamp_min(least)
        kappa = limit * torch.lerp(curvature.expand_as(share), last_curvature.expand_as(share), share)
        return torch.stack((speeds.diff(dim=-1) / dt, before * kappa), -1)


def _mixture(count: int) -> Float[Tensor, "C 3"]:
    """Acceleration, first and last curvature of every candidate, relative to their largest values."""
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
