"""Derivatives of features while a program is exported (``torch.export``), by automatic differentiation.

The sizes of a batch are symbols then. PyTorch's forward mode and ``vmap`` cannot handle symbols, so all derivatives are
backward passes. The exporter does not see the tensors that autograd saves for these passes. Derivatives are therefore traced
on their own, below autograd, and the program gets the operations of this trace.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.fx.experimental.proxy_tensor import disable_proxy_modes_tracing, make_fx

Function = Callable[..., Tensor]


def change(
    function: Function, at: tuple[Tensor, ...], directions: tuple[Float[Tensor, " D *_"], ...], *others: Tensor
) -> Float[Tensor, "D *batch R"]:
    """Change J v of a function along D directions v of its arguments.

    J v is the derivative of the linear function w -> J^T w by w: two backward passes, with a copy of the arguments for every
    direction.

    Args:
        function: function of the arguments and of ``others``, which are constant.
        at: values of the arguments.
        directions: D directions of every argument, stacked in a new first dimension.
        others: further arguments, held constant.
    """

    def along(*given: Tensor) -> Tensor:
        with torch.enable_grad():
            moved = given[len(at) : 2 * len(at)]
            copies = [value.expand_as(by).detach().requires_grad_() for value, by in zip(given, moved, strict=False)]
            value = function(*copies, *given[2 * len(at) :])
            w = torch.zeros_like(value).requires_grad_()
            pulled = torch.autograd.grad(value, copies, w, create_graph=True, allow_unused=True)
            read = [number for number, part in enumerate(pulled) if part is not None]
            return torch.autograd.grad([pulled[number] for number in read], w, [moved[number] for number in read])[0]

    return _traced(along, *at, *directions, *others)[0]


def slopes(function: Function, value: Float[Tensor, "*shape"], *others: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivative of an elementwise function by its first argument; ``others`` are constant."""

    def twice(value: Tensor, *others: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            value = value.detach().requires_grad_()
            (first,) = torch.autograd.grad(function(value, *others).sum(), value, create_graph=True)
            if not first.requires_grad:
                return first, torch.zeros_like(first)
            return first, torch.autograd.grad(first.sum(), value, materialize_grads=True)[0]

    first, second = _traced(twice, value, *others)
    return first, second


def _traced(function: Callable[..., Tensor | tuple[Tensor, ...]], *given: Tensor) -> tuple[Tensor, ...]:
    """Results of a function that differentiates, by operations that do not."""
    # Without DisableTorchFunction, the program would record the changes of the gradient mode, and could not be loaded.
    with disable_proxy_modes_tracing(), torch._C.DisableTorchFunction():
        operations = make_fx(function)(*given)
    found = operations(*given)
    return (found,) if isinstance(found, Tensor) else tuple(found)
