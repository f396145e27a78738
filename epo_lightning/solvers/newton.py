"""Newton's method with the exact Hessian, for any energy that has a gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution, Status
from epo_lightning.solvers import descent
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.dense import factorise, gradient, hessian

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-7, 1e7
_TRIES = 6
"""Dampings that are tried with one Hessian, which costs more than all of them."""


@register("solver", "newton")
@dataclass(frozen=True)
class Newton(Minimiser):
    """Steps -(H + lambda I)^-1 grad E with a damping lambda that makes the matrix positive definite and the energy fall.

    A step that has no Cholesky factor or does not lower the energy is rejected and lambda multiplied by 10; an accepted one
    divides it by 10. Lambda is the sample's own, begins at 1e-3 and stays within [1e-7, 1e7]. Near a minimum the number of
    correct digits about doubles with every step.

    Solutions are constants to automatic differentiation; ``backward=implicit`` is what learns through them.

    Attributes:
        steps: how many Hessians are computed at most.
        tolerance: a sample has converged where the largest entry of its gradient, or of a step with little damping, is no
            larger than this; or where it cannot be improved in its precision.
    """

    needs = frozenset({GRADIENT})
    provides = frozenset({STATIONARY})

    steps: int = 50
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ConfigError(f"solver.steps must be 0 or more, not {self.steps}")
        if not 0 <= self.tolerance < float("inf"):
            raise ConfigError(f"solver.tolerance must be 0 or more, and finite, not {self.tolerance}")

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        scene, controls = descent.begin(energy, scene, parameters)
        if controls.numel() == 0:
            return descent.nothing(controls)
        value, slope = gradient(energy, scene, parameters, controls)
        initial, sound = value, descent.finite(value, slope)
        status = descent.first_status(sound)
        done = ~sound | (descent.largest(slope) <= self.tolerance)
        damping = torch.full_like(value, _FIRST_DAMPING)
        identity = torch.eye(slope[0, 0].numel(), dtype=slope.dtype, device=slope.device)
        for _ in range(self.steps):
            if descent.ended(done):
                break
            matrix = hessian(energy, scene, parameters, controls)
            known = matrix.isfinite().flatten(2).all(-1)
            status = torch.where(done | known, status, int(Status.STOPPED))
            done = done | ~known
            open_ = ~done
            for _ in range(_TRIES):
                if descent.ended(~open_):
                    break
                factor, definite = factorise(matrix + damping[..., None, None] * identity)
                move = -torch.cholesky_solve(slope.flatten(2)[..., None], factor).view_as(controls)
                there = torch.where(_wide(open_), controls + move, controls)
                trial = gradient(energy, scene, parameters, there)
                better = (trial[0] < value) | descent.level(value, slope, *trial)
                better = open_ & definite & descent.finite(*trial) & better
                near = (damping <= _FIRST_DAMPING) & (descent.largest(move) <= self.tolerance)
                stuck = open_ & ~better & (damping >= _MOST_DAMPING)
                status = torch.where(open_ & ~definite & (status == Status.SOLVED), int(Status.DAMPED), status)
                controls = torch.where(_wide(better), there, controls)
                value, slope = torch.where(better, trial[0], value), torch.where(_wide(better), trial[1], slope)
                less, more = (damping / 10).clamp_min(_LEAST_DAMPING), (damping * 10).clamp_max(_MOST_DAMPING)
                damping = torch.where(open_, torch.where(better, less, more), damping)
                done = done | stuck | (better & (near | (descent.largest(slope) <= self.tolerance)))
                open_ = open_ & ~better & ~stuck
        return descent.solution(energy, scene, controls, (initial, value), slope, status)


def _wide(samples: Tensor) -> Tensor:
    return samples[..., None, None, None]
