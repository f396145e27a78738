"""Sums over a whole game: its energy, and the squared norm of the energy's gradient by the controls."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import MOTION, PULL, RATE


@no_type_check
def make(
    T: Any, threads: SimpleNamespace, games: SimpleNamespace, expansion: SimpleNamespace, func: Any
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    sync, lane = threads.sync, threads.lane
    control_items, force_place = expansion.control_items, expansion.force_place
    Game, Layout, Array, A = games.Game, games.Layout, games.Array, games.agents
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

    # ---- The gradient by the controls, backwards in time; its sums are in the place of the recursion's arrays

    @wp.func
    def forget_slopes(costs: Array):
        """Sets the sums of all agents to zero: of forces by position, heading and speed, and of squared slopes."""
        for e in range(lane(), 5 * A, wp.block_dim()):
            costs[e] = T(0.0)
        sync()

    @func
    def add_slopes(g: Game, n: int, costs: Array, first: int, last: int, end: int):
        """Adds the forces of some steps to the sums, and the squares of the derivatives by their controls."""
        for i in range(lane(), n, wp.block_dim()):
            x = costs[5 * i]
            y = costs[5 * i + 1]
            turned = costs[5 * i + 2]
            faster = costs[5 * i + 3]
            squared = costs[5 * i + 4]
            for back in range(last - first):
                k = last - 1 - back
                here = control_items(k) + i
                force = force_place(k, first, i)
                turned += costs[force + 2]
                faster += costs[force + 3]
                turning = costs[here + PULL * A]
                speeding = costs[here + (PULL + 1) * A]
                if k + 1 < end:  # later positions move with heading and speed, and the next change starts from this control
                    later = control_items(k + 1) + i
                    turned += costs[later + MOTION * A] * x + costs[later + (MOTION + 1) * A] * y
                    faster += costs[later + (MOTION + 2) * A] * x + costs[later + (MOTION + 3) * A] * y
                    turning -= costs[later + RATE * A]
                    speeding -= costs[later + (RATE + 1) * A]
                x += costs[force]
                y += costs[force + 1]
                turning += g.dt * turned
                speeding += g.dt * faster
                squared += turning * turning + speeding * speeding
            costs[5 * i] = x
            costs[5 * i + 1] = y
            costs[5 * i + 2] = turned
            costs[5 * i + 3] = faster
            costs[5 * i + 4] = squared
        sync()

    @wp.func
    def squared_slope(n: int, costs: Array):
        """The squared norm of the gradient."""
        squared = T(0.0)
        for i in range(n):
            squared += costs[5 * i + 4]
        sync()
        return squared

    return SimpleNamespace(
        total=total, forget_slopes=forget_slopes, add_slopes=add_slopes, squared_slope=squared_slope
    )
