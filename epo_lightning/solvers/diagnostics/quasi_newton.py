"""BFGS for many small functions in parallel, each with its own steps and its own termination.

The inverse Hessians [W, n, n] are stored completely: for one agent's controls, n = 2 K, they are small, and BFGS takes fewer
evaluations than L-BFGS (Nocedal and Wright, Numerical Optimization, Section 6.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_EVALUATIONS = 300
"""Largest number of evaluations."""
_DECREASE = 1e-4
"""Armijo constant: required decrease relative to the linear prediction."""
_SHORTEST = 1e-12
"""Shortest relative step before the line search gives up."""
_CURVED = 1e-10
"""Smallest cosine of a step and the change of the gradient that is positive beyond rounding errors."""
_TOLERANCE = 1e-10
"""Predicted decrease, relative to the value, below which a function is at its minimum."""
_LATELY, _FALLING = 30, 1e-2
"""If a function makes more than this fraction of its total decrease in its last 30 evaluations, it is not near a minimum."""
_UPDATES = 3
"""Least number of updates before a predicted decrease counts: before them the inverse Hessian is a multiple of I."""
_ENTRIES = 2**24
"""Largest number of entries of inverse Hessians at a time, which bounds the memory (128 MB)."""

Evaluate = Callable[[Int[Tensor, " w"], Float[Tensor, "w n"]], tuple[Float[Tensor, " w"], Float[Tensor, "w n"]]]
"""(indices of some functions, a point for each) -> their values and gradients."""


@dataclass(frozen=True)
class Minimum:
    """The results of W minimisations.

    Attributes:
        before, after: values at the start and at ``point``.
        point: the point of the lowest value.
        slope: Euclidean norm of the gradient at the start.
        found: whether ``point`` is close to a minimum: the predicted decrease vanished, the line search failed, or the
            evaluations ended with little decrease left. Otherwise the function was still falling fast when the evaluations
            ended; it may have no minimum at all.
    """

    before: Float[Tensor, " W"]
    after: Float[Tensor, " W"]
    point: Float[Tensor, "W n"]
    slope: Float[Tensor, " W"]
    found: Bool[Tensor, " W"]


def minimise(evaluate: Evaluate, start: Float[Tensor, "W n"]) -> Minimum:
    """Minimise from ``start`` until the predicted decrease is below 1e-10 of the value, in at most 300 evaluations.

    Steps are shortened by quadratic interpolation or halved until they lower the value, so the result is never above the
    start. A function whose value at the start is not finite keeps its start, with ``found`` False. For a function that has
    used all evaluations, ``found`` is False if more than 1 % of its total decrease was made in the last 30 of them.
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
    # The first step has a length of one at most.
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
        curvature = (moved * change).sum(1)
        curved = curvature > _CURVED * moved.norm(dim=1) * change.norm(dim=1)
        fresh = (curved & (updates == 0)).nonzero()[:, 0]
        inverse[fresh] = unit * (curvature / change.square().sum(1))[fresh, None, None]
        _update_(inverse, moved, change, torch.where(curved, curvature, torch.inf))
        updates = updates + curved
        # Minimum of the parabola through value and directional derivative here and the value there.
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
    curvature: Float[Tensor, " w"],
) -> None:
    """BFGS update of inverse Hessians by steps s and changes y of the gradient, in place; none where s . y is infinite.

    H <- H + s a^T - (H y) s^T / s.y   with   a = (1 + y.H y / s.y) s / s.y - H y / s.y.
    """
    along = (inverse * change[:, None]).sum(2)
    curvature = curvature[:, None]
    factor = (1.0 + (change * along).sum(1, keepdim=True) / curvature) / curvature
    factor = torch.where(curvature.isfinite(), factor, 0.0)
    inverse.addcmul_(moved[:, :, None], (factor * moved - along / curvature)[:, None])
    inverse.addcmul_(along[:, :, None], (moved / curvature)[:, None], value=-1.0)
