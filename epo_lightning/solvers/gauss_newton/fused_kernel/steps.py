"""A damped step of a game with the factors that its adjoint needs, and the energy with the norm of its gradient."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import (
    ACCELERATION,
    TURN_RATE,
)
from epo_lightning.solvers.gauss_newton.structured import LEAST_RAISED_DAMPING


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    costs: SimpleNamespace,
    recursion: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``, decorated by ``func``."""
    sync, lane = threads.sync, threads.lane
    Game, Layout, set_motions, Array, Numbers = games.Game, games.Layout, games.set_motions, games.Array, games.Numbers
    state_costs, pair_costs, control_costs, forget, total = (
        costs.state_costs,
        costs.pair_costs,
        costs.control_costs,
        costs.forget,
        costs.total,
    )
    control_block, factorise, transition, eliminate, pull, push = (
        recursion.control_block,
        recursion.factorise,
        recursion.transition,
        recursion.eliminate,
        recursion.pull,
        recursion.push,
    )

    @func
    def push_all(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        fast: Array,
        factors: Array,
        end: int,
        to: Array,
        own_rows: int,
    ):
        """The forward recursion. It writes [N, K, 2] by agent of the scene, or [n, K, 2] if ``own_rows``, to ``to``."""
        m = 2 * n
        for e in range(lane(), 6 * n, wp.block_dim()):
            fast[at.x + e] = T(0.0)
        sync()
        for k in range(end):
            set_motions(g, n, at, work, fast, k)
            sync()
            first = wp.where(k == 0, 1, 0)
            push(factors, k * 4 * m * m, k * 4 * m * m + m * m, fast, at, n, g.dt, first, work, at.h + k * m)
            for r in range(lane(), m, wp.block_dim()):
                i = r // 2
                place = at.mu + 2 * (i * g.K + k)
                if own_rows == 0:
                    place = 2 * ((game * g.N + agents[i]) * g.K + k)
                to[place + wp.where(r == 2 * i, TURN_RATE, ACCELERATION)] = fast[at.c + r]
            sync()

    @func
    def solve_step(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        nearest: Array,
        fast: Array,
        factors: Array,
        controls: Array,
        end: int,
        raised: T,
        directions: Array,
    ):
        """The damped direction and the factors; returns 0 where the matrix is not positive definite."""
        m = 2 * n
        positive = int(1)
        forget(n, at, fast, 1)
        for back in range(end):
            k = end - 1 - back
            state_costs(g, game, n, agents, at, work, nearest, fast, k + 1, end, 1)
            pair_costs(g, game, n, agents, at, work, fast, k + 1, 1)
            control_costs(g, game, n, agents, at, work, fast, controls, k)
            for r in range(lane(), m, wp.block_dim()):
                given = g.damping[game * g.N + agents[r // 2]]
                fast[at.damped + r] += given
                if raised > T(0.0):
                    fast[at.damped + r] += raised * wp.max(given, T(LEAST_RAISED_DAMPING))
                work[at.h + k * m + r] = fast[at.pull + r]
            sync()
            control_block(fast, at, n, g.dt)
            if factorise(fast, at, n) == 0:
                positive = 0
            first = int(1)
            if k > 0:
                first = 0
                transition(fast, at, n, g.dt)
                eliminate(fast, at, n)
            pull(fast, at.L, at.G, fast, at, n, g.dt, first, work, at.h + k * m)
            for r in range(lane(), m, wp.block_dim()):
                fast[at.y + 2 * m + r] -= fast[at.rate_pull + r]
                if r % 2 == 1:
                    v = m + r
                    fast[at.y + v] += fast[at.speed_pull + r // 2]
                    fast[v * 3 * m + v] += fast[at.speed_stiffness + r // 2]
            for e in range(lane(), m * m, wp.block_dim()):
                factors[k * 4 * m * m + e] = fast[at.L + e]
            for e in range(lane(), 3 * m * m, wp.block_dim()):
                factors[k * 4 * m * m + m * m + e] = fast[at.G + e]
            sync()
        push_all(g, game, n, agents, at, work, fast, factors, end, directions, 0)
        return positive

    @func
    def evaluate(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        nearest: Array,
        fast: Array,
        controls: Array,
        end: int,
    ):
        """The energy and the squared norm of its gradient."""
        m = 2 * n
        forget(n, at, fast, 0)
        for back in range(end):
            k = end - 1 - back
            state_costs(g, game, n, agents, at, work, nearest, fast, k + 1, end, 0)
            pair_costs(g, game, n, agents, at, work, fast, k + 1, 0)
            control_costs(g, game, n, agents, at, work, fast, controls, k)
            for r in range(lane(), m, wp.block_dim()):
                slope = fast[at.pull + r] - fast[at.y + 2 * m + r] + g.dt * fast[at.y + m + r]
                fast[at.norm + r] += slope * slope
                fast[at.y + 2 * m + r] = fast[at.rate_pull + r]
                a = r // 2
                motion = at.Z + 4 * a + 2 * (r - 2 * a)
                force = fast[motion] * fast[at.y + 2 * a] + fast[motion + 1] * fast[at.y + 2 * a + 1]
                if r % 2 == 1:
                    force += fast[at.speed_pull + a]
                fast[at.y + m + r] += force
            sync()
        squared = T(0.0)
        for r in range(m):
            squared += fast[at.norm + r]
        return total(n, at, fast), squared

    return SimpleNamespace(
        push_all=push_all,
        solve_step=solve_step,
        evaluate=evaluate,
    )
