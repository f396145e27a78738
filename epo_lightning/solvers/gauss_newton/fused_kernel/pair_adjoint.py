"""The gradient of phi (`adjoint.py`) by states, weights and margins of pairs; threads share out pairs at all times."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import COSINE, SINE, SPEED, TURNED, X, Y
from epo_lightning.solvers.gauss_newton.fused_kernel.layout import PAIR_COTANGENTS


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    pairs: SimpleNamespace,
    trajectories: SimpleNamespace,
    products: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    evaluate_pair, dual = pairs.evaluate, pairs.dual
    sync, lane, tangent, pair_product_place = (
        threads.sync,
        threads.lane,
        trajectories.tangent,
        products.pair_product_place,
    )
    Game, Layout, pair_index, trace = games.Game, games.Layout, games.pair_index, trajectories.trace
    pair_feature, pair_count, margin_slot = games.pair_feature, games.pair_count, games.margin_slot
    horizon, first_agent = games.horizon, games.first_agent
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    P = A * (A - 1) // 2
    ten = wp.types.vector(PAIR_COTANGENTS, T)

    @wp.func
    def moving(at: Layout, K: int, work: Array, path: Array, quantity: int, i: int, state: int):
        """A quantity of a trajectory with its derivatives along mu and d."""
        return dual(
            path[trace(at, K, quantity, i) + state],
            work[tangent(at, K, 0, quantity, i) + state],
            work[tangent(at, K, 1, quantity, i) + state],
        )

    @func
    def pair_adjoint(g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, path: Array, end: int):
        """The cotangents of all pairs at all states, and the products of their weights and margins."""
        K = horizon(g)
        all_pairs = (g.N * (g.N - 1)) // 2
        stride = g.G * all_pairs
        for e in range(lane(), end * P, wp.block_dim()):
            k = e // P
            p = e - k * P
            state = k + 1
            i = first_agent(p)
            j = p - pair_index(i, i + 1, A) + i + 1
            found = ten(T(0.0))
            if j < n and state % g.pair_stride == 0:
                one = 2 * ((game // g.M) * g.N + agents[i])
                other = 2 * ((game // g.M) * g.N + agents[j])
                place = game * all_pairs + pair_index(agents[i], agents[j], g.N)
                c1 = path[trace(at, K, COSINE, i) + state]
                s1 = path[trace(at, K, SINE, i) + state]
                c2 = path[trace(at, K, COSINE, j) + state]
                s2 = path[trace(at, K, SINE, j) + state]
                turn1 = moving(at, K, work, path, TURNED, i, state)
                turn2 = moving(at, K, work, path, TURNED, j, state)
                for slot in range(pair_count(g)):
                    w = g.pair[slot * stride + place]
                    margin = T(0.0)
                    if margin_slot(g, slot) >= 0:
                        margin = g.margins[margin_slot(g, slot) * stride + place]
                    value, x, y, h1, v1, h2, v2, by_margin = evaluate_pair(
                        pair_feature(g, slot),
                        moving(at, K, work, path, X, i, state),
                        moving(at, K, work, path, Y, i, state),
                        dual(c1, -s1 * turn1[1], -s1 * turn1[2]),
                        dual(s1, c1 * turn1[1], c1 * turn1[2]),
                        moving(at, K, work, path, SPEED, i, state),
                        g.size[one],
                        g.size[one + 1],
                        moving(at, K, work, path, X, j, state),
                        moving(at, K, work, path, Y, j, state),
                        dual(c2, -s2 * turn2[1], -s2 * turn2[2]),
                        dual(s2, c2 * turn2[1], c2 * turn2[2]),
                        moving(at, K, work, path, SPEED, j, state),
                        g.size[other],
                        g.size[other + 1],
                        dual(margin, T(0.0), T(0.0)),
                    )
                    # phi = -w^2 (g mu) (f + g d) with the gradient g of the feature f.
                    square = w * w
                    along_mu = value[1]
                    ahead = value[0] + value[2]
                    found += -square * ten(
                        x[1] * ahead + along_mu * (x[0] + x[2]),
                        y[1] * ahead + along_mu * (y[0] + y[2]),
                        ahead * x[0],
                        ahead * y[0],
                        along_mu * x[0],
                        along_mu * y[0],
                        h1[1] * ahead + along_mu * (h1[0] + h1[2]),
                        v1[1] * ahead + along_mu * (v1[0] + v1[2]),
                        h2[1] * ahead + along_mu * (h2[0] + h2[2]),
                        v2[1] * ahead + along_mu * (v2[0] + v2[2]),
                    )
                    work[pair_product_place(g, at, K, 0, slot, p) + k] = T(-2.0) * w * along_mu * ahead
                    work[pair_product_place(g, at, K, 1, slot, p) + k] = -square * (
                        by_margin[1] * ahead + along_mu * (by_margin[0] + by_margin[2])
                    )
            for q in range(PAIR_COTANGENTS):
                work[at.touching + (q * P + p) * K + k] = found[q]
        sync()

    return SimpleNamespace(
        pair_adjoint=pair_adjoint,
    )
