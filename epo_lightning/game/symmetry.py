"""Test of whether a pair feature costs both agents the same, as a potential requires (Theorem 1).

A function of the states of two agents is evaluated on trial agents. A symmetric function always passes; an asymmetric one is
detected unless it is symmetric on all trial agents.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from epo_lightning.game import trials

_TOLERANCE = 1e-6
_MARGIN = 0.5  # [m]


@torch.no_grad()
def difference(function: Callable[..., Tensor], sizes: bool, margin: bool = False) -> tuple[float, float] | None:
    """The costs 1/2 |r|^2 of the two orders of the trial pair with the largest difference; None for a symmetric function.

    Pairs whose cost is not finite are left out.

    Args:
        function: takes the states of the first and of the second agent [.., K, 4], and with ``sizes`` their sizes
            [.., 1, 2], and with ``margin`` a margin [.., 1]; returns residuals [.., R].
        sizes, margin: whether the function takes sizes and a margin.
    """

    further = (torch.full((*trials.SHAPE, 1), _MARGIN, dtype=torch.float64, device="cpu"),) if margin else ()

    def cost(*agents: tuple[Tensor, Tensor]) -> Tensor:
        states, their_sizes = ([tensor.clone() for tensor in tensors] for tensors in zip(*agents, strict=True))
        return 0.5 * function(*states, *(their_sizes if sizes else ()), *further).square().sum(-1).flatten()

    first, second = trials.agents()
    here, there = cost(first, second), cost(second, first)
    known = here.isfinite() & there.isfinite()
    share = torch.where(known, (here - there).abs() / (here + there).clamp_min(1e-12), 0.0)
    worst = share.argmax()
    return (here[worst].item(), there[worst].item()) if share[worst] > _TOLERANCE else None
