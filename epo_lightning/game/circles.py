"""What space agents take up, and how deep two of them overlap: as one disc each, or as a row of circles along the axis.

A disc as wide as a car is long keeps cars a car length apart on all sides, so that neighbours in adjacent lanes overlap. A
row of circles is about as long and as wide as the vehicle. By the rule of the INTERACTION data set's challenges, with length
l and width w,

    l < 4 m          two, at +-(l - w) / 2 from the centre,
    4 m <= l < 8 m   three: one more in the centre,
    8 m <= l         five: two more, at +-(l - w) / 4,

all of radius w / sqrt(2): each is drawn around a square of side w, and reaches 0.21 w beyond its sides. Together they cover
the vehicle's box, corners and all, as long as these squares leave no gap: up to l = 2 w, 3 w and 5 w with two, three and
five circles. Longer vehicles have notches in their flanks: 0.37 m deep in a car of 3.9 m x 1.7 m, 0.72 m in a truck of 16 m
x 2.5 m; and a bicycle of 1.8 m x 0.6 m has nothing between its two circles.

Where other circles become the deepest in each other, the depth is continuous and has a kink.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.scene import HEADING

THREE_FROM, FIVE_FROM = 4.0, 8.0
"""Lengths [m] from which vehicles have three and five circles."""
_SLOTS = 5


def length_of(vector: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Euclidean length, with a gradient of zero instead of an undefined one where it is zero."""
    squared = vector.square().sum(-1)
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, 1.0).sqrt(), 0.0)


def separation(
    first: Float[Tensor, "*batch K 2"], second: Float[Tensor, "*batch K 2"]
) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K 2"]]:
    """How far two agents are apart, and the unit vector from the second to the first.

    Agents at one and the same point have no direction between them: the vector is then zero, and so is every gradient,
    instead of undefined.
    """
    offset = first - second
    distance = length_of(offset)
    apart = (distance > 0)[..., None]
    return distance, torch.where(apart, offset / torch.where(apart, distance[..., None], 1.0), 0.0)


def overlap(distance: Float[Tensor, "*shape"], reach: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """How deep two discs overlap; touching is not overlapping."""
    return torch.relu(reach - distance)


def disc(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents"]:
    """The radius [m] of an agent's one disc: half its length."""
    return size[..., 0] / 2


def row_extent(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents"]:
    """How far an agent's outermost circles reach from its position [m]: farther than its ends."""
    length, width = size.unbind(-1)
    return (length - width).abs() / 2 + width / math.sqrt(2)


def places(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents 5"]:
    """Where along its axis an agent's circles are [m], the central ones first.

    An agent with fewer than five has some twice, which changes no maximum.
    """
    length, width = size.unbind(-1)
    end = (length - width) / 2
    middle = torch.where(length < THREE_FROM, end, 0.0)
    between = torch.where(length < FIVE_FROM, end, end / 2)
    return torch.stack((middle, between, -between, end, -end), -1)


def row_overlap(
    first: Float[Tensor, "*batch K 4"],
    second: Float[Tensor, "*batch K 4"],
    first_size: Float[Tensor, "*#batch 1 2"],
    second_size: Float[Tensor, "*#batch 1 2"],
) -> Float[Tensor, "*batch K"]:
    """How deep two rows of circles overlap, max(0, max_ab r_a + r_b - |c_a - c_b|) [m], at every step.

    Differentiable with respect to the states; which circles are deepest in each other is a constant, the first ones on a
    tie. Where their centres coincide, the gradient is zero.
    """
    apart = first[..., :2] - second[..., :2]
    places_of = [places(size).expand(*apart.shape[:-1], _SLOTS) for size in (first_size, second_size)]
    axes = [torch.stack((states[..., HEADING].cos(), states[..., HEADING].sin()), -1) for states in (first, second)]
    with torch.no_grad():
        ahead, back = (
            place[..., None, :] * axis.detach()[..., None] for place, axis in zip(places_of, axes, strict=True)
        )  # [.. K 2 5]
        offset = apart.detach()[..., None, None] + ahead[..., :, None] - back[..., None, :]  # [.. K 2 5 5]
        nearest = offset.square().sum(-3).flatten(-2).min(-1, keepdim=True).indices  # the first ones on a tie
    chosen = nearest.div(_SLOTS, rounding_mode="floor"), nearest.remainder(_SLOTS)
    first_ahead, second_ahead = (
        place.gather(-1, index) * axis for place, index, axis in zip(places_of, chosen, axes, strict=True)
    )
    distance = length_of(apart + first_ahead - second_ahead)
    return overlap(distance, (first_size[..., 1] + second_size[..., 1]) / math.sqrt(2))
