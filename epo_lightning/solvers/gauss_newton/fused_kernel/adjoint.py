"""The gradient of phi = -<J mu, r + J d>, with mu and d constant, by controls and parameters; as in `kernel/step.hpp`.

The costs of headings, speeds and controls are here, those of positions in `position_adjoint.py`, and those of pairs in
`pair_adjoint.py`. Threads share out agents at all times; in between, cotangents are summed backwards in time.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game.features import WHEELBASE
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import (
    ACC,
    ACCB,
    ACCREF,
    BOUND_ACC,
    BOUND_JERK,
    BOUND_TURNACC,
    BOUND_TURNR,
    BOUND_VEL,
    COSINE,
    HEADING,
    JERK,
    JERKB,
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
)


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    residuals: SimpleNamespace,
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
    excess, excess_slope, steering = residuals.excess, residuals.excess_slope, residuals.steering
    trace, tangent, along = trajectories.trace, trajectories.tangent, trajectories.along
    keep_own_product, residual_adjoint = products.keep_own_product, products.residual_adjoint

    @func
    def motion_adjoint(
        g: Game,
        by: Gradients,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        controls: Array,
        directions: Array,
        end: int,
    ):
        """The cotangents of headings and speeds, with those of later positions, summed over the states from each on."""
        K = horizon(g)
        for e in range(lane(), end * n, wp.block_dim()):
            i = e // end
            k = e - i * end
            state = k + 1
            row = game * g.N + agents[i]
            heading1 = work[tangent(at, K, 0, TURNED, i) + state]
            speed1 = work[tangent(at, K, 0, SPEED, i) + state]
            heading2 = work[tangent(at, K, 1, TURNED, i) + state]
            speed2 = work[tangent(at, K, 1, SPEED, i) + state]
            v = path[trace(at, K, SPEED, i) + state]
            by_heading = T(0.0)
            by_speed_of = T(0.0)
            if state < end:
                c = path[trace(at, K, COSINE, i) + state]
                s = path[trace(at, K, SINE, i) + state]
                x0 = work[along(at, K, 0, i) + state]
                y0 = work[along(at, K, 1, i) + state]
                x_mu = work[along(at, K, 2, i) + state]
                y_mu = work[along(at, K, 3, i) + state]
                x_d = work[along(at, K, 4, i) + state]
                y_d = work[along(at, K, 5, i) + state]
                along0 = c * x0 + s * y0
                across0 = c * y0 - s * x0
                along1 = c * x_mu + s * y_mu
                across1 = c * y_mu - s * x_mu
                along2 = c * x_d + s * y_d
                across2 = c * y_d - s * x_d
                by_heading = g.dt * (
                    v * (across0 - along1 * heading1 - along2 * heading2) + across1 * speed1 + across2 * speed2
                )
                by_speed_of = g.dt * (along0 + across1 * heading1 + across2 * heading2)
                if own_slot(g, STEER) >= 0:
                    u = row * K * 2 + 2 * state + TURN_RATE
                    by_speed_of += steering_adjoint(
                        g, game, agents, at, work, path, controls, directions, i, u, state, 1
                    )
            if own_slot(g, VEL) >= 0:
                by_speed_of += residual_adjoint(g, at, work, VEL, row, i, k, v, T(1.0), speed1, speed2)
            if own_slot(g, VELREF) >= 0:
                off = v - g.speeds[(game // g.M) * g.N + agents[i]]
                by_speed_of += residual_adjoint(g, at, work, VELREF, row, i, k, off, T(1.0), speed1, speed2)
            if own_slot(g, VELB) >= 0:
                over = excess(g, BOUND_VEL, v)
                slope = excess_slope(g, BOUND_VEL, v)
                by_speed_of += residual_adjoint(g, at, work, VELB, row, i, k, over, slope, speed1, speed2)
            if own_slot(g, HEADING) >= 0 and state == end:
                off = path[trace(at, K, TURNED, i) + state] - g.goal_headings[row]
                force = residual_adjoint(g, at, work, HEADING, row, i, k, off, T(1.0), heading1, heading2)
                by_heading += force
                by.goal_headings[row] = by.goal_headings[row] - force
            for other in range(n):
                if other != i and pair_count(g) > 0:
                    p = pair_index(wp.min(i, other), wp.max(i, other), A)
                    first = wp.where(other < i, 8, 6)
                    by_heading += work[at.touching + (first * P + p) * K + k]
                    by_speed_of += work[at.touching + ((first + 1) * P + p) * K + k]
            work[along(at, K, 6, i) + k] = by_heading
            work[along(at, K, 7, i) + k] = by_speed_of
        sync()
        for e in range(lane(), 2 * n, wp.block_dim()):
            i = e // 2
            to = along(at, K, 6 + e - 2 * i, i)
            sums_back(work, to, 1, end, work, to)
        sync()

    @wp.func
    def steering_adjoint(
        g: Game,
        game: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        controls: Array,
        directions: Array,
        i: int,
        u: int,
        k: int,
        of_speed: int,
    ):
        """The cotangent of the speed before a step (``of_speed`` 1), or of the turn rate of the step (0), which also keeps
        the product of the weight."""
        K = horizon(g)
        row = game * g.N + agents[i]
        wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
        angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(
            wheelbase, controls[u], path[trace(at, K, SPEED, i) + k]
        )
        w = weight(g, STEER, row)
        turn1 = work[at.mu + 2 * (i * K + k) + TURN_RATE]
        turn2 = directions[u]
        speed1 = work[tangent(at, K, 0, SPEED, i) + k]
        speed2 = work[tangent(at, K, 1, SPEED, i) + k]
        s1 = by_turn * turn1 + by_speed * speed1
        value = angle + by_turn * turn2 + by_speed * speed2
        if of_speed == 1:
            moves1 = turn_speed * turn1 + speed_speed * speed1
            moves2 = turn_speed * turn2 + speed_speed * speed2
            return -w * w * (moves1 * value + s1 * (by_speed + moves2))
        keep_own_product(g, at, work, STEER, i, k, T(-2.0) * w * s1 * value)
        moves1 = turn_turn * turn1 + turn_speed * speed1
        moves2 = turn_turn * turn2 + turn_speed * speed2
        return -w * w * (moves1 * value + s1 * (by_turn + moves2))

    @func
    def control_adjoint(
        g: Game,
        by: Gradients,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        controls: Array,
        directions: Array,
        end: int,
    ):
        """Adds to the cotangents of all controls and reference controls."""
        K = horizon(g)
        per_dt = T(1.0) / g.dt
        for e in range(lane(), n * end, wp.block_dim()):
            k = e // n
            i = e - k * n
            row = game * g.N + agents[i]
            for channel in range(2):
                u = row * K * 2 + 2 * k + channel
                mine = at.mu + 2 * (i * K + k) + channel
                turning = channel == TURN_RATE
                force = T(0.0)
                if k > 0:
                    change = (controls[u] - controls[u - 2]) * per_dt
                    mu_change = (work[mine] - work[mine - 2]) * per_dt
                    d_change = (directions[u] - directions[u - 2]) * per_dt
                    rate = wp.where(turning, TURNACC, JERK)
                    rate_bounded = wp.where(turning, TURNACCB, JERKB)
                    if own_slot(g, rate) >= 0:
                        force += residual_adjoint(g, at, work, rate, row, i, k, change, T(1.0), mu_change, d_change)
                    if own_slot(g, rate_bounded) >= 0:
                        signal = wp.where(turning, BOUND_TURNACC, BOUND_JERK)
                        over = excess(g, signal, change)
                        slope = excess_slope(g, signal, change)
                        force += residual_adjoint(
                            g, at, work, rate_bounded, row, i, k, over, slope, mu_change, d_change
                        )
                work[at.rates + (channel * A + i) * (K + 1) + k] = per_dt * force
        sync()
        for e in range(lane(), n * end, wp.block_dim()):
            k = e // n
            i = e - k * n
            row = game * g.N + agents[i]
            for channel in range(2):
                u = row * K * 2 + 2 * k + channel
                turning = channel == TURN_RATE
                value = controls[u]
                mu = work[at.mu + 2 * (i * K + k) + channel]
                d = directions[u]
                rate = at.rates + (channel * A + i) * (K + 1) + k
                bar = g.dt * work[along(at, K, wp.where(turning, 6, 7), i) + k] + work[rate]
                if k + 1 < end:
                    bar -= work[rate + 1]
                plain = wp.where(turning, TURNR, ACC)
                bounded = wp.where(turning, TURNRB, ACCB)
                referring = wp.where(turning, TURNRREF, ACCREF)
                if own_slot(g, plain) >= 0:
                    bar += residual_adjoint(g, at, work, plain, row, i, k, value, T(1.0), mu, d)
                if own_slot(g, referring) >= 0:
                    off = value - g.reference_controls[u]
                    force = residual_adjoint(g, at, work, referring, row, i, k, off, T(1.0), mu, d)
                    bar += force
                    by.reference_controls[u] = by.reference_controls[u] - force
                if own_slot(g, bounded) >= 0:
                    signal = wp.where(turning, BOUND_TURNR, BOUND_ACC)
                    over = excess(g, signal, value)
                    slope = excess_slope(g, signal, value)
                    bar += residual_adjoint(g, at, work, bounded, row, i, k, over, slope, mu, d)
                if turning and own_slot(g, STEER) >= 0:
                    bar += steering_adjoint(g, game, agents, at, work, path, controls, directions, i, u, k, 0)
                by.controls[u] = by.controls[u] + bar
        sync()

    return SimpleNamespace(
        motion_adjoint=motion_adjoint,
        control_adjoint=control_adjoint,
    )
