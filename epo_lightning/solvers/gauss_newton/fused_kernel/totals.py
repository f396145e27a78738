"""Sums over a whole game: its energy, and the squared norm of the energy's gradient by the controls."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp


@no_type_check
def make(T: Any, threads: SimpleNamespace, games: SimpleNamespace) -> SimpleNamespace:
    """The functions for numbers of type ``T``."""
    sync, lane, row_sum = threads.sync, threads.lane, threads.row_sum
    Layout, Array, A = games.Layout, games.Array, games.agents
    P = A * (A - 1) // 2

    @wp.func
    def total(at: Layout, work: Array, K: int, end: int):
        """The energy: the sums along time of agents, then of pairs."""
        parts = at.energy + (A + P) * K
        for e in range(lane(), A + P, wp.block_dim()):
            work[parts + e] = row_sum(work, at.energy + e * K, end)
        sync()
        return row_sum(work, parts, A + P)

    @wp.func
    def squared_slope(n: int, costs: Array):
        """The squared norm of the gradient by the controls; each agent has five sums of `slopes` in `recursion.hpp`."""
        squared = T(0.0)
        for i in range(n):
            squared += costs[5 * i + 4]
        sync()
        return squared

    return SimpleNamespace(total=total, squared_slope=squared_slope)
