"""Trial calls of features, which tell what is wrong with a function before a solver calls it far from its file.

The trial agents are of all sizes, 10 cm to 100 m apart, slow and fast, in all directions.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.registry import place

SHAPE = (4, 64)
"""Leading dimensions of trial arguments."""
_FEW = 3
"""Trial agents of the second leading dimension that are enough to find a flaw."""
_STEPS, _DT, _LARGEST = 40, 0.1, 10.0
_APART = 1e-6
"""Distance between the arguments of a difference quotient."""
_WRONG = 0.05
"""Share of the trial values whose derivative may differ from their difference quotient, because a kink or a step lies
between the two arguments."""


@cache
@torch.inference_mode(False)
def agents() -> tuple[tuple[Float[Tensor, "*batch K 4"], Float[Tensor, "*batch 1 2"]], ...]:
    """States and sizes of the first and of the second trial agents, the same at every call."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> Tensor:
        return torch.rand(*SHAPE, *shape, generator=generator, dtype=torch.float64, device="cpu")

    apart = 10.0 ** (3.0 * drawn(1, 1) - 1.0)
    time = _DT * torch.arange(1, _STEPS + 1, dtype=torch.float64, device="cpu")[:, None]
    both = []
    for _ in range(2):
        heading = 7.0 * drawn(1, 1) - 3.5 + (drawn(1, 1) - 0.5) * time
        speed = 30.0 * drawn(1, 1).square() + (drawn(1, 1) - 0.5) * time
        way = _DT * (speed * torch.cat((heading.cos(), heading.sin()), -1)).cumsum(-2)
        states = torch.cat((apart * (drawn(1, 2) - 0.5) + way, heading, speed), -1)
        both.append((states, torch.tensor([10.0, 2.5], dtype=torch.float64, device="cpu") * (0.1 + 0.9 * drawn(1, 2))))
    return tuple(both)


@cache
@torch.inference_mode(False)
def numbers(*shape: int) -> Float[Tensor, "4 64 K *shape"]:
    """Values of signals or controls from -10 to 10, the same at every call."""
    generator = torch.Generator().manual_seed(1)
    drawn = torch.rand(*SHAPE, _STEPS, *shape, generator=generator, dtype=torch.float64, device="cpu")
    return _LARGEST * (2.0 * drawn - 1.0)


@torch.inference_mode(False)
def flaw(
    function: Callable[..., Tensor],
    moving: Sequence[Tensor],
    others: Sequence[Tensor],
    takes: str,
    stepwise: bool = False,
) -> str | None:
    """Reason why a function is of no use as a feature, as the end of a sentence about it; None where nothing is wrong.

    Warns of a function that stops at the trial arguments with a RuntimeError or ValueError: it may be made for another
    number of steps, another device or other values. Warns of one whose derivative is not that of its values, which may be
    intended.

    Args:
        function: the function.
        moving: trial arguments that follow from the controls. A function of a single one, a signal, works elementwise;
            others return residuals [.., R].
        others: further trial arguments.
        takes: what the function takes and returns, in words.
        stepwise: whether the function is declared to return a residual per step that depends on this step alone.
    """
    moving, others = ([argument[:, :_FEW] for argument in arguments] for arguments in (moving, others))
    errors: list[Exception] = []
    with torch.random.fork_rng(devices=[]):
        for dtype in (torch.float64, torch.float32):  # a function may hold parameters of single precision
            arguments = [m.to(dtype) for m in moving], [other.to(dtype) for other in others]
            try:
                reason = _flaw(function, *arguments, takes, stepwise)
                share = 0.0 if reason or dtype == torch.float32 else _detached(function, *arguments)
            except Exception as error:
                errors.append(error)
                continue
            if share > _WRONG:
                warnings.warn(
                    f"the function of a feature ({place(function)}) has another derivative than its values, at "
                    f"{share:.0%} of the trial arguments: a part of it is detached, by detach(), item(), float() or "
                    "torch.no_grad(). Solvers follow the derivative, so their solutions are no minima of the energy. Leave "
                    "it so only if this is intended",
                    stacklevel=2,
                )
            return reason
    fails = f"fails on trial arguments: {type(errors[0]).__name__}: {errors[0]}"
    if not isinstance(errors[0], RuntimeError | ValueError):
        return f"{fails}. {takes}"
    warnings.warn(
        f"the function of a feature ({place(function)}) {fails}. This does not matter if it is made for another number of "
        f"steps, another device or other values. {takes}",
        stacklevel=2,
    )
    return None


def _flaw(
    function: Callable[..., Tensor], moving: list[Tensor], others: list[Tensor], takes: str, stepwise: bool
) -> str | None:
    """Reason as :func:`flaw` gives it; errors of the function are raised."""

    def call(*arguments: Tensor) -> Any:  # a wrong function may return anything
        torch.manual_seed(0)  # a function that draws numbers draws the same ones
        return function(*arguments)

    elementwise = len(moving) == 1
    given = [argument.clone() for argument in (*moving, *others)]
    with torch.no_grad():
        value = call(*given)
    if any(not torch.equal(now, before) for now, before in zip(given, (*moving, *others), strict=True)):
        return "changes its arguments in place: they are the trajectory itself. Write x = x - 1 instead of x -= 1"
    if not isinstance(value, Tensor) or not value.is_floating_point():
        kind = f"tensor of {value.dtype}" if isinstance(value, Tensor) else type(value).__name__
        return f"returns a {kind}, and not a tensor of floating-point numbers. {takes}"
    by_step = elementwise or stepwise  # one value per step
    if (value.shape != moving[0].shape[:3]) if by_step else (value.dim() != 3 or value.shape[:2] != (SHAPE[0], _FEW)):
        shapes = " and ".join(str(list(argument.shape)) for argument in (*moving, *others))
        return f"returns the shape {list(value.shape)} for arguments of the shapes {shapes}. {takes}"
    # One value of one trajectory is changed: nothing else may change, of a signal no other step of it either.
    changed = [argument.clone() for argument in moving]
    for argument in changed:
        argument[0, 0, argument.shape[2] // 2] += 1.0
    middle = value.shape[2] // 2
    with torch.no_grad():
        differs = ~torch.isclose(call(*changed, *others), value, rtol=1e-5, atol=1e-5, equal_nan=True)
        differs[0, 0, middle if by_step else slice(None)] = False
        if by_step:  # and if all other steps are changed, this one must stay
            drawn = torch.Generator().manual_seed(4)
            changed = [m + torch.rand(m.shape, generator=drawn, dtype=m.dtype, device="cpu") for m in moving]
            for argument, old in zip(changed, moving, strict=True):
                argument[:, :, middle] = old[:, :, middle]
            moved = call(*changed, *others)[:, :, middle]
            differs[:, :, middle] |= ~torch.isclose(moved, value[:, :, middle], rtol=1e-5, atol=1e-5, equal_nan=True)
    if differs.any():
        what = "a function of one agent (or pair) alone"
        if by_step:
            what = "elementwise: a value depends on other ones" if elementwise else "a function of single steps alone"
        return f"is not {what}. {takes}"
    drawn = torch.Generator().manual_seed(2)
    tangents = tuple(torch.rand(m.shape, generator=drawn, dtype=m.dtype, device="cpu") for m in moving)
    slope = torch.func.jvp(lambda *arguments: call(*arguments, *others), tuple(moving), tangents)[1]
    if value.unique().numel() > 1 and not slope.any():
        return "has a derivative of zero everywhere, so no solver can act on it: comparisons and rounding have no other"
    return None


def _detached(function: Callable[..., Tensor], moving: list[Tensor], others: list[Tensor]) -> float:
    """Share of the values of a function whose difference quotient along one direction is not their derivative."""

    def call(*arguments: Tensor) -> Tensor:
        torch.manual_seed(0)
        return function(*arguments, *others)

    drawn = torch.Generator().manual_seed(3)
    tangents = [torch.rand(m.shape, generator=drawn, dtype=m.dtype, device="cpu") for m in moving]
    slope = torch.func.jvp(call, tuple(moving), tuple(tangents))[1]
    with torch.no_grad():
        ahead, behind = (
            call(*(m + step * tangent for m, tangent in zip(moving, tangents, strict=True)))
            for step in (_APART / 2, -_APART / 2)
        )
    quotient = (ahead - behind) / _APART
    known = quotient.isfinite() & slope.isfinite()
    allowed = 1e-3 * (quotient.abs() + slope.abs()) + 1e-6 * (1.0 + ahead.abs())
    return float((((quotient - slope).abs() > allowed) & known).sum() / known.sum().clamp_min(1))
