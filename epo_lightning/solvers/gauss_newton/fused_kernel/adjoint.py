"""The gradient of phi = -<J mu, r + J d>, with mu and d constant, by controls and parameters; as in `kernel/step.hpp`.

Suffix sums of the derivatives by positions, by their tangents along mu and along d, and by headings and speeds go backwards
in time. They are at the beginning of the fast memory: six for each agent, and then two for each agent.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game.features import WHEELBASE
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import (
    ACC,
    ACCB,
    ACCELERATION,
    ACCREF,
    AHEAD_X,
    AHEAD_Y,
    BOUND_ACC,
    BOUND_JERK,
    BOUND_TURNACC,
    BOUND_TURNR,
    BOUND_VEL,
    COSINE,
    GOAL,
    HEADING,
    JERK,
    JERKB,
    LANE,
    NEAR_X,
    NEAR_Y,
    PAIRS,
    SINE,
    SPEED,
    STEER,
    TURN_RATE,
    TURNACC,
    TURNACCB,
    TURNED,
    TURNR,
    TURNRB,
    TURNRREF,
    VEL,
    VELB,
    VELREF,
    X,
    Y,
)


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    costs: SimpleNamespace,
    pairs: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    evaluate_pair, dual = pairs.evaluate, pairs.dual
    sync, lane = threads.sync, threads.lane
    Game, Gradients, Layout, pair_index, pair_first, weight = (
        games.Game,
        games.Gradients,
        games.Layout,
        games.pair_index,
        games.pair_first,
        games.weight,
    )
    trace, Array, Numbers = games.trace, games.Array, games.Numbers
    excess, excess_slope, steering = costs.excess, costs.excess_slope, costs.steering

    @wp.func
    def roll_tangents(g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, directions: Array):
        """Tangents of the trajectories along mu (first half of the place) and along the direction d (second half)."""
        half = 4 * n * (g.K + 1)
        for e in range(lane(), 2 * n, wp.block_dim()):
            along_d = e // n
            i = e - along_d * n
            to = at.tangents + along_d * half
            row = 2 * (game * g.N + agents[i]) * g.K
            x = T(0.0)
            y = T(0.0)
            heading = T(0.0)
            speed = T(0.0)
            for k in range(g.K + 1):
                place = to + i * (g.K + 1) + k
                work[place + X * n * (g.K + 1)] = x
                work[place + Y * n * (g.K + 1)] = y
                work[place + TURNED * n * (g.K + 1)] = heading
                work[place + SPEED * n * (g.K + 1)] = speed
                if k < g.K:
                    s = work[trace(at, n, g.K, SINE, i) + k]
                    c = work[trace(at, n, g.K, COSINE, i) + k]
                    across = work[trace(at, n, g.K, SPEED, i) + k] * heading
                    x += g.dt * (speed * c - across * s)
                    y += g.dt * (speed * s + across * c)
                    turn = work[at.mu + 2 * (i * g.K + k) + TURN_RATE]
                    thrust = work[at.mu + 2 * (i * g.K + k) + ACCELERATION]
                    if along_d == 1:
                        turn = directions[row + 2 * k + TURN_RATE]
                        thrust = directions[row + 2 * k + ACCELERATION]
                    heading += g.dt * turn
                    speed += g.dt * thrust
        sync()

    @wp.func
    def tangent(g: Game, at: Layout, n: int, work: Array, along_d: int, quantity: int, i: int, state: int):
        return work[at.tangents + ((4 * along_d + quantity) * n + i) * (g.K + 1) + state]

    @wp.func
    def add_gradient(to: Array, slot: int, stride: int, place: int, value: T):
        to[slot * stride + place] = to[slot * stride + place] + value

    @func
    def residual_adjoint(
        g: Game,
        by: Gradients,
        feature: int,
        row: int,
        value: T,
        slope: T,
        along_mu: T,
        along_d: T,
    ):
        """The cotangent of a signal with a residual w c, c'' = 0, and the gradient by the weight."""
        w = weight(g, feature, row)
        add_gradient(
            by.own,
            g.own_slot[feature],
            g.G * g.N,
            row,
            T(-2.0) * w * slope * along_mu * (value + slope * along_d),
        )
        return -w * w * slope * slope * along_mu

    @wp.func
    def pull_to(
        g: Game,
        by: Gradients,
        feature: int,
        row: int,
        fast: Array,
        s: int,
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
        along = x1 * tx + y1 * ty
        across_x = x1 - along * tx
        across_y = y1 - along * ty
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
        fast[s] -= square * across_x
        fast[s + 1] -= square * across_y
        fast[s + 2] -= square * off_x
        fast[s + 3] -= square * off_y
        fast[s + 4] -= square * mu_x
        fast[s + 5] -= square * mu_y
        add_gradient(by.own, g.own_slot[feature], g.G * g.N, row, T(-2.0) * w * (mu_x * off_x + mu_y * off_y))

    @func
    def state_adjoint(
        g: Game,
        by: Gradients,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        nearest: Array,
        fast: Array,
        state: int,
        end: int,
    ):
        """Backpropagates the suffix sums through a state and adds the cotangents of its own features."""
        each = n * (g.K + 1)
        for i in range(lane(), n, wp.block_dim()):
            row = game * g.N + agents[i]
            s = 6 * i
            node = 6 * n + 2 * i
            x1 = tangent(g, at, n, work, 0, X, i, state)
            y1 = tangent(g, at, n, work, 0, Y, i, state)
            heading1 = tangent(g, at, n, work, 0, TURNED, i, state)
            speed1 = tangent(g, at, n, work, 0, SPEED, i, state)
            x2 = tangent(g, at, n, work, 1, X, i, state)
            y2 = tangent(g, at, n, work, 1, Y, i, state)
            heading2 = tangent(g, at, n, work, 1, TURNED, i, state)
            speed2 = tangent(g, at, n, work, 1, SPEED, i, state)
            v = work[trace(at, n, g.K, SPEED, i) + state]
            if state < end:
                c = work[trace(at, n, g.K, COSINE, i) + state]
                si = work[trace(at, n, g.K, SINE, i) + state]
                along0 = c * fast[s] + si * fast[s + 1]
                across0 = c * fast[s + 1] - si * fast[s]
                along1 = c * fast[s + 2] + si * fast[s + 3]
                across1 = c * fast[s + 3] - si * fast[s + 2]
                along2 = c * fast[s + 4] + si * fast[s + 5]
                across2 = c * fast[s + 5] - si * fast[s + 4]
                fast[node] += g.dt * (
                    v * (across0 - along1 * heading1 - along2 * heading2) + across1 * speed1 + across2 * speed2
                )
                fast[node + 1] += g.dt * (along0 + across1 * heading1 + across2 * heading2)
            if g.own_slot[VEL] >= 0:
                fast[node + 1] += residual_adjoint(g, by, VEL, row, v, T(1.0), speed1, speed2)
            if g.own_slot[VELREF] >= 0:
                off = v - g.speeds[(game // g.M) * g.N + agents[i]]
                fast[node + 1] += residual_adjoint(g, by, VELREF, row, off, T(1.0), speed1, speed2)
            if g.own_slot[VELB] >= 0:
                over = excess(g, BOUND_VEL, v)
                slope = excess_slope(g, BOUND_VEL, v)
                fast[node + 1] += residual_adjoint(g, by, VELB, row, over, slope, speed1, speed2)
            px = work[trace(at, n, g.K, X, i) + state]
            py = work[trace(at, n, g.K, Y, i) + state]
            if g.own_slot[LANE] >= 0 and agents[g.N + i] >= 0:
                place = i * (g.K + 1) + state
                pull_to(
                    g,
                    by,
                    LANE,
                    row,
                    fast,
                    s,
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
            if g.own_slot[GOAL] >= 0 and state == end:
                pull_to(
                    g,
                    by,
                    GOAL,
                    row,
                    fast,
                    s,
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
                add_gradient(by.goals, 0, 0, 2 * row, w * w * x1)
                add_gradient(by.goals, 0, 0, 2 * row + 1, w * w * y1)
            if g.own_slot[HEADING] >= 0 and state == end:
                off = work[trace(at, n, g.K, TURNED, i) + state] - g.headings[row]
                force = residual_adjoint(g, by, HEADING, row, off, T(1.0), heading1, heading2)
                fast[node] += force
                add_gradient(by.headings, 0, 0, row, -force)
        sync()

    @func
    def pair_adjoint(
        g: Game,
        by: Gradients,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        fast: Array,
        state: int,
    ):
        """Adds the cotangents of the pair features at a state: each pair by one thread, then the pairs of each agent."""
        count = (n * (n - 1)) // 2
        all_pairs = (g.N * (g.N - 1)) // 2
        stride = g.G * all_pairs
        features = int(PAIRS)  # a variable, or the loops would be unrolled
        if state % g.pair_stride == 0:
            for f in range(features):
                if g.pair_slot[f] >= 0:
                    for p in range(lane(), count, wp.block_dim()):
                        i = pair_first(p, n)
                        j = p - pair_index(i, i + 1, n) + i + 1
                        b = (game // g.M) * g.N
                        place = game * all_pairs + pair_index(agents[i], agents[j], g.N)
                        w = g.pair[g.pair_slot[f] * stride + place]
                        margin = T(0.0)
                        if g.margin_slot[f] >= 0:
                            margin = g.margins[g.margin_slot[f] * stride + place]
                        c1 = work[trace(at, n, g.K, COSINE, i) + state]
                        s1 = work[trace(at, n, g.K, SINE, i) + state]
                        c2 = work[trace(at, n, g.K, COSINE, j) + state]
                        s2 = work[trace(at, n, g.K, SINE, j) + state]
                        turn1a = tangent(g, at, n, work, 0, TURNED, i, state)
                        turn1b = tangent(g, at, n, work, 1, TURNED, i, state)
                        turn2a = tangent(g, at, n, work, 0, TURNED, j, state)
                        turn2b = tangent(g, at, n, work, 1, TURNED, j, state)
                        value, x, y, h1, v1, h2, v2, by_margin = evaluate_pair(
                            f,
                            moving(g, at, n, work, X, i, state),
                            moving(g, at, n, work, Y, i, state),
                            dual(c1, -s1 * turn1a, -s1 * turn1b),
                            dual(s1, c1 * turn1a, c1 * turn1b),
                            moving(g, at, n, work, SPEED, i, state),
                            g.size[2 * (b + agents[i])],
                            g.size[2 * (b + agents[i]) + 1],
                            moving(g, at, n, work, X, j, state),
                            moving(g, at, n, work, Y, j, state),
                            dual(c2, -s2 * turn2a, -s2 * turn2b),
                            dual(s2, c2 * turn2a, c2 * turn2b),
                            moving(g, at, n, work, SPEED, j, state),
                            g.size[2 * (b + agents[j])],
                            g.size[2 * (b + agents[j]) + 1],
                            dual(margin, T(0.0), T(0.0)),
                        )
                        # phi = -w^2 (g mu) (f + g d) with the gradient g of the feature f.
                        square = w * w
                        along_mu = value[1]
                        ahead = value[0] + value[2]
                        rows = at.rows + 10 * p
                        fast[rows] = -square * (x[1] * ahead + along_mu * (x[0] + x[2]))
                        fast[rows + 1] = -square * (y[1] * ahead + along_mu * (y[0] + y[2]))
                        fast[rows + 2] = -square * ahead * x[0]
                        fast[rows + 3] = -square * ahead * y[0]
                        fast[rows + 4] = -square * along_mu * x[0]
                        fast[rows + 5] = -square * along_mu * y[0]
                        fast[rows + 6] = -square * (h1[1] * ahead + along_mu * (h1[0] + h1[2]))
                        fast[rows + 7] = -square * (v1[1] * ahead + along_mu * (v1[0] + v1[2]))
                        fast[rows + 8] = -square * (h2[1] * ahead + along_mu * (h2[0] + h2[2]))
                        fast[rows + 9] = -square * (v2[1] * ahead + along_mu * (v2[0] + v2[2]))
                        add_gradient(by.pair, g.pair_slot[f], stride, place, T(-2.0) * w * along_mu * ahead)
                        if g.margin_slot[f] >= 0:
                            slope = -square * (by_margin[1] * ahead + along_mu * (by_margin[0] + by_margin[2]))
                            add_gradient(by.margins, g.margin_slot[f], stride, place, slope)
                    sync()
                    for i in range(lane(), n, wp.block_dim()):
                        for other in range(n):
                            if other != i:
                                rows = at.rows + 10 * pair_index(wp.min(i, other), wp.max(i, other), n)
                                second = other < i
                                sign = wp.where(second, T(-1.0), T(1.0))
                                six = int(6)
                                for e in range(six):
                                    fast[6 * i + e] += sign * fast[rows + e]
                                own = rows + wp.where(second, 8, 6)
                                fast[6 * n + 2 * i] += fast[own]
                                fast[6 * n + 2 * i + 1] += fast[own + 1]
                    sync()

    @wp.func
    def moving(g: Game, at: Layout, n: int, work: Array, quantity: int, i: int, state: int):
        """A quantity of a trajectory with its derivatives along mu and d."""
        return dual(
            work[trace(at, n, g.K, quantity, i) + state],
            tangent(g, at, n, work, 0, quantity, i, state),
            tangent(g, at, n, work, 1, quantity, i, state),
        )

    @func
    def control_adjoint(
        g: Game,
        by: Gradients,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        fast: Array,
        controls: Array,
        directions: Array,
        k: int,
    ):
        """Adds to the cotangents of the controls of step k, and of the step before: all of an agent by one thread."""
        per_dt = T(1.0) / g.dt
        for i in range(lane(), n, wp.block_dim()):
            row = game * g.N + agents[i]
            node = 6 * n + 2 * i
            channels = int(2)
            for channel in range(channels):
                turning = channel == TURN_RATE
                u = row * g.K * 2 + 2 * k + channel
                mine = at.mu + 2 * (i * g.K + k) + channel
                value = controls[u]
                mu = work[mine]
                d = directions[u]
                bar = g.dt * wp.where(turning, fast[node], fast[node + 1])
                plain = wp.where(turning, TURNR, ACC)
                bounded = wp.where(turning, TURNRB, ACCB)
                referring = wp.where(turning, TURNRREF, ACCREF)
                if g.own_slot[plain] >= 0:
                    bar += residual_adjoint(g, by, plain, row, value, T(1.0), mu, d)
                if g.own_slot[referring] >= 0:
                    force = residual_adjoint(g, by, referring, row, value - g.reference_controls[u], T(1.0), mu, d)
                    bar += force
                    add_gradient(by.reference_controls, 0, 0, u, -force)
                if g.own_slot[bounded] >= 0:
                    signal = wp.where(turning, BOUND_TURNR, BOUND_ACC)
                    bar += residual_adjoint(
                        g, by, bounded, row, excess(g, signal, value), excess_slope(g, signal, value), mu, d
                    )
                if k > 0:
                    change = (value - controls[u - 2]) * per_dt
                    mu_change = (mu - work[mine - 2]) * per_dt
                    d_change = (d - directions[u - 2]) * per_dt
                    rate = wp.where(turning, TURNACC, JERK)
                    rate_bounded = wp.where(turning, TURNACCB, JERKB)
                    force = T(0.0)
                    if g.own_slot[rate] >= 0:
                        force += residual_adjoint(g, by, rate, row, change, T(1.0), mu_change, d_change)
                    if g.own_slot[rate_bounded] >= 0:
                        signal = wp.where(turning, BOUND_TURNACC, BOUND_JERK)
                        force += residual_adjoint(
                            g,
                            by,
                            rate_bounded,
                            row,
                            excess(g, signal, change),
                            excess_slope(g, signal, change),
                            mu_change,
                            d_change,
                        )
                    bar += per_dt * force
                    by.controls[u - 2] = by.controls[u - 2] - per_dt * force
                by.controls[u] = by.controls[u] + bar
            if g.own_slot[STEER] >= 0:
                u = row * g.K * 2 + 2 * k + TURN_RATE
                wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
                angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(
                    wheelbase, controls[u], work[trace(at, n, g.K, SPEED, i) + k]
                )
                w = weight(g, STEER, row)
                square = w * w
                turn1 = work[at.mu + 2 * (i * g.K + k) + TURN_RATE]
                turn2 = directions[u]
                speed1 = tangent(g, at, n, work, 0, SPEED, i, k)
                speed2 = tangent(g, at, n, work, 1, SPEED, i, k)
                s1 = by_turn * turn1 + by_speed * speed1
                value = angle + by_turn * turn2 + by_speed * speed2
                turn_moves1 = turn_turn * turn1 + turn_speed * speed1
                turn_moves2 = turn_turn * turn2 + turn_speed * speed2
                speed_moves1 = turn_speed * turn1 + speed_speed * speed1
                speed_moves2 = turn_speed * turn2 + speed_speed * speed2
                by.controls[u] = by.controls[u] - square * (turn_moves1 * value + s1 * (by_turn + turn_moves2))
                # The next state of the loop backpropagates the derivative by the speed before this step; the first is given.
                if k > 0:
                    fast[node + 1] -= square * (speed_moves1 * value + s1 * (by_speed + speed_moves2))
                add_gradient(by.own, g.own_slot[STEER], g.G * g.N, row, T(-2.0) * w * s1 * value)
        sync()

    @wp.func
    def pull_states(g: Game, by: Gradients, game: int, n: int, agents: Numbers, at: Layout, work: Array):
        """Adds the pullback of the cotangent of the states to that of the controls."""
        for i in range(lane(), n, wp.block_dim()):
            row = (game * g.N + agents[i]) * g.K
            x = T(0.0)
            y = T(0.0)
            heading = T(0.0)
            speed = T(0.0)
            for back in range(g.K):
                k = g.K - 1 - back
                if k + 1 < g.K:
                    c = work[trace(at, n, g.K, COSINE, i) + k + 1]
                    s = work[trace(at, n, g.K, SINE, i) + k + 1]
                    heading += g.dt * work[trace(at, n, g.K, SPEED, i) + k + 1] * (c * y - s * x)
                    speed += g.dt * (c * x + s * y)
                x += by.states[4 * (row + k)]
                y += by.states[4 * (row + k) + 1]
                heading += by.states[4 * (row + k) + 2]
                speed += by.states[4 * (row + k) + 3]
                u = 2 * (row + k)
                by.controls[u + TURN_RATE] = by.controls[u + TURN_RATE] + g.dt * heading
                by.controls[u + ACCELERATION] = by.controls[u + ACCELERATION] + g.dt * speed
        sync()

    return SimpleNamespace(
        roll_tangents=roll_tangents,
        tangent=tangent,
        add_gradient=add_gradient,
        residual_adjoint=residual_adjoint,
        pull_to=pull_to,
        state_adjoint=state_adjoint,
        pair_adjoint=pair_adjoint,
        moving=moving,
        control_adjoint=control_adjoint,
        pull_states=pull_states,
    )
