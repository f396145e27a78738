"""Implicit differentiation of a minimum: the derivative of the solution by the game's parameters.

At a minimum u(p), grad E(u(p), p) = 0 for all p in a neighbourhood, so du/dp = -H^-1 d(grad E)/dp with the Hessian H of E.
For a cotangent v of the solution, mu solves H mu = v, and the gradient by p is that of -<mu, grad E(u, p)> with u and mu
held constant. It does not depend on the path of the minimisation, so initial controls have no gradient.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.host import readable
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.backends import choice
from epo_lightning.solvers.gauss_newton.backends.pytorch import Game, factorise, planar
from epo_lightning.solvers.gauss_newton.expansion import expand
from epo_lightning.solvers.general import descent


def attach(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    controls: Tensor,
    exact: bool,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """The controls of a solution with their implicit derivative, and a status.

    Args:
        energy, scene, parameters: the game.
        controls: the solution of the game.
        exact: whether H is the Hessian or its Gauss-Newton approximation.
        backend: the solver's backend, which computes the derivative as well.

    Returns:
        controls, and a :class:`~epo_lightning.forecast.Status`: STOPPED where H is not positive definite, so that the
        controls are no minimum; such a problem has a gradient of zero.
    """
    chosen = choice.choose(backend, energy, scene, dataclasses.replace(parameters, initial_controls=controls))
    kernel = choice.with_kernel(chosen)
    if kernel is not None:
        return kernel.attach(energy, scene, parameters, controls, exact)
    none = controls.new_zeros(controls.shape[:2]).flatten()
    game = Game(energy, scene, parameters, 1.0, none, readable(controls))
    found, status = _Attach.apply(game, exact, controls, *game.tensors())
    return found, status


class _Attach(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, game: Game, exact: bool, controls: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        model = expand(game.energy, game.scene, game.with_tensors(tensors), controls, not game.split, exact)
        ctx.factors = factorise(model, game.damping, game.split, retry=False)
        slope = model.gradient
        left = ctx.factors.solve(slope).flatten(1)
        decrement = 0.5 * (slope.flatten(1) * left).sum(-1)
        descent.warn_if_far(model.value, decrement, ctx.factors.status != Status.STOPPED)
        ctx.game = game
        # The scene is saved so that autograd raises an error if it was changed in place before the backward pass.
        ctx.save_for_backward(*tensors, *game.scene.tensors())
        status = ctx.factors.status.view(controls.shape[:2])
        ctx.mark_non_differentiable(status)
        return controls.view_as(controls), status

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        factors, tensors = ctx.factors, ctx.saved_tensors[: len(ctx.game.tensors())]
        definite = factors.status != Status.STOPPED
        adjoint = torch.where(definite[:, None, None, None], factors.solve(planar(cotangent)), 0.0)
        _, by = ctx.game.gradient_of_phi(factors.model, tensors, adjoint, torch.zeros_like(adjoint))
        by = [torch.where(definite.view(*g.shape[:2], *[1] * (g.dim() - 2)), g, 0.0) for g in by]
        return None, None, None, *by
