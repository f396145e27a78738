"""Iterated LQ games, and the derivative of their solutions, in the compiled kernel.

The same as :mod:`.iteration` and :mod:`.derivative`, for the features that the kernel knows. Several games are solved at a
time, one in each lane of a vector register.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import Status
from epo_lightning.solvers.feedback.anderson import DEPENDENT
from epo_lightning.solvers.feedback.iteration import LARGEST_MOVE, REMEMBERED, SHORTEST, TRIALS, FeedbackGame
from epo_lightning.solvers.gauss_newton.backends import compiled
from epo_lightning.solvers.gauss_newton.backends.game_arrays import GameArrays
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.kernel.interface import EpoFeedback


def obstacle(game: FeedbackGame) -> str | None:
    """Reason why the kernel cannot iterate a game; None where it can."""
    return compiled.unsupported(game.energy, game.scene, game.parameters)


@torch.no_grad()
def iterate(
    game: FeedbackGame, controls: Float[Tensor, "B M N K 2"], iterations: int, tolerance: float
) -> tuple[Float[Tensor, "B M N K 2"], Int[Tensor, "B M"]]:
    """The controls and the status of :func:`.iteration.iterate`.

    Raises:
        ValueError: controls that are not of double precision on the CPU, or parameters of another shape.
        MemoryError: there is not enough memory.
    """
    _check(controls)
    arrays = GameArrays(game.energy, game.scene, game.parameters, controls)
    found = controls.clone(memory_format=torch.contiguous_format)
    status = torch.empty(controls.shape[:2], dtype=torch.int64)
    run = _arguments(game, found, status, iterations=iterations, tolerance=tolerance)
    interface.check(interface.library().epo_feedback(arrays.game, run, torch.get_num_threads()))
    return found, status


def attach(
    game: FeedbackGame, controls: Float[Tensor, "B M N K 2"], solved: Bool[Tensor, "B M"], terms: int
) -> Float[Tensor, "B M N K 2"]:
    """The controls of a solution with the derivative of :func:`.derivative.attach`.

    Raises:
        ValueError: as :func:`iterate`. The backward pass raises MemoryError if there is not enough memory.
    """
    _check(controls)
    arrays = GameArrays(game.energy, game.scene, game.parameters, controls)
    return _Attach.apply(game, arrays, solved, terms, controls, *arrays.inputs)


class _Attach(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, game: FeedbackGame, arrays: GameArrays, solved: Tensor, terms: int, controls: Tensor, *inputs: Tensor
    ) -> Tensor:
        ctx.game, ctx.arrays, ctx.terms = game, arrays, terms
        # The kernel reads these tensors in the backward pass. Because they are saved, autograd raises an error if one of
        # them was changed in place.
        ctx.save_for_backward(solved, controls, *inputs, *arrays.kept)
        return controls.view_as(controls)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        solved, controls = ctx.saved_tensors[:2]
        cotangent, controls = cotangent.contiguous(), controls.contiguous()
        status = torch.where(solved, int(Status.COMPLETED), int(Status.STOPPED)).contiguous()
        gradients, found = ctx.arrays.new_gradients()
        gradients.controls = cotangent.data_ptr()
        run = _arguments(ctx.game, controls, status, terms=ctx.terms)
        arguments = (ctx.arrays.game, run, gradients, torch.get_num_threads())
        interface.check(interface.library().epo_feedback_pull_back(*arguments))
        return None, None, None, None, None, *found


def _check(controls: Tensor) -> None:
    if controls.dtype != torch.double or controls.device.type != "cpu":
        raise ValueError(
            f"the kernel iterates controls of double precision on the CPU, not {controls.dtype} on {controls.device}"
        )


def _arguments(game: FeedbackGame, controls: Tensor, status: Tensor, **settings: float) -> EpoFeedback:
    """The arguments of a call, with the addresses of tensors that have to live as long as it."""
    return EpoFeedback(
        rho=game.rho,
        remembered=REMEMBERED,
        trials=TRIALS,
        largest_move=LARGEST_MOVE,
        shortest=SHORTEST,
        dependent=DEPENDENT,
        controls=controls.data_ptr(),
        status=status.data_ptr(),
        **settings,
    )
