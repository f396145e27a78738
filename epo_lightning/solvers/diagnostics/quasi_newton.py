"""BFGS for many small functions at once, each of which goes its own way and stops on its own.

The inverse Hessians are kept as they are, [W, n, n]: for one agent's controls, n = 2 K, that is little, and takes fewer
evaluations than a limited memory (Nocedal and Wright, Numerical Optimization, Section 6.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_EVALUATIONS = 300
_DECREASE = 1e-4
"""Armijo's constant: which share of the promised decrease a step has to keep."""
_SHORTEST = 1e-12
"""Share of a step: who has to go less far does not get any further."""
_CURVED = 1e-10
"""Cosine of step and change of slope from which on the curvature is positive beyond rounding."""
_TOLERANCE = 1e-10
"""Of the value: where less is promised, a function is at its minimum."""
_LATELY, _FALLING = 30, 1e-2
"""Who still loses more than this share of its whole decrease in its last 30 evaluations has not come near a minimum."""
_UPDATES = 3
"""At least, before a promise counts: the first ones know nothing of the curvature."""
_ENTRIES = 2**24
"""Of inverse Hessians at a time: a bound on memory (128 MB)."""

Evaluate = Callable[[Int[Tensor, " w"], Float[Tensor, "w n"]], tuple[Float[Tensor, " w"], Float[Tensor, "w n"]]]
"""Values and slopes of some of the functions: their numbers, and a point for each."""


@dataclass(frozen=True)
class Minimum:
    """What W functions were and have become, where, and how steep they were.

    Attributes:
        before, after: values at the start and at ``point``.
        point: the lowest that was found.
        slope: Euclidean norm of the gradient at the start.
        found: whether ``point`` is next to a minimum: a step promised nothing, or none helped any more, or the evaluations
            ran out when there was little left to gain. Otherwise the function was given up while it was still falling; it
            may have no minimum at all.
    """

    before: Float[Tensor, " W"]
    after: Float[Tensor, " W"]
    point: Float[Tensor, "W n"]
    slope: Float[Tensor, " W"]
    found: Bool[Tensor, " W"]


def minimise(evaluate: Evaluate, start: Float[Tensor, "W n"]) -> Minimum:
    """Descend from ``start`` until a step promises less than 1e-10 of the value, in at most 300 evaluations.

    Steps are halved, or shortened to where a parabola has its minimum, until they lower the value; what was found is never
    above the start. A function without a finite value stays where it is, and is not found. Those that run out of
    evaluations are, unless they lost more than 1 % of their whole decrease in the last 30.
    """
    many = max(1, _ENTRIES // max(1, start.shape[1] ** 2))
    numbers = torch.arange(len(start), device=start.device)
    parts = [_minimise(evaluate, start[some], some) for some in numbers.split(many)]
    if not parts:
        none = start.new_zeros(0)
        return Minimum(none, none, start, none, none.bool())
    return Minimum(*(torch.cat(tensors) for tensors in zip(*(vars(part).values() for part in parts), strict=True)))


def _minimise(evaluate: Evaluate, start: Tensor, numbers: Tensor) -> Minimum:
    before, steep = evaluate(numbers, start)
    after, point = before.clone(), start.clone()
    left = (before.isfinite() & steep.isfinite().all(1) & (steep != 0).any(1)).nonzero()[:, 0]
    x, f, g = start[left], before[left], steep[left]
    unit = torch.eye(start.shape[1], dtype=start.dtype, device=start.device)
    # The first step is one unit of the controls long at most.
    inverse = unit / g.norm(dim=1).clamp_min(1.0)[:, None, None]
    updates, stride = torch.zeros_like(left), torch.ones_like(f)
    lately = before.clone()
    for count in range(_EVALUATIONS):
        if not len(left):
            break
        if count == _EVALUATIONS - _LATELY:
            lately[left] = f
        direction = -(inverse * g[:, None]).sum(2)
        promised = (g * direction).sum(1)
        trial = x + stride[:, None] * direction
        value, slope = evaluate(numbers[left], trial)
        accepted = (value <= f + _DECREASE * stride * promised) & slope.isfinite().all(1)
        moved = torch.where(accepted[:, None], trial - x, 0.0)
        change = torch.where(accepted[:, None], slope - g, 0.0)
        bent = (moved * change).sum(1)
        curved = bent > _CURVED * moved.norm(dim=1) * change.norm(dim=1)
        fresh = (curved & (updates == 0)).nonzero()[:, 0]
        inverse[fresh] = unit * (bent / change.square().sum(1))[fresh, None, None]
        _update_(inverse, moved, change, torch.where(curved, bent, torch.inf))
        updates = updates + curved
        # Where the parabola through the value and slope here and the value there has its minimum.
        excess = value - f - stride * promised
        parabola = (-0.5 * promised * stride.square() / excess).nan_to_num(0.0)
        shorter = torch.minimum(torch.maximum(parabola, 0.1 * stride), 0.5 * stride)
        x, g = torch.where(accepted[:, None], trial, x), torch.where(accepted[:, None], slope, g)
        f = torch.where(accepted, value, f)
        arrived = (-0.5 * promised <= _TOLERANCE * f.abs()) & (updates >= _UPDATES)
        arrived |= (~accepted & (shorter < _SHORTEST)) | (g == 0).all(1)
        stride = torch.where(accepted, 1.0, shorter)
        after[left], point[left] = f, x
        if arrived.any():
            on = (~arrived).nonzero()[:, 0]
            left, x, f, g, inverse, updates, stride = (t[on] for t in (left, x, f, g, inverse, updates, stride))
    settled = after.isfinite() & steep.isfinite().all(1)
    settled[left] &= (lately - after <= _FALLING * (before - after))[left]
    return Minimum(before, after, point, steep.norm(dim=1), settled)


def _update_(
    inverse: Float[Tensor, "w n n"],
    moved: Float[Tensor, "w n"],
    change: Float[Tensor, "w n"],
    bent: Float[Tensor, " w"],
) -> None:
    """Inverse Hessians after steps s along which slopes changed by y, in place; unchanged where s . y is infinite.

    H <- H + s a^T - (H y) s^T / s.y   with   a = (1 + y.H y / s.y) s / s.y - H y / s.y.
    """
    along = (inverse * change[:, None]).sum(2)
    bent = bent[:, None]
    factor = torch.where(bent.isfinite(), (1.0 + (change * along).sum(1, keepdim=True) / bent) / bent, 0.0)
    inverse.addcmul_(moved[:, :, None], (factor * moved - along / bent)[:, None])
    inverse.addcmul_(along[:, :, None], (moved / bent)[:, None], value=-1.0)
