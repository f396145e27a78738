"""Costs of pairs (`expansion.py`) with their derivatives by the states of both agents; threads share out pairs and steps."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import COSINE, SINE, SPEED, X, Y


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    pairs: SimpleNamespace,
    trajectories: SimpleNamespace,
    places: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    evaluate_pair = pairs.evaluate
    lane, put, trace = threads.lane, threads.put, trajectories.trace
    Game, Layout, pair_index, first_agent = games.Game, games.Layout, games.pair_index, games.first_agent
    pair_feature, pair_count, horizon = games.pair_feature, games.pair_count, games.horizon
    row_place, value_place, pair_weight_place = places.row_place, places.value_place, places.pair_weight_place
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    P = A * (A - 1) // 2
    four = wp.types.vector(4, T)

    @func
    def expand_pairs(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        costs: Array,
        first: int,
        last: int,
    ):
        """Values, gradients and energies of all pairs."""
        K = horizon(g)
        for e in range(lane(), (last - first) * P, wp.block_dim()):
            step = e // P
            k = first + step
            p = e - step * P
            state = k + 1
            i = first_agent(p)
            j = p - pair_index(i, i + 1, A) + i + 1
            energy = T(0.0)
            for slot in range(pair_count(g)):
                of_one = four(T(0.0))
                of_other = four(T(0.0))
                pushed = T(0.0)
                if j < n and state % g.pair_stride == 0:
                    one = 2 * ((game // g.M) * g.N + agents[i])
                    other = 2 * ((game // g.M) * g.N + agents[j])
                    w = costs[pair_weight_place(g, slot, 0, p)]
                    margin = costs[pair_weight_place(g, slot, 1, p)]
                    value, x, y, turn1, faster1, turn2, faster2, by_margin = evaluate_pair(
                        pair_feature(g, slot),
                        path[trace(at, K, X, i) + state],
                        path[trace(at, K, Y, i) + state],
                        path[trace(at, K, COSINE, i) + state],
                        path[trace(at, K, SINE, i) + state],
                        path[trace(at, K, SPEED, i) + state],
                        g.size[one],
                        g.size[one + 1],
                        path[trace(at, K, X, j) + state],
                        path[trace(at, K, Y, j) + state],
                        path[trace(at, K, COSINE, j) + state],
                        path[trace(at, K, SINE, j) + state],
                        path[trace(at, K, SPEED, j) + state],
                        g.size[other],
                        g.size[other + 1],
                        margin,
                    )
                    of_one = w * four(x, y, turn1, faster1)
                    of_other = w * four(-x, -y, turn2, faster2)
                    pushed = w * value
                energy += T(0.5) * pushed * pushed
                put(costs, row_place(slot, step, i, j), of_one[0], of_one[1], of_one[2], of_one[3])
                put(costs, row_place(slot, step, j, i), of_other[0], of_other[1], of_other[2], of_other[3])
                costs[value_place(slot, step, p)] = pushed
            work[at.energy + (A + p) * K + k] = energy

    return SimpleNamespace(expand_pairs=expand_pairs)
