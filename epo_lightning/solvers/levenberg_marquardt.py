"""The energy-based potential game layer (Section 4.3): S damped Gauss-Newton steps, differentiable by unrolling.

One step solves (J^T J + lambda I) d = -J^T r and moves u to u + alpha d, as the paper and Theseus define it. All scenes and
modes are solved at once and none of them can disturb another: where a factorisation fails, that sample alone is tried again
with more damping, and where that fails too it keeps its last good iterate.

Differentiation does not tape the factorisation. For a cotangent v of u + alpha d, one more solve with the same factor gives
mu = (J^T J + lambda I)^-1 alpha v, and every gradient is that of the scalar

    phi(u, p) = -<J mu, r + J d>     with mu and d held constant,

to which v itself is added for u.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.game.energy import Energy
from epo_lightning.game.normal_equations import normal_equations
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution, Status

_RETRIES = 4
"""How often the damping of a sample that cannot be factorised is raised tenfold."""
_LEAST_RAISED_DAMPING = 1e-3
"""Where raising starts from when the damping is smaller."""


@register("solver", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt:
    """S steps of damped Gauss-Newton from the initial strategies, unrolled (Section 4.3, "Differentiable Optimization").

    Example::

        solve = LevenbergMarquardt(steps=2, step_size=0.3, damping=10.0)
        solution = solve(energy, scene, parameters)
        solution.controls  # [B, M, N, K, 2], differentiable with respect to weights, goals and initial controls

    Attributes:
        steps: number S of steps.
        step_size: alpha, 0 < alpha <= 1.
        damping: lambda >= 0, added to the diagonal of J^T J.
        keep_iterates: whether the solution carries u_0 .. u_S.
    """

    steps: int = 2
    step_size: float = 0.3
    damping: float = 10.0
    keep_iterates: bool = False

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ConfigError(f"solver.steps must be 0 or more, not {self.steps}")
        if not 0 < self.step_size <= 1:
            raise ConfigError(f"solver.step_size must be in (0, 1], not {self.step_size}")
        if not self.damping >= 0:
            raise ConfigError(f"solver.damping must be 0 or more, not {self.damping}")

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Minimise the energy of every scene and mode, starting at ``parameters.initial_controls``.

        Raises:
            ValueError: scene and parameters do not fit together; the message names the tensor and its expected shape.
        """
        energy.validate(scene, parameters, parameters.initial_controls)
        present = scene.agent_mask[:, None, :, None, None]
        initial_controls = controls = torch.where(present, parameters.initial_controls, 0.0)
        tensors, rebuild = _flatten(parameters)
        status = torch.full(controls.shape[:2], Status.SOLVED, device=controls.device)
        iterates = [controls]
        for _ in range(self.steps):
            controls, outcome = _Step.apply(energy, scene, rebuild, self.step_size, self.damping, controls, *tensors)
            status = torch.maximum(status, outcome)
            iterates.append(controls)
        with torch.no_grad():
            initial_energy = energy(scene, parameters, initial_controls)
        final_energy, gradient_norm = _energy_and_gradient_norm(energy, scene, parameters, controls)
        return Solution(
            controls=controls,
            states=energy.dynamics.rollout(energy.initial(scene), controls, scene.dt),
            initial_energy=initial_energy,
            energy=final_energy,
            gradient_norm=gradient_norm,
            status=status,
            iterates=tuple(iterates) if self.keep_iterates else None,
        )


def _flatten(parameters: GameParameters) -> tuple[list[Tensor], Callable[[Sequence[Tensor]], GameParameters]]:
    """The tensors of a game that an iterate is differentiated by, and the way back to named parameters."""
    own, pair = list(parameters.own_weights), list(parameters.pair_weights)
    tensors = [*parameters.own_weights.values(), *parameters.pair_weights.values()]
    if parameters.goals is not None:
        tensors.append(parameters.goals)

    def rebuild(flat: Sequence[Tensor]) -> GameParameters:
        weights, goals = flat[: len(own) + len(pair)], flat[len(own) + len(pair) :]
        return GameParameters(
            own_weights=dict(zip(own, weights[: len(own)], strict=True)),
            pair_weights=dict(zip(pair, weights[len(own) :], strict=True)),
            initial_controls=parameters.initial_controls.detach(),
            goals=goals[0] if goals else None,
            reference=parameters.reference,
        )

    return tensors, rebuild


def _energy_and_gradient_norm(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Tensor
) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        parameters = parameters.map(Tensor.detach)
        controls = controls.detach().requires_grad_()
        value = energy(scene, parameters, controls)
        (gradient,) = torch.autograd.grad(value.sum(), controls)
    return value.detach(), gradient.flatten(2).norm(dim=-1)


def _factorise(matrix: Tensor, damping: float, absent: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors of matrix + damping I, which overwrites the matrix, and a :class:`Status` per sample.

    Unknowns of absent agents get a unit diagonal, so that they are regular even without damping. A sample that has no
    factor at any damping gets the identity.
    """
    matrix.diagonal(dim1=-2, dim2=-1).add_(damping).masked_fill_(absent, 1.0)
    factor, info = torch.linalg.cholesky_ex(matrix)
    failed = info != 0
    status = torch.where(failed, Status.STOPPED, Status.SOLVED)
    raised = max(damping, _LEAST_RAISED_DAMPING)
    for _ in range(_RETRIES):
        # Only failing samples are touched, so the others keep every bit.
        where = failed.nonzero(as_tuple=True)
        if len(where[0]) == 0:
            return factor, status
        raised *= 10.0
        again = matrix[where]
        again.diagonal(dim1=-2, dim2=-1).add_(raised)
        again_factor, again_info = torch.linalg.cholesky_ex(again)
        solved = tuple(index[again_info == 0] for index in where)
        factor[solved] = again_factor[again_info == 0]
        status[solved] = Status.DAMPED
        failed[solved] = False
    factor[failed] = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    return factor, status


def _solve(factor: Tensor, right: Tensor) -> Tensor:
    # Two triangular solves: `cholesky_solve` would copy the factors first.
    half = torch.linalg.solve_triangular(factor, right.flatten(2)[..., None], upper=False)
    return torch.linalg.solve_triangular(factor.mT, half, upper=True)[..., 0].view_as(right)


class _Step(torch.autograd.Function):
    """u -> u + alpha d with its adjoint; see the module's docstring."""

    @staticmethod
    def forward(
        ctx: Any,
        energy: Energy,
        scene: Scene,
        rebuild: Callable[[Sequence[Tensor]], GameParameters],
        step_size: float,
        damping: float,
        controls: Tensor,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor]:
        gradient, matrix = normal_equations(energy, scene, rebuild(tensors), controls)
        absent = ~scene.agent_mask[:, None, :, None, None].expand(controls.shape).flatten(2)
        factor, status = _factorise(matrix, damping, absent)
        step = -_solve(factor, gradient)
        moved = controls + step_size * step
        sound = (status != Status.STOPPED) & moved.flatten(2).isfinite().all(-1)
        keep = sound[..., None, None, None]
        step = torch.where(keep, step, 0.0)
        status = torch.where(sound, status, Status.STOPPED)
        ctx.problem = energy, scene, rebuild, step_size
        ctx.save_for_backward(controls, step, factor, sound, *tensors)
        ctx.mark_non_differentiable(status)
        return torch.where(keep, moved, controls), status

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        energy, scene, rebuild, step_size = ctx.problem
        controls, step, factor, sound, *tensors = ctx.saved_tensors
        adjoint = _solve(factor, step_size * cotangent)
        adjoint = torch.where(sound[..., None, None, None], adjoint, 0.0)
        with torch.enable_grad():
            controls = controls.detach().requires_grad_()
            tensors = [tensor.detach().requires_grad_() for tensor in tensors]
            directions = torch.stack((adjoint, step))
            residuals, (along_adjoint, along_step) = energy.linearisation(scene, rebuild(tensors), controls, directions)
            phi = -(along_adjoint * (residuals + along_step)).sum()
            by_controls, *by_tensors = torch.autograd.grad(phi, [controls, *tensors], materialize_grads=True)
        return None, None, None, None, None, cotangent + by_controls, *by_tensors
