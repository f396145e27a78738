"""Derivatives of any energy as dense arrays, by automatic differentiation, for energies of unknown structure.

Samples are independent of each other, so one Hessian-vector product is computed for all samples at once: the Hessians of n
controls take n products, whatever the size of the batch. Rows and columns have the order of ``controls.flatten(2)``. Absent
agents have a 1 on the diagonal and zeros elsewhere, so that they affect neither factorisations nor solutions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.energy import RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.game_end import free_controls
from epo_lightning.host import readable
from epo_lightning.scene import Scene
from epo_lightning.solvers.general import descent

_PRODUCTS = 64
"""Number of matrix-vector products that are computed together, which bounds the memory."""


@runtime_checkable
class PiecewiseQuadratic(Protocol):
    """An energy with piecewise linear residuals, whose Hessian is available in closed form."""

    def hessian(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> Float[Tensor, "B M n n"]:
        """The Hessian d2E/du2, equal to J^T J of the residuals, n = 2 N K; zero for absent agents."""


def gradient(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B M N K 2"]]:
    """The energy E and its gradient dE/du, differentiable if gradients are recorded; zero for absent agents."""
    taped = torch.is_grad_enabled()
    with torch.enable_grad():
        if not controls.requires_grad:
            controls = controls.detach().requires_grad_()
        value = energy(scene, parameters, controls)
        (slope,) = torch.autograd.grad(value.sum(), controls, create_graph=taped)
    return (value, slope) if taped else (value.detach(), slope)


def hessian(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> Float[Tensor, "B M n n"]:
    """The Hessian d2E/du2, n = 2 N K; differentiable if gradients are recorded.

    It is computed by n reverse passes through the gradient, or by the energy itself if it is :class:`PiecewiseQuadratic`.
    """
    if isinstance(energy, PiecewiseQuadratic):
        return _closed_form(energy, scene, parameters, controls)
    return slope_change(lambda at: gradient(energy, scene, parameters, at)[1], scene, controls)


def slope_change(
    slope: Callable[[Tensor], Tensor], scene: Scene, controls: Float[Tensor, "B M N K 2"]
) -> Float[Tensor, "B M n n"]:
    """The derivative by the controls of a gradient dE/du, which is a function of them; differentiable as :func:`hessian`."""
    taped = torch.is_grad_enabled()
    with torch.enable_grad():
        if not controls.requires_grad:
            controls = controls.detach().requires_grad_()
        found, parts = slope(controls), units(controls).split(_PRODUCTS)
        if found.requires_grad:
            rows = [
                torch.autograd.grad(
                    found,
                    controls,
                    part,
                    retain_graph=True,
                    create_graph=taped,
                    is_grads_batched=True,
                    materialize_grads=True,
                )[0]
                for part in parts
            ]
        else:  # the energy is linear
            rows = [torch.zeros_like(part) for part in parts]
        return _of_free(scene, controls.shape[3], torch.cat(rows).flatten(3).movedim(0, 2))


def gauss_newton(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> Float[Tensor, "B M n n"]:
    """The Gauss-Newton matrix J^T J, the Hessian without second derivatives of residuals, n = 2 N K.

    Differentiable with respect to controls and parameters if gradients are recorded.

    Raises:
        ValueError: the energy is not a sum of squares.
    """
    if RESIDUALS not in energy.offers:
        raise ValueError(
            f"{type(energy).__name__} has no residuals, which a Gauss-Newton matrix needs; choose backward.hessian=exact"
        )
    if isinstance(energy, PiecewiseQuadratic):
        return _closed_form(energy, scene, parameters, controls)
    energy.validate(scene, parameters, controls)
    if isinstance(energy, FeatureEnergy):
        _, changes = energy.linearisation(scene, parameters, controls, units(controls))
    else:

        def residuals(at: Tensor) -> Tensor:
            named = energy.residuals(scene, parameters, at)  # type: ignore[attr-defined]
            return torch.cat([residual.flatten(2) for residual in named.values()], -1)

        along = torch.func.vmap(lambda unit: torch.func.jvp(residuals, (controls,), (unit,))[1], chunk_size=_PRODUCTS)
        changes = along(units(controls))
    jacobian = changes.movedim(0, -1)
    return _of_free(scene, controls.shape[3], jacobian.mT @ jacobian)


def attach(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"], exact: bool
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """The controls of a solution with their implicit derivative, and a status.

    At a minimum u(p), g(u(p), p) = dE/du = 0 for all p in a neighbourhood, so du/dp = -H^-1 dg/dp. With u and H held
    constant,

        u - H^-1 (g(u, p) - g(u, p) held constant)

    has the value u and this derivative by all inputs of g: the parameters, the scene, and the weights of energies that are
    networks. :func:`epo_lightning.solvers.gauss_newton.implicit.attach` is the faster version for feature energies.

    Args:
        energy, scene, parameters: the game.
        controls: the solution of the game.
        exact: whether H is the Hessian or its Gauss-Newton approximation.

    Returns:
        controls, and a :class:`~epo_lightning.forecast.Status`: STOPPED where H is not positive definite, so that the
        controls are no minimum; such a sample has a gradient of zero.
    """
    controls = controls.detach()
    if scene.history.dtype != controls.dtype:
        scene = scene.to(controls.dtype)
    with torch.no_grad():
        matrix = (hessian if exact else gauss_newton)(energy, scene, parameters, controls)
        factor, definite = factorise(matrix)
    scene, parameters = with_zeros(scene, parameters, definite)
    with torch.enable_grad():
        value, slope = gradient(energy, scene, parameters, torch.where(descent.wide(definite), controls, 0.0))
        flat = slope.detach().flatten(2)
        step = torch.cholesky_solve(flat[..., None], factor)[..., 0]
        descent.warn_if_far(value, 0.5 * (flat * step).sum(-1), definite)
        move = torch.cholesky_solve((slope - slope.detach()).flatten(2)[..., None], factor).view_as(controls)
        attached = controls - torch.where(descent.wide(definite), move, 0.0)
        return attached, torch.where(definite, Status.COMPLETED, Status.STOPPED).long()


def factorise(matrix: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n n"], Bool[Tensor, "*batch"]]:
    """Lower Cholesky factors (the identity where there is none), and a mask of the positive definite matrices."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    # A NaN in the lower triangle reaches the diagonal of its row; the upper triangle is never read.
    definite = (failed == 0) & factor.diagonal(dim1=-2, dim2=-1).isfinite().all(-1)
    if readable(definite) and definite.all():
        return factor, definite
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.where(definite[..., None, None], factor, identity), definite


def units(controls: Tensor) -> Float[Tensor, "n B M N K 2"]:
    """All n unit vectors of controls, the same for every sample."""
    count = controls.shape[2:].numel()
    identity = torch.eye(count, dtype=controls.dtype, device=controls.device)
    return identity.view(count, 1, 1, *controls.shape[2:]).expand(count, *controls.shape)


def _closed_form(
    energy: PiecewiseQuadratic, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> Float[Tensor, "B M n n"]:
    """The energy's Hessian in closed form, with ones on the diagonal for absent agents."""
    matrix = energy.hessian(scene, parameters, controls)
    absent = ~scene.agent_mask.repeat_interleave(2 * controls.shape[3], 1)
    matrix.diagonal(dim1=-2, dim2=-1).add_(absent[:, None])
    return matrix


def _of_free(scene: Scene, steps: int, matrix: Float[Tensor, "B M n n"]) -> Float[Tensor, "B M n n"]:
    """The matrix with rows and columns of the identity for controls on which nothing depends."""
    free = free_controls(scene, steps).repeat_interleave(2, -1).flatten(1)[:, None]
    both = free[..., :, None] & free[..., None, :]
    return torch.where(both, matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device))


def with_zeros(scene: Scene, parameters: GameParameters, kept: Bool[Tensor, "B M"]) -> tuple[Scene, GameParameters]:
    """The kept games, and zeros in place of the others, so that NaN in them reaches no gradient."""

    def zeroed(tensor: Tensor) -> Tensor:
        return torch.where(descent.wide(kept, tensor.dim() - 2), tensor, torch.zeros_like(tensor))

    context, some = parameters.context, kept.any(1)
    parameters = dataclasses.replace(parameters, context=None).map(zeroed)
    if context is not None:
        context = torch.where(some[:, None, None], context, 0.0)
    scene = dataclasses.replace(scene, agent_mask=scene.agent_mask & some[:, None])
    return scene, dataclasses.replace(parameters, context=context)
