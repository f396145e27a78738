"""The named features of an energy: what an agent, or a pair of agents, would rather keep small.

An own feature is a *signal* of the trajectory (a control, its rate of change, the speed, the distance left to the goal),
taken either as it is or, for names that end in ``b``, as the amount by which it leaves its bounds (the paper's soft
constraints max(0, g(z))). How a signal depends on the controls is all that the Gauss-Newton assembly has to know.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.scene import ACCELERATION, SPEED, TURN_RATE


class Source(Enum):
    """What a signal is read from, which fixes the structure of its Jacobian."""

    CONTROL = "control"
    """A control at its own step: diagonal."""
    RATE = "rate"
    """The rate of change of a control: bidiagonal."""
    SPEED = "speed"
    """The speed: every acceleration before it counts the same."""
    FINAL_POSITION = "final_position"
    """The last position: all controls of the agent count."""


@dataclass(frozen=True)
class OwnFeature:
    """One entry of c(u_i, g_i) in Eq. 10: a signal, and whether only its violation of bounds counts.

    Attributes:
        source: where the signal comes from.
        channel: index of the control, for signals of controls.
        signal: name of the signal, by which its bounds are given.
        bounded: whether the feature is zero within the bounds.
    """

    source: Source
    signal: str
    channel: int = 0
    bounded: bool = False


def _with_bounds(features: Mapping[str, OwnFeature]) -> dict[str, OwnFeature]:
    bounded = {
        f"{name}b": OwnFeature(feature.source, feature.signal, feature.channel, bounded=True)
        for name, feature in features.items()
    }
    return {**features, **bounded}


OWN_FEATURES: dict[str, OwnFeature] = {
    "goal": OwnFeature(Source.FINAL_POSITION, "goal"),
    **_with_bounds(
        {
            "vel": OwnFeature(Source.SPEED, "vel"),
            "acc": OwnFeature(Source.CONTROL, "acc", ACCELERATION),
            "turnr": OwnFeature(Source.CONTROL, "turnr", TURN_RATE),
            "jerk": OwnFeature(Source.RATE, "jerk", ACCELERATION),
            "turnacc": OwnFeature(Source.RATE, "turnacc", TURN_RATE),
        }
    ),
}
"""Name to feature: goal [m]; vel [m/s]; acc [m/s^2]; turnr [rad/s]; jerk [m/s^3]; turnacc [rad/s^2]; ``...b`` for bounds."""

PAIR_FEATURES = ("proximity",)
"""``proximity``: max(0, r_i + r_j - |p_i - p_j|) [m], how deep two discs overlap."""


def signal(
    feature: OwnFeature,
    states: Float[Tensor, "*batch K 4"],
    controls: Float[Tensor, "*batch K 2"],
    goals: Float[Tensor, "... 2"] | None,
    dt: float,
) -> Float[Tensor, "*batch R"]:
    """The signal of a feature over time: R = K, K - 1 for rates, 2 (x and y) for the goal."""
    match feature.source:
        case Source.CONTROL:
            return controls[..., feature.channel]
        case Source.RATE:
            return controls[..., feature.channel].diff(dim=-1) / dt
        case Source.SPEED:
            return states[..., SPEED]
        case Source.FINAL_POSITION:
            assert goals is not None
            return states[..., -1, :2] - goals


def violation(
    value: Float[Tensor, "*shape"], lower: float, upper: float
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """How far a signal leaves [lower, upper], and the derivative of that: 1 above, -1 below, 0 within."""
    excess = (value - upper).clamp_min(0.0) + (lower - value).clamp_min(0.0)
    slope = (value > upper).to(value.dtype) - (value < lower).to(value.dtype)
    return excess, slope


def proximity(
    first: Float[Tensor, "*batch K 2"], second: Float[Tensor, "*batch K 2"], reach: Float[Tensor, "*#batch 1"]
) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 2"], Bool[Tensor, "*batch K"]]:
    """How far two agents come closer than ``reach`` [m], the unit vector from the second to the first, and where.

    Agents at one and the same point have no direction between them: the feature is then at its largest and flat, so its
    gradient is zero instead of undefined.
    """
    offset = first - second
    squared = offset.square().sum(-1)
    apart = squared > 0
    distance = torch.where(apart, squared, 1.0).sqrt()
    normal = torch.where(apart[..., None], offset / distance[..., None], 0.0)
    depth = reach - torch.where(apart, distance, 0.0)
    return depth.clamp_min(0.0), normal, depth > 0
