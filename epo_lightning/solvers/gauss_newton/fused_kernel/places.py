"""Places in fast memory: of the derivatives of a few steps, and of a game's weights and margins, which are copied there."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.layout import CONTROL_ITEMS, Fast


@no_type_check
def make(T: Any, threads: SimpleNamespace, games: SimpleNamespace, fast: Fast, func: Any) -> SimpleNamespace:
    """The functions for numbers of type ``T``, with fast memory for ``fast``; ``func`` decorates the longer ones."""
    sync, lane = threads.sync, threads.lane
    Game, pair_index, first_agent = games.Game, games.pair_index, games.first_agent
    own_slot, own_count, pair_count, margin_slot = games.own_slot, games.own_count, games.pair_count, games.margin_slot
    steps, control_place, rows_place, weights_place = fast.steps, fast.control, fast.rows, fast.weights
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    P = A * (A - 1) // 2

    @wp.func
    def control_items(k: int):
        """Derivatives by the controls of a step [13, A]."""
        return control_place + (k % (steps + 1)) * (CONTROL_ITEMS * A)

    @wp.func
    def row_place(slot: int, step: int, i: int, other: int):
        """The gradient of a pair feature by agent i's position, heading and speed."""
        return rows_place + (((slot * steps + step) * A + i) * A + other) * 4

    @wp.func
    def value_place(slot: int, step: int, pair: int):
        """The value of a pair feature."""
        return row_place(slot, step, pair // 4, pair // 4) + pair % 4

    @wp.func
    def weight(g: Game, costs: Array, feature: int, i: int):
        """The weight of an own feature that the energy has."""
        return costs[weights_place + own_slot(g, feature) * A + i]

    @wp.func
    def pair_weight_place(g: Game, slot: int, margin: int, pair: int):
        """The weight of a pair feature, or its margin."""
        return weights_place + own_count(g) * A + (slot * 2 + margin) * P + pair

    @func
    def copy_weights(g: Game, game: int, n: int, agents: Numbers, costs: Array):
        """Copies the weights and margins of a game to fast memory."""
        for e in range(lane(), own_count(g) * A, wp.block_dim()):
            slot = e // A
            i = e - slot * A
            if i < n:
                costs[weights_place + e] = g.own[slot * g.G * g.N + game * g.N + agents[i]]
        all_pairs = (g.N * (g.N - 1)) // 2
        for e in range(lane(), pair_count(g) * P, wp.block_dim()):
            slot = e // P
            p = e - slot * P
            i = first_agent(p)
            j = p - pair_index(i, i + 1, A) + i + 1
            if j < n:
                place = game * all_pairs + pair_index(agents[i], agents[j], g.N)
                costs[pair_weight_place(g, slot, 0, p)] = g.pair[slot * g.G * all_pairs + place]
                margin = T(0.0)
                if margin_slot(g, slot) >= 0:
                    margin = g.margins[margin_slot(g, slot) * g.G * all_pairs + place]
                costs[pair_weight_place(g, slot, 1, p)] = margin
        sync()

    return SimpleNamespace(
        control_items=control_items,
        row_place=row_place,
        value_place=value_place,
        weight=weight,
        pair_weight_place=pair_weight_place,
        copy_weights=copy_weights,
    )
