"""Sums over a whole game: its energy, and the squared norm of the energy's gradient by the controls."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp


@no_type_check
def make(T: Any, threads: SimpleNamespace, games: SimpleNamespace) -> SimpleNamespace:
    """The functions for numbers of type ``T``."""
    sync, lane = threads.sync, threads.lane
    Layout, Array, A = games.Layout, games.Array, games.agents
    P = A * (A - 1) // 2

    @wp.func
    def total(at: Layout, work: Array, K: int, end: int):
        """The energy: the sums along time of agents, then of pairs."""
        parts = at.energy + (A + P) * K
        for e in range(lane(), A + P, wp.block_dim()):
            part = T(0.0)
            for k in range(end):
                part += work[at.energy + e * K + k]
            work[parts + e] = part
        sync()
        energy = T(0.0)
        for e in range(A + P):
            energy += work[parts + e]
        return energy

    @wp.func
    def squared_slope(n: int, costs: Array):
        """The squared norm of the gradient by the controls, from the sums of the agents."""
        squared = T(0.0)
        for i in range(n):
            squared += costs[5 * i + 4]
        sync()
        return squared

    return SimpleNamespace(total=total, squared_slope=squared_slope)
