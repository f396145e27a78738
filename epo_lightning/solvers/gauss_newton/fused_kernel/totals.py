"""Sums over a whole game: its energy, and the squared norm of the energy's gradient by the controls."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import MOTION, PULL, RATE
from epo_lightning.solvers.gauss_newton.fused_kernel.layout import CONTROL_ITEMS


@no_type_check
def make(T: Any, threads: SimpleNamespace, games: SimpleNamespace, func: Any) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    sync, lane, sums_back = threads.sync, threads.lane, threads.sums_back
    Game, Layout, Array, A = games.Game, games.Layout, games.Array, games.agents
    P = A * (A - 1) // 2
    wide = 4 * A  # columns of the Hessian of a state's costs; its gradient is one more row

    @wp.func
    def total(at: Layout, work: Array, K: int, end: int):
        """The energy: the sums along time of agents, then of pairs."""
        parts = at.costs + 8 * A * K
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

    @func
    def squared_slope(g: Game, n: int, at: Layout, work: Array, end: int):
        """The squared norm of the gradient by the controls: sums of the forces backwards in time."""
        stride = (wide + 1) * wide
        forces = at.hessian + wide * wide
        for e in range(lane(), 2 * n, wp.block_dim()):
            i = e // 2
            axis = e - 2 * i
            sums_back(work, forces + 4 * i + axis, stride, end, work, at.costs + e * g.K)
        sync()
        # By heading and speed of a state: its own, and those of later positions through its motion.
        for e in range(lane(), 2 * n * end, wp.block_dim()):
            r = e // end
            k = e - r * end
            i = r // 2
            axis = r - 2 * i
            force = work[forces + k * stride + 4 * i + 2 + axis]
            if k + 1 < end:
                moved = at.control + ((k + 1) * CONTROL_ITEMS + MOTION + 2 * axis) * A + i
                force += work[moved] * work[at.costs + 2 * i * g.K + k + 1]
                force += work[moved + A] * work[at.costs + (2 * i + 1) * g.K + k + 1]
            work[at.costs + (2 * A + r) * g.K + k] = force
        sync()
        for r in range(lane(), 2 * n, wp.block_dim()):
            by = at.costs + (2 * A + r) * g.K
            sums_back(work, by, 1, end, work, by)
            i = r // 2
            item = at.control + wp.where(r == 2 * i, 0, A) + i
            squared = T(0.0)
            for k in range(end):
                slope = work[item + (k * CONTROL_ITEMS + PULL) * A] + g.dt * work[by + k]
                if k + 1 < end:
                    slope -= work[item + ((k + 1) * CONTROL_ITEMS + RATE) * A]
                squared += slope * slope
            work[at.costs + (4 * A + r) * g.K] = squared
        sync()
        norm = T(0.0)
        for r in range(2 * n):
            norm += work[at.costs + (4 * A + r) * g.K]
        sync()
        return norm

    return SimpleNamespace(
        total=total,
        squared_slope=squared_slope,
    )
