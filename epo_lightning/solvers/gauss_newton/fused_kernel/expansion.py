"""Costs of states and controls with their first and second derivatives (Gauss-Newton); as in `kernel/step.hpp`.

Threads share out the agents of some steps, those from ``first`` on to ``last`` - 1, whose derivatives are then in fast
memory (`places.py`) for the recursion of `recursion.py`. The costs of pairs are in `pair_expansion.py`.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game.features import WHEELBASE
from epo_lightning.solvers.gauss_newton.backends.pytorch import LEAST_RAISED_DAMPING
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import (
    ACC,
    ACCB,
    ACCREF,
    AHEAD_X,
    AHEAD_Y,
    BOUND_ACC,
    BOUND_JERK,
    BOUND_TURNACC,
    BOUND_TURNR,
    BOUND_VEL,
    COSINE,
    COUPLING,
    DAMPED_STIFFNESS,
    GOAL,
    HEADING,
    JERK,
    JERKB,
    LANE,
    MOTION,
    NEAR_X,
    NEAR_Y,
    PULL,
    RATE,
    RATE_STIFFNESS,
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
from epo_lightning.solvers.gauss_newton.fused_kernel.layout import Fast


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    residuals: SimpleNamespace,
    trajectories: SimpleNamespace,
    places: SimpleNamespace,
    fast: Fast,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``, with fast memory for ``fast``; ``func`` decorates the longer ones."""
    sync, lane, put, trace = threads.sync, threads.lane, threads.put, trajectories.trace
    excess, excess_slope, add_residual, steering = (
        residuals.excess,
        residuals.excess_slope,
        residuals.add_residual,
        residuals.steering,
    )
    Game, Layout, pair_index, nearest_point = games.Game, games.Layout, games.pair_index, games.nearest_point
    own_slot, pair_count, horizon = games.own_slot, games.pair_count, games.horizon
    control_items, row_place, value_place, weight = (
        places.control_items,
        places.row_place,
        places.value_place,
        places.weight,
    )
    own_place = fast.own
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    four = wp.types.vector(4, T)
    block = wp.types.matrix((4, 4), T)

    @wp.func
    def motion(g: Game, at: Layout, path: Array, i: int, k: int):
        """Derivatives of the position after a step by heading (x, y) and by speed (x, y)."""
        K = horizon(g)
        s = path[trace(at, K, SINE, i) + k]
        c = path[trace(at, K, COSINE, i) + k]
        along = g.dt * path[trace(at, K, SPEED, i) + k]
        return four(-along * s, along * c, g.dt * c, g.dt * s)

    @wp.func
    def rate_costs(g: Game, costs: Array, channel: int, i: int, u: int, k: int, value: T, controls: Array):
        """Energy, first and second derivative by the change of a control since the step before, which has none at first."""
        energy = T(0.0)
        force = T(0.0)
        stiffness = T(0.0)
        if k > 0:
            turning = channel == TURN_RATE
            change = (value - controls[u - 2]) * (T(1.0) / g.dt)
            rate = wp.where(turning, TURNACC, JERK)
            rate_bounded = wp.where(turning, TURNACCB, JERKB)
            if own_slot(g, rate) >= 0:
                energy, force, stiffness = add_residual(
                    weight(g, costs, rate, i), change, T(1.0), energy, force, stiffness
                )
            if own_slot(g, rate_bounded) >= 0:
                signal = wp.where(turning, BOUND_TURNACC, BOUND_JERK)
                energy, force, stiffness = add_residual(
                    weight(g, costs, rate_bounded, i),
                    excess(g, signal, change),
                    excess_slope(g, signal, change),
                    energy,
                    force,
                    stiffness,
                )
        return energy, force * (T(1.0) / g.dt), stiffness * (T(1.0) / (g.dt * g.dt))

    @wp.func
    def control_costs(g: Game, costs: Array, channel: int, i: int, u: int, value: T):
        """Energy, first and second derivative by a control, without those of its change."""
        turning = channel == TURN_RATE
        plain = wp.where(turning, TURNR, ACC)
        bounded = wp.where(turning, TURNRB, ACCB)
        referring = wp.where(turning, TURNRREF, ACCREF)
        energy = T(0.0)
        force = T(0.0)
        stiffness = T(0.0)
        if own_slot(g, plain) >= 0:
            energy, force, stiffness = add_residual(weight(g, costs, plain, i), value, T(1.0), energy, force, stiffness)
        if own_slot(g, referring) >= 0:
            off = value - g.reference_controls[u]
            energy, force, stiffness = add_residual(
                weight(g, costs, referring, i), off, T(1.0), energy, force, stiffness
            )
        if own_slot(g, bounded) >= 0:
            signal = wp.where(turning, BOUND_TURNR, BOUND_ACC)
            energy, force, stiffness = add_residual(
                weight(g, costs, bounded, i),
                excess(g, signal, value),
                excess_slope(g, signal, value),
                energy,
                force,
                stiffness,
            )
        return energy, force, stiffness

    @func
    def expand_controls(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        costs: Array,
        controls: Array,
        first: int,
        last: int,
        raised: T,
    ):
        """Derivatives by controls, and the motions of positions; those of absent agents are inert.

        The damping is added to the second derivatives, with ``raised`` times more of it.
        """
        K = horizon(g)
        for e in range(lane(), (last - first) * A, wp.block_dim()):
            step = e // A
            k = first + step
            i = e - step * A
            item = control_items(k) + i
            energy = T(0.0)
            coupling = T(0.0)
            moved = four(T(0.0))
            if i < n:
                row = game * g.N + agents[i]
                moved = motion(g, at, path, i, k)
                damping = g.damping[game * g.damping_of_game + agents[i] * g.damping_of_agent]
                if raised > T(0.0):
                    damping += raised * wp.max(damping, T(LEAST_RAISED_DAMPING))
                speed = path[trace(at, K, SPEED, i) + k]
                for channel in range(2):
                    u = row * K * 2 + 2 * k + channel
                    value = controls[u]
                    turning = channel == TURN_RATE
                    each, force, stiffness = control_costs(g, costs, channel, i, u, value)
                    rate_energy, rate_force, rate_stiffness = rate_costs(g, costs, channel, i, u, k, value, controls)
                    energy += each + rate_energy
                    if turning and own_slot(g, STEER) >= 0:
                        wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
                        angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(wheelbase, value, speed)
                        w = weight(g, costs, STEER, i)
                        energy += T(0.5) * w * w * angle * angle
                        force += w * w * angle * by_turn
                        stiffness += w * w * by_turn * by_turn
                        coupling = w * w * by_turn * by_speed
                    at_channel = item + wp.where(turning, 0, A)
                    costs[at_channel + PULL * A] = force + rate_force
                    costs[at_channel + RATE * A] = rate_force
                    costs[at_channel + DAMPED_STIFFNESS * A] = stiffness + rate_stiffness + damping
                    costs[at_channel + RATE_STIFFNESS * A] = rate_stiffness
            else:
                for q in range(COUPLING):
                    costs[item + q * A] = T(0.0)
                costs[item + DAMPED_STIFFNESS * A] = T(1.0)
                costs[item + (DAMPED_STIFFNESS + 1) * A] = T(1.0)
            costs[item + COUPLING * A] = coupling
            for q in range(4):
                costs[item + (MOTION + q) * A] = moved[q]
            work[at.energy + i * K + k] = energy

    @func
    def expand_states(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        path: Array,
        costs: Array,
        nearest: Array,
        controls: Array,
        first: int,
        last: int,
        end: int,
        curved: int,
        keep: int,
    ):
        """Gradients and, if ``curved``, the agents' own blocks of the Hessians; reads the rows of the pairs.

        The nearest points of the lines [4, n, K + 1] and the tangents there go to ``nearest`` if ``keep``.

        The steering angle of a step depends on the speed of the state before it, and counts there for the derivatives by
        that speed.
        """
        K = horizon(g)
        each = n * (K + 1)
        for e in range(lane(), (last - first) * A, wp.block_dim()):
            step = e // A
            k = first + step
            i = e - step * A
            state = k + 1
            force = four(T(0.0))
            own = block(T(0.0))
            energy = T(0.0)
            if i < n:
                row = game * g.N + agents[i]
                v = path[trace(at, K, SPEED, i) + state]
                push = T(0.0)
                stiffness = T(0.0)
                if own_slot(g, VEL) >= 0:
                    energy, push, stiffness = add_residual(weight(g, costs, VEL, i), v, T(1.0), energy, push, stiffness)
                if own_slot(g, VELREF) >= 0:
                    apart = v - g.speeds[(game // g.M) * g.N + agents[i]]
                    energy, push, stiffness = add_residual(
                        weight(g, costs, VELREF, i), apart, T(1.0), energy, push, stiffness
                    )
                if own_slot(g, VELB) >= 0:
                    over = excess(g, BOUND_VEL, v)
                    slope = excess_slope(g, BOUND_VEL, v)
                    energy, push, stiffness = add_residual(
                        weight(g, costs, VELB, i), over, slope, energy, push, stiffness
                    )
                if own_slot(g, STEER) >= 0 and state < end:
                    wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
                    turn = controls[row * K * 2 + 2 * state + TURN_RATE]
                    angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(wheelbase, turn, v)
                    w = weight(g, costs, STEER, i)
                    push += w * w * angle * by_speed
                    stiffness += w * w * by_speed * by_speed
                heading_push = T(0.0)
                heading_stiffness = T(0.0)
                px = path[trace(at, K, X, i) + state]
                py = path[trace(at, K, Y, i) + state]
                fx = T(0.0)
                fy = T(0.0)
                xx = T(0.0)
                xy = T(0.0)
                yy = T(0.0)
                if own_slot(g, LANE) >= 0:
                    near_x, near_y, ahead_x, ahead_y = nearest_point(g, agents[g.N + i], px, py)
                    if agents[g.N + i] >= 0:
                        w = weight(g, costs, LANE, i)
                        energy, fx, xx = add_residual(w, px - near_x, T(1.0), energy, fx, xx)
                        energy, fy, yy = add_residual(w, py - near_y, T(1.0), energy, fy, yy)
                        if g.slides == 1:  # the nearest point of the line moves with the agent
                            tx = w * ahead_x
                            ty = w * ahead_y
                            xx -= tx * tx
                            xy -= tx * ty
                            yy -= ty * ty
                    if keep == 1:
                        place = i * (K + 1) + state
                        nearest[NEAR_X * each + place] = near_x
                        nearest[NEAR_Y * each + place] = near_y
                        nearest[AHEAD_X * each + place] = ahead_x
                        nearest[AHEAD_Y * each + place] = ahead_y
                if state == end:
                    if own_slot(g, HEADING) >= 0:
                        off = path[trace(at, K, TURNED, i) + state] - g.goal_headings[row]
                        energy, heading_push, heading_stiffness = add_residual(
                            weight(g, costs, HEADING, i), off, T(1.0), energy, heading_push, heading_stiffness
                        )
                    if own_slot(g, GOAL) >= 0:
                        w = weight(g, costs, GOAL, i)
                        energy, fx, xx = add_residual(w, px - g.goals[2 * row], T(1.0), energy, fx, xx)
                        energy, fy, yy = add_residual(w, py - g.goals[2 * row + 1], T(1.0), energy, fy, yy)
                force = four(fx, fy, heading_push, push)
                own[0, 0] = xx
                own[0, 1] = xy
                own[1, 0] = xy
                own[1, 1] = yy
                own[2, 2] = heading_stiffness
                own[3, 3] = stiffness
                for f in range(pair_count(g)):
                    for other in range(n):
                        if other != i:
                            pair = pair_index(wp.min(i, other), wp.max(i, other), A)
                            at_row = row_place(f, step, i, other)
                            here = four(costs[at_row], costs[at_row + 1], costs[at_row + 2], costs[at_row + 3])
                            force += costs[value_place(f, step, pair)] * here
                            if curved == 1:
                                own += wp.outer(here, here)
            to = own_place + (step * A + i) * 20 + 16
            put(costs, to, force[0], force[1], force[2], force[3])
            if curved == 1:
                for q in range(4):
                    put(costs, to - 16 + 4 * q, own[q, 0], own[q, 1], own[q, 2], own[q, 3])
            work[at.energy + i * K + k] = work[at.energy + i * K + k] + energy
        sync()

    return SimpleNamespace(expand_controls=expand_controls, expand_states=expand_states)
