"""Test of whether a pair feature costs both agents the same, as a potential requires (Theorem 1).

A function of the states of two agents is evaluated on trial agents of all sizes, 10 cm to 100 m apart, slow and fast, in all
directions. A symmetric function always passes; an asymmetric one is detected unless it is symmetric on all trial agents.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

_PAIRS, _STEPS, _DT = (4, 64), 40, 0.1
_TOLERANCE = 1e-6
_MARGIN = 0.5  # [m]


@cache
def _agents() -> tuple[tuple[Float[Tensor, "*batch K 4"], Float[Tensor, "*batch 1 2"]], ...]:
    """States and sizes of the first and of the second trial agents, the same at every call."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> Tensor:
        return torch.rand(*_PAIRS, *shape, generator=generator, dtype=torch.float64, device="cpu")

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


@torch.no_grad()
def difference(function: Callable[..., Tensor], sizes: bool, margin: bool = False) -> tuple[float, float] | None:
    """The costs 1/2 |r|^2 of the two orders of the trial pair with the largest difference; None for a symmetric function.

    Pairs whose cost is not finite are left out.

    Args:
        function: takes the states of the first and of the second agent [.., K, 4], and with ``sizes`` their sizes
            [.., 1, 2], and with ``margin`` a margin [.., 1]; returns residuals [.., R].
        sizes, margin: whether the function takes sizes and a margin.
    """

    further = (torch.full((*_PAIRS, 1), _MARGIN, dtype=torch.float64, device="cpu"),) if margin else ()

    def cost(*agents: tuple[Tensor, Tensor]) -> Tensor:
        states, their_sizes = ([tensor.clone() for tensor in tensors] for tensors in zip(*agents, strict=True))
        return 0.5 * function(*states, *(their_sizes if sizes else ()), *further).square().sum(-1).flatten()

    first, second = _agents()
    here, there = cost(first, second), cost(second, first)
    known = here.isfinite() & there.isfinite()
    share = torch.where(known, (here - there).abs() / (here + there).clamp_min(1e-12), 0.0)
    worst = share.argmax()
    return (here[worst].item(), there[worst].item()) if share[worst] > _TOLERANCE else None
