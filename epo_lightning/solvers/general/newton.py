"""Newton's method with the exact Hessian, for any energy that has a gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.checks import check_number, check_whole
from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.host import readable
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.general import descent
from epo_lightning.solvers.general.dense import factorise, gradient, hessian

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-7, 1e7
_TRIES = 6
"""Trial steps per Hessian; computing the Hessian costs more than all of them."""
_SHORTEST = 0.03
"""Shortest relative step of the line search; below it the damping is raised instead."""


@register("solver", "newton")
@dataclass(frozen=True)
class Newton(Minimiser):
    """Newton steps -(H + lambda I)^-1 grad E with damping lambda and a line search.

    If the matrix is not positive definite, lambda is multiplied by 10. A step that does not lower the energy is shortened by
    the secant rule, which needs no further factorisation. If a step would become shorter than 3 % of the full step, lambda
    is multiplied by 10 instead. An accepted full step divides lambda by 10. Every sample has its own lambda, which begins
    at 1e-3 and stays within [1e-7, 1e7]. Convergence is quadratic near a minimum; with piecewise linear residuals
    (:class:`~epo_lightning.solvers.general.dense.PiecewiseQuadratic`) a few steps suffice.

    Solutions are constants to automatic differentiation; use ``backward=implicit`` to learn through them.

    Attributes:
        steps: largest number of Hessians.
        tolerance: a sample has converged where the largest entry of its gradient, or of a step with little damping, is no
            larger than this; or where rounding errors prevent further improvement.
    """

    needs_from_energy = frozenset({GRADIENT})
    provides = frozenset({STATIONARY})

    steps: int = 50
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        check_whole("solver.steps", self.steps, least=0)
        check_number("solver.tolerance", self.tolerance, zero=True)

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        scene, controls = descent.begin(energy, scene, parameters)
        if controls.numel() == 0:
            return descent.nothing(controls)
        value, slope = gradient(energy, scene, parameters, controls)
        finite = descent.both_finite(value, slope)
        done = ~finite | (descent.largest(slope) <= self.tolerance)
        damping = torch.full_like(value, _FIRST_DAMPING)
        now = _Iterate(controls, value, slope, damping, descent.first_status(finite), done)
        for _ in range(self.steps):
            if descent.ended(now.done):
                break
            going = ~now.done.all(1)
            if not readable(going) or going.all():
                now = self._advanced(energy, scene, parameters, now)
            else:  # scenes that have converged are left out
                now = now.with_(going, self._advanced(energy, scene[going], parameters[going], now.of(going)))
        return descent.solution(energy, scene, now.controls, (value, now.value), now.slope, now.status)

    def _advanced(self, energy: Energy, scene: Scene, parameters: GameParameters, now: _Iterate) -> _Iterate:
        """The iterates after one more Hessian."""
        controls, value, slope = now.controls, now.value, now.slope
        damping, status, done = now.damping, now.status, now.done
        matrix = hessian(energy, scene, parameters, controls)
        known = matrix.flatten(2).sum(-1).isfinite()
        status = torch.where(done | known, status, int(Status.STOPPED))
        done = done | ~known
        open_, stale, length = ~done, ~done, torch.ones_like(value)
        move, definite = torch.zeros_like(controls), torch.zeros_like(done)
        for _ in range(_TRIES):
            if descent.ended(~open_):
                break
            if not descent.ended(~stale):
                move, definite = _steps(matrix, damping, slope, stale, move, definite)
            there = torch.where(descent.wide(open_), controls + descent.wide(length) * move, controls)
            trial = gradient(energy, scene, parameters, there)
            better = (trial[0] < value) | descent.level(value, slope, *trial)
            better = open_ & definite & descent.both_finite(*trial) & better
            promised = -(slope * move).flatten(2).sum(-1)
            whole = length == 1.0
            near = whole & (damping <= _FIRST_DAMPING) & (descent.largest(move) <= self.tolerance)
            exhausted = definite & (length * promised <= descent.rounding(value))
            stuck = open_ & ~better & (exhausted | (damping >= _MOST_DAMPING))
            status = torch.where(open_ & ~definite & (status == Status.COMPLETED), int(Status.DAMPED), status)
            # The secant rule: the point where the directional derivative vanishes if it is linear along the step.
            share = promised / (promised + (trial[1] * move).flatten(2).sum(-1))
            shorter = length * share.nan_to_num(0.0).clamp(0.1, 0.5)
            controls = torch.where(descent.wide(better), there, controls)
            value, slope = torch.where(better, trial[0], value), torch.where(descent.wide(better), trial[1], slope)
            done = done | stuck | (better & (near | (descent.largest(slope) <= self.tolerance)))
            stale = open_ & ~better & (~definite | (shorter < _SHORTEST))
            length = torch.where(stale, 1.0, shorter)
            less, more = (damping / 10).clamp_min(_LEAST_DAMPING), (damping * 10).clamp_max(_MOST_DAMPING)
            damping = torch.where(stale, more, torch.where(better & whole, less, damping))
            open_ = open_ & ~better & ~stuck
            stale = stale & open_
        return _Iterate(controls, value, slope, damping, status, done)


@dataclass(frozen=True)
class _Iterate:
    """The iterates of all samples: controls, energy, gradient, damping, status, and a mask of those that have ended."""

    controls: Float[Tensor, "B M N K 2"]
    value: Float[Tensor, "B M"]
    slope: Float[Tensor, "B M N K 2"]
    damping: Float[Tensor, "B M"]
    status: Int[Tensor, "B M"]
    done: Bool[Tensor, "B M"]

    def of(self, scenes: Bool[Tensor, " B"]) -> _Iterate:
        """The iterates of some scenes."""
        return _Iterate(**{name: tensor[scenes] for name, tensor in vars(self).items()})

    def with_(self, scenes: Bool[Tensor, " B"], others: _Iterate) -> _Iterate:
        """These iterates, with others for some scenes."""
        new = vars(others)
        return _Iterate(**{name: tensor.index_put((scenes,), new[name]) for name, tensor in vars(self).items()})


def _steps(
    matrix: Float[Tensor, "B M n n"],
    damping: Float[Tensor, "B M"],
    slope: Float[Tensor, "B M N K 2"],
    which: Bool[Tensor, "B M"],
    move: Float[Tensor, "B M N K 2"],
    definite: Bool[Tensor, "B M"],
) -> tuple[Float[Tensor, "B M N K 2"], Bool[Tensor, "B M"]]:
    """The damped steps, and a mask of the positive definite matrices, recomputed for ``which`` samples."""
    # On other devices all samples are recomputed, because selecting some would make the host wait for their number.
    some = which if readable(which) else torch.ones_like(which)
    chosen = matrix[some]
    chosen.diagonal(dim1=-2, dim2=-1).add_(damping[some][..., None])
    factor, has_factor = factorise(chosen)
    step = -torch.cholesky_solve(slope[some].flatten(1)[..., None], factor).view_as(slope[some])
    new, found = move.masked_scatter(descent.wide(some), step), definite.masked_scatter(some, has_factor)
    return torch.where(descent.wide(which), new, move), torch.where(which, found, definite)
