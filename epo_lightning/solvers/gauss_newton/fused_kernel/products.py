"""Products that residuals add to the gradients by weights and margins: kept for every step, then summed along time.

The cotangent of a signal with a residual that is linear in it is here too, because it keeps its product.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp


@no_type_check
def make(T: Any, threads: SimpleNamespace, games: SimpleNamespace, func: Any) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    sync, lane, row_sum = threads.sync, threads.lane, threads.row_sum
    Game, Gradients, Layout, pair_index, pair_first, weight = (
        games.Game,
        games.Gradients,
        games.Layout,
        games.pair_index,
        games.pair_first,
        games.weight,
    )
    own_slot, own_count, pair_count, margin_slot = games.own_slot, games.own_count, games.pair_count, games.margin_slot
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    P = A * (A - 1) // 2
    horizon = games.horizon

    @wp.func
    def keep_own_product(g: Game, at: Layout, work: Array, feature: int, i: int, k: int, value: T):
        """Keeps what an own feature at a step adds to the gradient by its weight."""
        K = horizon(g)
        work[at.weights + (own_slot(g, feature) * A + i) * K + k] = value

    @wp.func
    def pair_product_place(g: Game, at: Layout, K: int, kind: int, slot: int, p: int):
        """Start of what a pair feature (kind 0) or its margin (1) adds to its gradient along time."""
        return at.weights + (own_count(g) * A + (kind * pair_count(g) + slot) * P + p) * K

    @func
    def forget_products(g: Game, at: Layout, work: Array):
        """Sets all products to zero."""
        K = horizon(g)
        for e in range(lane(), (own_count(g) * A + 2 * pair_count(g) * P) * K, wp.block_dim()):
            work[at.weights + e] = T(0.0)
        sync()

    @func
    def add_products(g: Game, by: Gradients, game: int, n: int, agents: Numbers, at: Layout, work: Array, end: int):
        """Adds the sums along time of the products to the gradients by weights and margins."""
        K = horizon(g)
        for e in range(lane(), own_count(g) * n, wp.block_dim()):
            slot = e // n
            i = e - slot * n
            value = row_sum(work, at.weights + (slot * A + i) * K, end)
            to = slot * g.G * g.N + game * g.N + agents[i]
            by.own[to] = by.own[to] + value
        all_pairs = (g.N * (g.N - 1)) // 2
        for p in range(lane(), (n * (n - 1)) // 2, wp.block_dim()):
            i = pair_first(p, n)
            j = p - pair_index(i, i + 1, n) + i + 1
            place = game * all_pairs + pair_index(agents[i], agents[j], g.N)
            for slot in range(pair_count(g)):
                product = pair_product_place(g, at, K, 0, slot, pair_index(i, j, A))
                by_margin = pair_product_place(g, at, K, 1, slot, pair_index(i, j, A))
                value = row_sum(work, product, end)
                slope = row_sum(work, by_margin, end)
                to = slot * g.G * all_pairs + place
                by.pair[to] = by.pair[to] + value
                if margin_slot(g, slot) >= 0:
                    to = margin_slot(g, slot) * g.G * all_pairs + place
                    by.margins[to] = by.margins[to] + slope
        sync()

    @wp.func
    def residual_adjoint(
        g: Game,
        at: Layout,
        work: Array,
        feature: int,
        row: int,
        i: int,
        k: int,
        value: T,
        slope: T,
        along_mu: T,
        along_d: T,
    ):
        """The cotangent of a signal with a residual w c(signal), c'' = 0; keeps the product for the weight's gradient."""
        w = weight(g, feature, row)
        keep_own_product(g, at, work, feature, i, k, T(-2.0) * w * slope * along_mu * (value + slope * along_d))
        return -w * w * slope * slope * along_mu

    return SimpleNamespace(
        keep_own_product=keep_own_product,
        pair_product_place=pair_product_place,
        forget_products=forget_products,
        add_products=add_products,
        residual_adjoint=residual_adjoint,
    )
