"""Interactions of vehicles: distances along and across their common direction, headway, and conflicts ahead of time.

The *common axis* of two agents is the mean of their directions; for opposite directions, the mean of one and of the reverse
of the other. The offset p_i - p_j has the part a along and the part b across this axis. L and W are half the sum of lengths
and of widths, m is the margin, and Delta is the angle between both headings:

    longitudinal   |cos Delta| q(b / W) max(0, L + m - |a|)                     one behind the other,
    lateral        |cos Delta| q(a / L) max(0, W + m - |b|)                     side by side,
    headway        max(0, cos Delta) q(b / W) max(0, L + m + T v_rear - |a|)    one following the other.

The window q(z) = max(0, 1 - z^2)^2 is one for agents in line and zero for agents past each other. All three are continuous
and vanish for perpendicular headings. v_rear is the speed of the agent behind; while the bodies overlap along the axis, it
changes linearly to the speed of the other agent.

A *conflict* is a future overlap of discs as wide as the agents, if both keep their velocities. With the time t of the
closest approach, 0 <= t <= H, and the distance D at that time,

    time_to_conflict   (1 - t / H) max(0, W + m - D).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.circles import length_of
from epo_lightning.scene import HEADING, SPEED, heading_vector, velocities

TIME_GAP = 1.0
"""T, the time [s] that the rear agent keeps to the front one, in addition to the margin."""
CONFLICT_TIME = 3.0
"""H, the time [s] up to which a conflict counts."""
SLOW = 0.01
"""[m^2/s^2], added to the squared relative speed: agents with equal velocities are closest now."""
LEAST_SIZE = 1e-3
"""Smallest length [m] in a denominator, for absent agents, whose size is zero."""


def half_sizes(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents"]:
    """Half of length and width together [m], beyond which an agent affects no other one besides its margin."""
    return size.sum(-1) / 2


def longitudinal(first: Tensor, second: Tensor, first_size: Tensor, second_size: Tensor, margin: Tensor) -> Tensor:
    """Missing distance [m] of agents one behind the other, [.., K] for states [.., K, 4]."""
    along, across, cosine = _common_axis(first, second)
    length, width = _half_sums(first_size, second_size)
    return cosine.abs() * _window(across, width) * torch.relu(length + margin - along.abs())


def lateral(first: Tensor, second: Tensor, first_size: Tensor, second_size: Tensor, margin: Tensor) -> Tensor:
    """Missing distance [m] of agents side by side, [.., K] for states [.., K, 4]."""
    along, across, cosine = _common_axis(first, second)
    length, width = _half_sums(first_size, second_size)
    return cosine.abs() * _window(along, length) * torch.relu(width + margin - across.abs())


def headway(first: Tensor, second: Tensor, first_size: Tensor, second_size: Tensor, margin: Tensor) -> Tensor:
    """Missing distance [m] of an agent to the one ahead of it, [.., K] for states [.., K, 4]."""
    along, across, cosine = _common_axis(first, second)
    length, width = _half_sums(first_size, second_size)
    behind = _within(0.5 - 0.5 * along / length.clamp_min(LEAST_SIZE), 1.0)  # 1 where the first agent is the rear one
    rear = behind * first[..., SPEED] + (1.0 - behind) * second[..., SPEED]
    return torch.relu(cosine) * _window(across, width) * torch.relu(length + margin + TIME_GAP * rear - along.abs())


def time_to_conflict(first: Tensor, second: Tensor, first_size: Tensor, second_size: Tensor, margin: Tensor) -> Tensor:
    """Overlap [m] at the closest approach, less the later it is, [.., K] for states [.., K, 4]."""
    offset = first[..., :2] - second[..., :2]
    velocity = velocities(first) - velocities(second)
    time = _within(-(offset * velocity).sum(-1) / (velocity.square().sum(-1) + SLOW), CONFLICT_TIME)
    distance = length_of(offset + time[..., None] * velocity)
    _, width = _half_sums(first_size, second_size)
    return (1.0 - time / CONFLICT_TIME) * torch.relu(width + margin - distance)


def _within(value: Tensor, limit: float) -> Tensor:
    """The nearest number from 0 to a limit. There its derivative is zero, as in the kernels, and that of ``clamp`` one."""
    return torch.where((value > 0.0) & (value < limit), value, value.detach().clamp(0.0, limit))


def _half_sums(first: Float[Tensor, "*batch 2"], second: Float[Tensor, "*batch 2"]) -> tuple[Tensor, Tensor]:
    length, width = (0.5 * (first + second)).unbind(-1)
    return length, width


def _window(value: Tensor, half_width: Tensor) -> Tensor:
    """q(value / half_width)."""
    return torch.relu(1.0 - (value / half_width.clamp_min(LEAST_SIZE)).square()).square()


def _common_axis(first: Float[Tensor, "*batch 4"], second: Float[Tensor, "*batch 4"]) -> tuple[Tensor, Tensor, Tensor]:
    """The offset of the first from the second agent along and across the common axis, and the cosine of the angle."""
    one, other = heading_vector(first[..., HEADING]), heading_vector(second[..., HEADING])
    cosine = (one * other).sum(-1)
    sign = torch.where(cosine < 0, -1.0, 1.0).to(cosine.dtype)
    axis = (one + sign[..., None] * other) / (2.0 + 2.0 * cosine.abs()).sqrt()[..., None]
    offset = first[..., :2] - second[..., :2]
    across = axis[..., 0] * offset[..., 1] - axis[..., 1] * offset[..., 0]
    return (axis * offset).sum(-1), across, cosine
