"""Steps with adaptive damping, for backends that take one step per call.

A step that lowers the energy of its problem (one scene and mode) is accepted and the damping divided by 10; any other one is
rejected and the damping multiplied by 10. The compiled layer does the same inside of one call.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.host import readable
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.backends.pytorch import LEAST_DAMPING, MOST_DAMPING
from epo_lightning.solvers.general.descent import wide

_SMALL = 1e-4
"""Largest damping at which a step without a change of the energy shows a minimum."""
_ROUNDING = 500.0
"""Changes of the energy that count as its rounding error, in units of the machine precision."""

Step = Callable[[Tensor | slice, Tensor, Tensor], Solution]
"""(scenes of the batch, their controls, damping [B, M] or [B, M, N]) -> solution after one step."""


def descend_by_calls(
    solve: Callable[..., Solution],
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    exact: bool = False,
    keep_iterates: bool = False,
) -> tuple[Solution, Float[Tensor, "B M *agents"]]:
    """At most S steps of a game by calls of ``solve``, a backend's function, each for one step of the scenes that are left.

    Returns:
        the solution and the damping to continue with.
    """

    def step(rows: Tensor | slice, controls: Tensor, damping: Tensor) -> Solution:
        game = dataclasses.replace(parameters[rows], initial_controls=controls)
        return solve(energy.of_scenes(rows), scene[rows], game, 1, step_size, damping, exact=exact)

    here = solve(energy, scene, parameters, 0, step_size, damping)
    return descend(step, here, steps, damping, keep_iterates)


def descend(
    step: Step,
    found: Solution,
    steps: int,
    damping: Float[Tensor, "B M *agents"],
    keep_iterates: bool = False,
) -> tuple[Solution, Float[Tensor, "B M *agents"]]:
    """At most S steps; returns the solution and the damping to continue with.

    Without a gradient, scenes whose problems have all arrived at a minimum take no further steps. With one, all steps are
    taken: those at the minimum belong to the derivative of the solution. Decisions have no gradient.

    Args:
        step: function that takes one step of some of the scenes.
        found: the solution after no step.
        steps: largest number of steps S.
        damping: damping at the start. Agents with infinite damping keep their controls.
        keep_iterates: whether the solution carries u_0 .. u_S.
    """
    going = found.energy.isfinite()  # others take no step: no energy is smaller than NaN
    found = dataclasses.replace(found, status=torch.where(going, found.status, Status.STOPPED))
    stops = not torch.is_grad_enabled() and readable(found.energy)
    left: Tensor | slice = slice(None)
    iterates = [found.controls]
    for _ in range(steps):
        if stops:
            left = going.any(1).nonzero()[:, 0]
            if not len(left):
                break
        before, now = found[left], damping[left]
        trial = step(left, before.controls, now)
        better = trial.energy < before.energy
        after = _accepted(better, trial, before)
        found = dataclasses.replace(
            found,
            controls=_put(found.controls, left, after.controls),
            states=_put(found.states, left, after.states),
            energy=_put(found.energy, left, after.energy),
            gradient_norm=_put(found.gradient_norm, left, after.gradient_norm),
            status=_put(found.status, left, after.status),
        )
        going = _put(going, left, going[left] & ~_arrived(before, trial, now))
        damping = _put(damping, left, _adapted(now, better))
        iterates.append(found.controls)
    if keep_iterates:
        found = dataclasses.replace(found, iterates=(*iterates, *iterates[-1:] * (steps + 1 - len(iterates))))
    return found, damping


def _put(whole: Tensor, left: Tensor | slice, part: Tensor) -> Tensor:
    """The values of all scenes with those of some replaced."""
    return part if isinstance(left, slice) else whole.index_copy(0, left, part)


def _accepted(better: Bool[Tensor, "B M"], trial: Solution, before: Solution) -> Solution:
    """The trial solution where it is better, and the solution before it elsewhere."""
    keep = wide(better)
    # If the matrix of a step cannot be factorised, the step counts as rejected.
    status = before.status.maximum(torch.where(better, trial.status, Status.COMPLETED))
    return dataclasses.replace(
        before,
        controls=torch.where(keep, trial.controls, before.controls),
        states=torch.where(keep, trial.states, before.states),
        energy=torch.where(better, trial.energy, before.energy),
        gradient_norm=torch.where(better, trial.gradient_norm, before.gradient_norm),
        status=status,
    )


def _adapted(damping: Float[Tensor, "B M *agents"], better: Bool[Tensor, "B M"]) -> Float[Tensor, "B M *agents"]:
    """The damping after accepted or rejected steps; infinite damping stays."""
    if damping.dim() > better.dim():
        better = better[..., None]
    less, more = (damping / 10.0).clamp_min(LEAST_DAMPING), (damping * 10.0).clamp_max(MOST_DAMPING)
    return torch.where(damping.isinf(), damping, torch.where(better, less, more))


def _arrived(before: Solution, trial: Solution, damping: Float[Tensor, "B M *agents"]) -> Bool[Tensor, "B M"]:
    """Mask of the problems that a step has shown to be at a minimum, or that no step can lower."""
    most = damping.where(damping.isfinite(), 0.0)
    most = most.amax(-1) if most.dim() > before.energy.dim() else most
    rounding = _ROUNDING * torch.finfo(before.energy.dtype).eps * before.energy
    same = (trial.energy - before.energy).abs() <= rounding
    return (same & (most <= _SMALL)) | ((trial.energy >= before.energy) & (most >= MOST_DAMPING))
