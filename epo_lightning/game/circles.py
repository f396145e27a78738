"""The shape of agents and the overlap of two of them: as one disc each, or as rows of circles along the axis.

A disc with the length of a car as diameter keeps cars a car length apart on all sides, so that neighbours in adjacent lanes
overlap. A row of circles is about as long and as wide as the vehicle. By the rule of the INTERACTION data set's challenges,
with length l and width w,

    l < 4 m          two, at +-(l - w) / 2 from the centre,
    4 m <= l < 8 m   three: one more in the centre,
    8 m <= l         five: two more, at +-(l - w) / 4,

all of radius w / sqrt(2): each is the circumcircle of a square of side w, and reaches 0.21 w beyond its sides. Together
they cover the vehicle's box including its corners, as long as these squares leave no gap: up to l = 2 w, 3 w and 5 w with
two, three and five circles. Longer vehicles are not covered completely: notches in the sides are 0.37 m deep for a car of
3.9 m x 1.7 m and 0.72 m for a truck of 16 m x 2.5 m; a bicycle of 1.8 m x 0.6 m has a gap between its two circles.

The overlap is continuous; it has a kink where another pair of circles becomes the deepest.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.scene import HEADING, heading_vector

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
    """The distance of two agents, and the unit vector from the second to the first.

    Where both are at the same point, the vector is zero, and so is every gradient.
    """
    offset = first - second
    distance = length_of(offset)
    apart = (distance > 0)[..., None]
    return distance, torch.where(apart, offset / torch.where(apart, distance[..., None], 1.0), 0.0)


def overlap(distance: Float[Tensor, "*shape"], reach: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """The overlap of two discs, max(0, reach - distance); touching is no overlap."""
    return torch.relu(reach - distance)


def disc(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents"]:
    """The radius [m] of an agent's one disc: half its length."""
    return size[..., 0] / 2


def row_extent(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents"]:
    """The distance [m] from an agent's position to the far side of its outermost circles, which is beyond its ends."""
    length, width = size.unbind(-1)
    return (length - width).abs() / 2 + width / math.sqrt(2)


def places(size: Float[Tensor, "*agents 2"]) -> Float[Tensor, "*agents 5"]:
    """The centres of an agent's circles along its axis [m], the central ones first.

    For agents with fewer than five circles some circles are repeated; the largest overlap stays the same.
    """
    length, width = size.unbind(-1)
    end = (length - width) / 2
    middle = torch.where(length < THREE_FROM, end, 0.0)
    between = torch.where(length < FIVE_FROM, end, end / 2)
    return torch.stack((middle, between, -between, end, -end), -1)


def rows_may_overlap(
    first: Float[Tensor, "*batch 4"],
    second: Float[Tensor, "*batch 4"],
    first_size: Float[Tensor, "*batch 2"],
    second_size: Float[Tensor, "*batch 2"],
) -> Bool[Tensor, "*batch"]:
    """Whether two rows of circles may overlap: False where the axis of one of them passes beside all circles of the other.

    A fast test that holds for all rows that do overlap, and for few others; rounding errors do not matter.
    """
    x, y = (first[..., :2] - second[..., :2]).unbind(-1)
    (cos, sin), (other_cos, other_sin) = ((s[..., HEADING].cos(), s[..., HEADING].sin()) for s in (first, second))
    turned = (cos * other_sin - sin * other_cos).abs()
    half, other_half = ((size[..., 0] - size[..., 1]).abs() / 2 for size in (first_size, second_size))
    reach = 1.0001 * (first_size[..., 1] + second_size[..., 1]) / math.sqrt(2)
    beside = (cos * y - sin * x).abs() > reach + other_half * turned
    other_beside = (other_cos * y - other_sin * x).abs() > reach + half * turned
    return ~(beside | other_beside)


def row_overlap(
    first: Float[Tensor, "*batch K 4"],
    second: Float[Tensor, "*batch K 4"],
    first_size: Float[Tensor, "*#batch 1 2"],
    second_size: Float[Tensor, "*#batch 1 2"],
) -> Float[Tensor, "*batch K"]:
    """The overlap of two rows of circles, max(0, max_ab r_a + r_b - |c_a - c_b|) [m], at every step.

    Differentiable with respect to the states; the choice of the deepest pair of circles is held constant (the first one on
    a tie). Where their centres coincide, the gradient is zero.
    """
    apart = first[..., :2] - second[..., :2]
    places_of = [places(size).expand(*apart.shape[:-1], _SLOTS) for size in (first_size, second_size)]
    axes = [heading_vector(states[..., HEADING]) for states in (first, second)]
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
