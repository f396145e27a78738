"""Reference implementation: a dense Jacobian by automatic differentiation, a general linear solver, autograd through both.

It is written for clearness, and the other implementations are checked against it.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from benchmarks.games import Game
from benchmarks.residuals import problem
from epo_lightning.forecast import GameParameters


def prepare(game: Game) -> Callable[[GameParameters], Tensor]:
    """A function from parameters to controls [B, M, N, K, 2]."""
    plain = problem(game)

    def residuals(unknowns: Tensor, tensors: dict[str, Tensor]) -> Tensor:
        return plain.residuals(
            unknowns[None], {name: value[None] for name, value in tensors.items()}, plain.groups, True
        )[0]

    def solve(parameters: GameParameters) -> Tensor:
        tensors = plain.tensors(parameters)
        unknowns = plain.unknowns(parameters.initial_controls)
        for _ in range(game.steps):
            jacobian = vmap(jacfwd(residuals))(unknowns, tensors)
            residual = plain.residuals(unknowns, tensors, plain.groups, False)
            matrix = jacobian.mT @ jacobian
            matrix = matrix + game.damping * torch.eye(matrix.shape[-1]).to(matrix)
            gradient = jacobian.mT @ residual[..., None]
            unknowns = unknowns - game.step_size * torch.linalg.solve(matrix, gradient)[..., 0]
        return plain.controls(unknowns)

    return solve
