"""The derivative of feedback equilibria, which are fixed points of :mod:`.iteration`.

Let D(u, p) be the deviation from the controls u that the LQ game around them suggests, for parameters p of the game. At a
solution D(u, p) = 0, so du/dp = -D_u^-1 D_p (implicit function theorem).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.solvers.feedback.anderson import least_squares
from epo_lightning.solvers.feedback.iteration import FeedbackGame


def attach(
    game: FeedbackGame, controls: Float[Tensor, "B M N K 2"], solved: Bool[Tensor, "B M"], terms: int
) -> Float[Tensor, "B M N K 2"]:
    """The controls of a solution, with the derivative of the fixed point by the parameters of the game.

    Args:
        game: the game.
        controls: its solution.
        solved: mask of the games that are solved; the derivative of the others is zero.
        terms: number of steps of GMRES, which solves the linear system with D_u.
    """
    return _Attach.apply(game, solved, terms, controls, *game.parameters.tensors())


class _Attach(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, game: FeedbackGame, solved: Tensor, terms: int, controls: Tensor, *tensors: Tensor) -> Tensor:
        ctx.game, ctx.terms = game, terms
        # The scene is saved so that autograd raises an error if it was changed in place before the backward pass.
        ctx.save_for_backward(solved, controls, *tensors, *game.scene.tensors())
        return controls.view_as(controls)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        solved, controls, *given = ctx.saved_tensors
        given = given[: len(ctx.game.parameters.tensors())]
        tensors = [tensor.detach().requires_grad_(tensor.is_floating_point()) for tensor in given]
        rest = iter(tensors)
        game = dataclasses.replace(ctx.game, parameters=ctx.game.parameters.map(lambda _: next(rest)))
        # A loss of the best mode has no derivative by the other ones.
        rows = (solved & (cotangent != 0).flatten(2).any(-1)).flatten().nonzero()[:, 0]
        at = controls.flatten(0, 1)[rows][:, None].requires_grad_()
        with torch.enable_grad():
            some = game.one_by_one(solved.shape[1])[rows]
            local = some.linearised(some.states(at), at)
        policy = local.equilibrium()

        def pull_back(covector: Tensor, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
            """D_u' or D_p' times a covector of the controls."""
            return local.pull_back(policy, covector[:, 0], inputs)

        wanted = torch.where(local.free[:, None, ..., None], cotangent.flatten(0, 1)[rows][:, None], 0.0)
        # Norms of very small or large cotangents would underflow or overflow.
        scale = wanted.abs().amax((1, 2, 3, 4), keepdim=True)
        scale = torch.where(scale > 0, scale, 1.0)
        adjoint = scale * _gmres(lambda covector: pull_back(covector, [at])[0], wanted / scale, ctx.terms)
        found = iter(pull_back(adjoint, [tensor for tensor in tensors if tensor.requires_grad]))
        return None, None, None, None, *(next(found) if tensor.requires_grad else None for tensor in tensors)


def _gmres(by_controls: Callable[[Tensor], Tensor], cotangent: Tensor, steps: int) -> Float[Tensor, "games 1 N K 2"]:
    """The solution y of -D_u' y = v for a cotangent v, where ``by_controls`` multiplies by D_u'.

    Of all sums of v, D_u' v, D_u' D_u' v, ..., y is the one with the least residual (Saad and Schultz, "GMRES", SIAM Journal
    on Scientific and Statistical Computing 7(3), 1986).
    """
    basis: list[Tensor] = []
    images: list[Tensor] = []
    new = cotangent.flatten(1)
    for _ in range(steps):
        for other in basis:
            new = new - (new * other).sum(-1, keepdim=True) * other
        basis.append(new / new.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(new.dtype).tiny))
        new = -by_controls(basis[-1].view_as(cotangent)).flatten(1)
        images.append(new)
    shares = least_squares(torch.stack(images, -1), cotangent.flatten(1))
    return (torch.stack(basis, -1) @ shares[..., None]).view_as(cotangent)
