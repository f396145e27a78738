"""The gradient of phi (`adjoint.py`) by positions, drawn to goals and lines; threads share out agents at all times."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import AHEAD_X, AHEAD_Y, GOAL, LANE, NEAR_X, NEAR_Y, X, Y


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    trajectories: SimpleNamespace,
    products: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    sync, lane, sums_back = threads.sync, threads.lane, threads.sums_back
    Game, Gradients, Layout, pair_index, weight = (
        games.Game,
        games.Gradients,
        games.Layout,
        games.pair_index,
        games.weight,
    )
    own_slot, pair_count, horizon = games.own_slot, games.pair_count, games.horizon
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    P = A * (A - 1) // 2
    six = wp.types.vector(6, T)
    trace, tangent, along = trajectories.trace, trajectories.tangent, trajectories.along
    keep_own_product = products.keep_own_product

    @wp.func
    def pull_to(
        g: Game,
        at: Layout,
        work: Array,
        feature: int,
        row: int,
        i: int,
        k: int,
        gap_x: T,
        gap_y: T,
        x1: T,
        y1: T,
        x2: T,
        y2: T,
        tx: T,
        ty: T,
        slides: int,
    ):
        """Cotangents of a position that is drawn to a point, which slides along the unit tangent (tx, ty)."""
        w = weight(g, feature, row)
        square = w * w
        along_tangent = x1 * tx + y1 * ty
        across_x = x1 - along_tangent * tx
        across_y = y1 - along_tangent * ty
        mu_x = x1
        mu_y = y1
        off_x = gap_x + x2
        off_y = gap_y + y2
        if slides == 1:
            ahead = x2 * tx + y2 * ty
            mu_x = across_x
            mu_y = across_y
            off_x -= ahead * tx
            off_y -= ahead * ty
        keep_own_product(g, at, work, feature, i, k, T(-2.0) * w * (mu_x * off_x + mu_y * off_y))
        return -square * six(across_x, across_y, off_x, off_y, mu_x, mu_y)

    @func
    def position_adjoint(
        g: Game,
        by: Gradients,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        nearest: Array,
        end: int,
    ):
        """The cotangents of positions and of their tangents at all states, summed over the states from each on."""
        K = horizon(g)
        each = n * (K + 1)
        for e in range(lane(), end * n, wp.block_dim()):
            i = e // end
            k = e - i * end
            state = k + 1
            row = game * g.N + agents[i]
            x1 = work[tangent(at, K, 0, X, i) + state]
            y1 = work[tangent(at, K, 0, Y, i) + state]
            x2 = work[tangent(at, K, 1, X, i) + state]
            y2 = work[tangent(at, K, 1, Y, i) + state]
            px = path[trace(at, K, X, i) + state]
            py = path[trace(at, K, Y, i) + state]
            found = six(T(0.0))
            if own_slot(g, LANE) >= 0 and agents[g.N + i] >= 0:
                place = i * (K + 1) + state
                found += pull_to(
                    g,
                    at,
                    work,
                    LANE,
                    row,
                    i,
                    k,
                    px - nearest[NEAR_X * each + place],
                    py - nearest[NEAR_Y * each + place],
                    x1,
                    y1,
                    x2,
                    y2,
                    nearest[AHEAD_X * each + place],
                    nearest[AHEAD_Y * each + place],
                    g.slides,
                )
            if own_slot(g, GOAL) >= 0 and state == end:
                found += pull_to(
                    g,
                    at,
                    work,
                    GOAL,
                    row,
                    i,
                    k,
                    px - g.goals[2 * row],
                    py - g.goals[2 * row + 1],
                    x1,
                    y1,
                    x2,
                    y2,
                    T(0.0),
                    T(0.0),
                    0,
                )
                w = weight(g, GOAL, row)
                by.goals[2 * row] = by.goals[2 * row] + w * w * x1
                by.goals[2 * row + 1] = by.goals[2 * row + 1] + w * w * y1
            for other in range(n):
                if other != i and pair_count(g) > 0:
                    p = pair_index(wp.min(i, other), wp.max(i, other), A)
                    sign = wp.where(other < i, T(-1.0), T(1.0))
                    for q in range(6):
                        found[q] += sign * work[at.touching + (q * P + p) * K + k]
            for q in range(6):
                work[along(at, K, q, i) + k] = found[q]
        sync()
        for e in range(lane(), 6 * n, wp.block_dim()):
            i = e // 6
            to = along(at, K, e - 6 * i, i)
            sums_back(work, to, 1, end, work, to)
        sync()

    return SimpleNamespace(position_adjoint=position_adjoint)
