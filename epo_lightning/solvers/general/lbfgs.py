"""Limited-memory BFGS, for any energy that has a gradient: it needs no Hessian, but more steps than Newton's method.

``torch.optim.LBFGS`` has one history and one line search for all samples, so that a forecast would depend on the other
scenes of its batch. Here every sample has its own history and line search.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.checks import check_number, check_whole
from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.general import descent
from epo_lightning.solvers.general.dense import gradient

_DECREASE = 1e-4
"""Armijo constant: required decrease relative to the linear prediction."""
_CURVATURE = 1e-10
"""Smallest cosine between a step and the change of the gradient for which the pair enters the history."""
_SHORTEST = 1e-12
"""Shortest relative step before the line search gives up."""


@register("solver", "lbfgs")
@dataclass(frozen=True)
class LBFGS(Minimiser):
    """Quasi-Newton steps with the two-loop recursion (Nocedal and Wright, Algorithm 7.4) and backtracking.

    This is TGL's minimiser (with history 65, at most 1000 iterations, tolerance 1e-3). A step is one evaluation of energy
    and gradient: a sample either accepts the trial point and gets a new direction, or shortens its step by quadratic
    interpolation. If a line search fails, the history is deleted; if it fails again, the minimisation of the sample ends.

    Solutions are constants to automatic differentiation; use ``backward=implicit`` to learn through them.

    Attributes:
        steps: largest number of evaluations of energy and gradient.
        tolerance: a sample has converged where the largest entry of its gradient, or of a full step, is no larger than this;
            or where rounding errors prevent further improvement.
        history: number of steps in the history.
    """

    needs_from_energy = frozenset({GRADIENT})
    provides = frozenset({STATIONARY})

    steps: int = 200
    tolerance: float = 1e-6
    history: int = 20

    def __post_init__(self) -> None:
        check_whole("solver.steps", self.steps, least=0)
        check_number("solver.tolerance", self.tolerance, zero=True)
        check_whole("solver.history", self.history)

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        scene, controls = descent.begin(energy, scene, parameters)
        if controls.numel() == 0:
            return descent.nothing(controls)
        value, slope = gradient(energy, scene, parameters, controls)
        initial, finite = value, descent.both_finite(value, slope)
        status = descent.first_status(finite)
        done = ~finite | (descent.largest(slope) <= self.tolerance)
        shape = *controls.shape[:2], self.history, slope[0, 0].numel()
        moves, changes = slope.new_zeros(shape), slope.new_zeros(shape)
        direction, length = _downhill(slope), torch.ones_like(value)
        for _ in range(self.steps):
            if descent.ended(done):
                break
            there = torch.where(descent.wide(done), controls, controls + descent.wide(length) * direction)
            trial = gradient(energy, scene, parameters, there)
            promised = length * _dot(slope.flatten(2), direction.flatten(2))
            better = (trial[0] <= value + _DECREASE * promised) | descent.level(value, slope, *trial)
            better = ~done & descent.both_finite(*trial) & better

            move, change = (there - controls).flatten(2), (trial[1] - slope).flatten(2)
            curved = better & (_dot(move, change) > _CURVATURE * move.norm(dim=-1) * change.norm(dim=-1))
            moves, changes = _remember(curved, moves, move), _remember(curved, changes, change)
            near = (length == 1.0) & (descent.largest(there - controls) <= self.tolerance)
            controls = torch.where(descent.wide(better), there, controls)
            # Minimum of the parabola through both energies with the directional derivative at the first.
            shorter = -0.5 * length * promised / (trial[0] - value - promised)
            shorter = shorter.nan_to_num(0.0).clamp(0.1 * length, 0.5 * length)
            value, slope = torch.where(better, trial[0], value), torch.where(descent.wide(better), trial[1], slope)
            done = done | (better & (near | (descent.largest(slope) <= self.tolerance)))

            failed = ~done & ~better & (length < _SHORTEST)
            remembers = (moves != 0).flatten(2).any(-1)
            done = done | (failed & ~remembers)
            onward = -_times(moves, changes, slope)
            forget = failed | (better & (_dot(slope.flatten(2), onward.flatten(2)) >= 0))
            moves, changes = (torch.where(forget[..., None, None], 0.0, kept) for kept in (moves, changes))
            fresh = descent.wide(forget | ~(changes != 0).flatten(2).any(-1))
            onward = torch.where(fresh, _downhill(slope), onward)
            turned = better | failed
            direction = torch.where(descent.wide(turned), onward, direction)
            length = torch.where(turned, 1.0, shorter)
        return descent.solution(energy, scene, controls, (initial, value), slope, status)


def _dot(one: Tensor, other: Tensor) -> Tensor:
    return (one * other).sum(-1)


def _downhill(slope: Float[Tensor, "B M N K 2"]) -> Float[Tensor, "B M N K 2"]:
    """The direction of steepest descent, of length one at most."""
    return -slope / descent.wide(slope.flatten(2).norm(dim=-1).clamp_min(1.0))


def _remember(
    whose: Tensor, memory: Float[Tensor, "B M L n"], newest: Float[Tensor, "B M n"]
) -> Float[Tensor, "B M L n"]:
    """The memory with its oldest entry replaced by the newest one, for some samples."""
    return torch.where(whose[..., None, None], torch.cat((memory[:, :, 1:], newest[:, :, None]), 2), memory)


def _times(
    moves: Float[Tensor, "B M L n"], changes: Float[Tensor, "B M L n"], slope: Float[Tensor, "B M N K 2"]
) -> Float[Tensor, "B M N K 2"]:
    """The approximate inverse Hessian of the history times the gradient; entries of zero have no effect."""
    curvature = _dot(moves, changes)
    inverse = torch.where(curvature > 0, 1.0 / torch.where(curvature > 0, curvature, 1.0), 0.0)
    result, shares = slope.flatten(2), []
    for entry in reversed(range(moves.shape[2])):
        share = inverse[:, :, entry] * _dot(moves[:, :, entry], result)
        result = result - share[..., None] * changes[:, :, entry]
        shares.append(share)
    newest = changes[:, :, -1].square().sum(-1)
    scale = torch.where(newest > 0, curvature[:, :, -1] / torch.where(newest > 0, newest, 1.0), 1.0)
    result = scale[..., None] * result
    for entry, share in enumerate(reversed(shares)):
        back = inverse[:, :, entry] * _dot(changes[:, :, entry], result)
        result = result + (share - back)[..., None] * moves[:, :, entry]
    return result.view_as(slope)
