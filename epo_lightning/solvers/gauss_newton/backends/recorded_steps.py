"""The derivative of all steps of a call of a kernel, whether on a CPU or a GPU, as one function of autograd."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import Solution


@runtime_checkable
class RecordedCall(Protocol):
    """One call of a kernel, with its results once it has run.

    Attributes:
        inputs: tensors by which, as by the initial controls, the solution is differentiable.
        kept: further tensors that the kernel reads.
        record: whether the solution needs a derivative.
        keep_iterates: whether the solution carries all iterates.
        start: the initial controls.
        iterates: the iterates, or the last one alone.
        states: the final states; None once they were handed on.
        initial_energy, energy, gradient_norm, status: those of the solution.
    """

    inputs: tuple[Tensor, ...]
    kept: list[Tensor]
    record: bool
    keep_iterates: bool
    start: Tensor
    iterates: Tensor
    states: Tensor | None
    initial_energy: Tensor
    energy: Tensor
    gradient_norm: Tensor
    status: Tensor

    def run(self) -> None:
        """Take all steps; fills the results."""

    def differentiate(
        self, controls: Tensor, iterates: Tensor | None, states: Tensor | None
    ) -> Sequence[Tensor | None]:
        """Gradients by ``inputs``, for cotangents of the final controls, of all iterates and of the states.

        ``controls`` is overwritten: on return it holds the gradient by the initial controls.
        """


def take_steps(call: RecordedCall, initial_controls: Float[Tensor, "B M N K 2"]) -> Solution:
    """The solution of a call, with its derivative if that is wanted."""
    if call.record:
        controls, states, *iterates = _Steps.apply(call, initial_controls, *call.inputs)
    else:
        call.run()
        iterates = list(call.iterates.unbind(0))
        controls, states = iterates[-1], call.states
    return Solution(
        controls=controls,
        states=states,
        initial_energy=call.initial_energy,
        energy=call.energy,
        gradient_norm=call.gradient_norm,
        status=call.status,
        iterates=tuple(iterates) if call.keep_iterates else None,
    )


class _Steps(torch.autograd.Function):
    """Autograd function of all steps of a call; returns controls, states and, with ``keep_iterates``, every iterate."""

    @staticmethod
    def forward(ctx: Any, call: RecordedCall, controls: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        call.run()
        ctx.call = call
        # The kernel reads these tensors again in the backward pass. Because they are saved, autograd raises an error if
        # one of them was changed in place.
        ctx.save_for_backward(*inputs, *call.kept)
        ctx.set_materialize_grads(False)
        iterates = [iterate.clone() for iterate in call.iterates] if call.keep_iterates else []
        # The autograd node would hold its own output, a reference cycle, which only the garbage collector could free.
        states, call.states = call.states, None
        assert states is not None
        return call.iterates[-1].clone(), states, *iterates

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, controls: Tensor | None, states: Tensor | None, *iterates: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        call = ctx.call
        _ = ctx.saved_tensors
        bar = (
            torch.zeros_like(call.start) if controls is None else controls.clone(memory_format=torch.contiguous_format)
        )
        along = None
        if any(iterate is not None for iterate in iterates):
            along = torch.stack([torch.zeros_like(bar) if iterate is None else iterate for iterate in iterates])
        if states is not None:
            states = states.contiguous()
        gradients = call.differentiate(bar, along, states)
        return None, bar, *gradients
