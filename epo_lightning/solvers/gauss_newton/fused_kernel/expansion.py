"""Costs of all states and controls with their first and second derivatives (Gauss-Newton); as in `kernel/step.hpp`.

Threads share out pairs and agents at all times, so that the recursion of `recursion.py` finds its whole problem ready.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game.features import WHEELBASE
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
from epo_lightning.solvers.gauss_newton.fused_kernel.layout import CONTROL_ITEMS, PAIR_ROWS
from epo_lightning.solvers.gauss_newton.structured import LEAST_RAISED_DAMPING


@no_type_check
def make(
    T: Any,
    threads: SimpleNamespace,
    games: SimpleNamespace,
    residuals: SimpleNamespace,
    pairs: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    evaluate_pair = pairs.evaluate
    sync, lane = threads.sync, threads.lane
    excess, excess_slope, add_residual, steering = (
        residuals.excess,
        residuals.excess_slope,
        residuals.add_residual,
        residuals.steering,
    )
    Game, Layout, pair_index, pair_first, weight, trace = (
        games.Game,
        games.Layout,
        games.pair_index,
        games.pair_first,
        games.weight,
        games.trace,
    )
    own_slot, pair_feature, pair_count, margin_slot = (
        games.own_slot,
        games.pair_feature,
        games.pair_count,
        games.margin_slot,
    )
    Array, Numbers, A = games.Array, games.Numbers, games.agents
    P = A * (A - 1) // 2
    wide = 4 * A  # columns of the Hessian of a state's costs; its gradient is one more row
    four = wp.types.vector(4, T)
    block = wp.types.matrix((4, 4), T)

    # ---- Pairs

    @func
    def expand_pairs(g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, end: int, curved: int):
        """The rows and energies of all pairs and, if ``curved``, their blocks of the Hessians."""
        all_pairs = (g.N * (g.N - 1)) // 2
        for e in range(lane(), end * P, wp.block_dim()):
            k = e // P
            p = e - k * P
            state = k + 1
            i = pair_first(p, A)
            j = p - pair_index(i, i + 1, A) + i + 1
            energy = T(0.0)
            cross = block(T(0.0))
            for slot in range(pair_count(g)):
                first = four(T(0.0))
                second = four(T(0.0))
                pushed = T(0.0)
                if j < n and state % g.pair_stride == 0:
                    one = 2 * ((game // g.M) * g.N + agents[i])
                    other = 2 * ((game // g.M) * g.N + agents[j])
                    place = game * all_pairs + pair_index(agents[i], agents[j], g.N)
                    w = g.pair[slot * g.G * all_pairs + place]
                    margin = T(0.0)
                    if margin_slot(g, slot) >= 0:
                        margin = g.margins[margin_slot(g, slot) * g.G * all_pairs + place]
                    value, x, y, turn1, faster1, turn2, faster2, by_margin = evaluate_pair(
                        pair_feature(g, slot),
                        work[trace(at, g.K, X, i) + state],
                        work[trace(at, g.K, Y, i) + state],
                        work[trace(at, g.K, COSINE, i) + state],
                        work[trace(at, g.K, SINE, i) + state],
                        work[trace(at, g.K, SPEED, i) + state],
                        g.size[one],
                        g.size[one + 1],
                        work[trace(at, g.K, X, j) + state],
                        work[trace(at, g.K, Y, j) + state],
                        work[trace(at, g.K, COSINE, j) + state],
                        work[trace(at, g.K, SINE, j) + state],
                        work[trace(at, g.K, SPEED, j) + state],
                        g.size[other],
                        g.size[other + 1],
                        margin,
                    )
                    first = w * four(x, y, turn1, faster1)
                    second = w * four(-x, -y, turn2, faster2)
                    pushed = w * value
                energy += T(0.5) * pushed * pushed
                cross += wp.outer(first, second)
                row = at.rows + (slot * g.K + k) * PAIR_ROWS * P + p
                for q in range(4):
                    work[row + q * P] = first[q]
                    work[row + (4 + q) * P] = second[q]
                work[row + 8 * P] = pushed
            work[at.energy + (A + p) * g.K + k] = energy
            if curved == 1:
                whole = at.hessian + k * (wide + 1) * wide
                for q in range(4):
                    for r in range(4):
                        work[whole + (4 * i + q) * wide + 4 * j + r] = cross[q, r]
                        work[whole + (4 * j + r) * wide + 4 * i + q] = cross[q, r]
        sync()

    # ---- Agents

    @wp.func
    def motion(g: Game, at: Layout, work: Array, i: int, k: int):
        """Derivatives of the position after a step by heading (x, y) and by speed (x, y)."""
        s = work[trace(at, g.K, SINE, i) + k]
        c = work[trace(at, g.K, COSINE, i) + k]
        along = g.dt * work[trace(at, g.K, SPEED, i) + k]
        return four(-along * s, along * c, g.dt * c, g.dt * s)

    @func
    def set_motions(g: Game, n: int, at: Layout, work: Array, end: int):
        """The motions of the positions of all agents at all steps."""
        for e in range(lane(), end * A, wp.block_dim()):
            k = e // A
            i = e - k * A
            moved = four(T(0.0))
            if i < n:
                moved = motion(g, at, work, i, k)
            for q in range(4):
                work[at.control + (k * CONTROL_ITEMS + MOTION + q) * A + i] = moved[q]
        sync()

    @wp.func
    def rate_costs(g: Game, channel: int, row: int, u: int, k: int, value: T, controls: Array):
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
                energy, force, stiffness = add_residual(weight(g, rate, row), change, T(1.0), energy, force, stiffness)
            if own_slot(g, rate_bounded) >= 0:
                signal = wp.where(turning, BOUND_TURNACC, BOUND_JERK)
                energy, force, stiffness = add_residual(
                    weight(g, rate_bounded, row),
                    excess(g, signal, change),
                    excess_slope(g, signal, change),
                    energy,
                    force,
                    stiffness,
                )
        return energy, force * (T(1.0) / g.dt), stiffness * (T(1.0) / (g.dt * g.dt))

    @wp.func
    def control_costs(g: Game, channel: int, row: int, u: int, value: T):
        """Energy, first and second derivative by a control, without those of its change."""
        turning = channel == TURN_RATE
        plain = wp.where(turning, TURNR, ACC)
        bounded = wp.where(turning, TURNRB, ACCB)
        referring = wp.where(turning, TURNRREF, ACCREF)
        energy = T(0.0)
        force = T(0.0)
        stiffness = T(0.0)
        if own_slot(g, plain) >= 0:
            energy, force, stiffness = add_residual(weight(g, plain, row), value, T(1.0), energy, force, stiffness)
        if own_slot(g, referring) >= 0:
            off = value - g.reference_controls[u]
            energy, force, stiffness = add_residual(weight(g, referring, row), off, T(1.0), energy, force, stiffness)
        if own_slot(g, bounded) >= 0:
            signal = wp.where(turning, BOUND_TURNR, BOUND_ACC)
            energy, force, stiffness = add_residual(
                weight(g, bounded, row),
                excess(g, signal, value),
                excess_slope(g, signal, value),
                energy,
                force,
                stiffness,
            )
        return energy, force, stiffness

    @func
    def expand_controls(
        g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, controls: Array, end: int
    ):
        """Derivatives by the controls of all steps; those of absent agents are inert."""
        for e in range(lane(), end * A, wp.block_dim()):
            k = e // A
            i = e - k * A
            item = at.control + k * CONTROL_ITEMS * A + i
            energy = T(0.0)
            coupling = T(0.0)
            if i < n:
                row = game * g.N + agents[i]
                speed = work[trace(at, g.K, SPEED, i) + k]
                for channel in range(2):
                    u = row * g.K * 2 + 2 * k + channel
                    value = controls[u]
                    turning = channel == TURN_RATE
                    each, force, stiffness = control_costs(g, channel, row, u, value)
                    rate_energy, rate_force, rate_stiffness = rate_costs(g, channel, row, u, k, value, controls)
                    energy += each + rate_energy
                    if turning and own_slot(g, STEER) >= 0:
                        wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
                        angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(wheelbase, value, speed)
                        w = weight(g, STEER, row)
                        energy += T(0.5) * w * w * angle * angle
                        force += w * w * angle * by_turn
                        stiffness += w * w * by_turn * by_turn
                        coupling = w * w * by_turn * by_speed
                    at_channel = item + wp.where(turning, 0, A)
                    work[at_channel + PULL * A] = force + rate_force
                    work[at_channel + RATE * A] = rate_force
                    work[at_channel + DAMPED_STIFFNESS * A] = stiffness + rate_stiffness + g.damping[row]
                    work[at_channel + RATE_STIFFNESS * A] = rate_stiffness
            else:
                for q in range(COUPLING):
                    work[item + q * A] = T(0.0)
                work[item + DAMPED_STIFFNESS * A] = T(1.0)
                work[item + (DAMPED_STIFFNESS + 1) * A] = T(1.0)
            work[item + COUPLING * A] = coupling
            work[at.energy + i * g.K + k] = energy
        sync()

    @wp.func
    def raise_damping(g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, end: int, more: T):
        """Adds a multiple of the damping, for another factorisation."""
        for e in range(lane(), end * n, wp.block_dim()):
            k = e // n
            i = e - k * n
            item = at.control + k * CONTROL_ITEMS * A + i + DAMPED_STIFFNESS * A
            extra = more * wp.max(g.damping[game * g.N + agents[i]], T(LEAST_RAISED_DAMPING))
            work[item] = work[item] + extra
            work[item + A] = work[item + A] + extra
        sync()

    @func
    def expand_states(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        nearest: Array,
        controls: Array,
        end: int,
        curved: int,
    ):
        """Gradients and, if ``curved``, the agents' own blocks of the Hessians; reads the rows of the pairs.

        The steering angle of a step depends on the speed of the state before it, and counts there for the derivatives by
        that speed.
        """
        each = n * (g.K + 1)
        for e in range(lane(), end * A, wp.block_dim()):
            k = e // A
            i = e - k * A
            state = k + 1
            force = four(T(0.0))
            own = block(T(0.0))
            energy = T(0.0)
            if i < n:
                row = game * g.N + agents[i]
                v = work[trace(at, g.K, SPEED, i) + state]
                push = T(0.0)
                stiffness = T(0.0)
                if own_slot(g, VEL) >= 0:
                    energy, push, stiffness = add_residual(weight(g, VEL, row), v, T(1.0), energy, push, stiffness)
                if own_slot(g, VELREF) >= 0:
                    apart = v - g.speeds[(game // g.M) * g.N + agents[i]]
                    energy, push, stiffness = add_residual(
                        weight(g, VELREF, row), apart, T(1.0), energy, push, stiffness
                    )
                if own_slot(g, VELB) >= 0:
                    over = excess(g, BOUND_VEL, v)
                    slope = excess_slope(g, BOUND_VEL, v)
                    energy, push, stiffness = add_residual(weight(g, VELB, row), over, slope, energy, push, stiffness)
                if own_slot(g, STEER) >= 0 and state < end:
                    wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
                    turn = controls[row * g.K * 2 + 2 * state + TURN_RATE]
                    angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(wheelbase, turn, v)
                    w = weight(g, STEER, row)
                    push += w * w * angle * by_speed
                    stiffness += w * w * by_speed * by_speed
                heading_push = T(0.0)
                heading_stiffness = T(0.0)
                px = work[trace(at, g.K, X, i) + state]
                py = work[trace(at, g.K, Y, i) + state]
                fx = T(0.0)
                fy = T(0.0)
                xx = T(0.0)
                xy = T(0.0)
                yy = T(0.0)
                if own_slot(g, LANE) >= 0 and agents[g.N + i] >= 0:
                    w = weight(g, LANE, row)
                    place = i * (g.K + 1) + state
                    energy, fx, xx = add_residual(w, px - nearest[NEAR_X * each + place], T(1.0), energy, fx, xx)
                    energy, fy, yy = add_residual(w, py - nearest[NEAR_Y * each + place], T(1.0), energy, fy, yy)
                    if g.slides == 1:  # the nearest point of the line moves with the agent
                        tx = w * nearest[AHEAD_X * each + place]
                        ty = w * nearest[AHEAD_Y * each + place]
                        xx -= tx * tx
                        xy -= tx * ty
                        yy -= ty * ty
                if state == end:
                    if own_slot(g, HEADING) >= 0:
                        off = work[trace(at, g.K, TURNED, i) + state] - g.headings[row]
                        energy, heading_push, heading_stiffness = add_residual(
                            weight(g, HEADING, row), off, T(1.0), energy, heading_push, heading_stiffness
                        )
                    if own_slot(g, GOAL) >= 0:
                        w = weight(g, GOAL, row)
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
                            at_pair = at.rows + (f * g.K + k) * PAIR_ROWS * P + pair
                            side = wp.where(other < i, 4 * P, 0)
                            here = four(
                                work[at_pair + side],
                                work[at_pair + side + P],
                                work[at_pair + side + 2 * P],
                                work[at_pair + side + 3 * P],
                            )
                            force += work[at_pair + 8 * P] * here
                            if curved == 1:
                                own += wp.outer(here, here)
            whole = at.hessian + k * (wide + 1) * wide + 4 * i
            for q in range(4):
                work[whole + wide * wide + q] = force[q]
                if curved == 1:
                    for r in range(4):
                        work[whole + (4 * i + q) * wide + r] = own[q, r]
            work[at.energy + i * g.K + k] = work[at.energy + i * g.K + k] + energy
        sync()

    return SimpleNamespace(
        set_motions=set_motions,
        expand_pairs=expand_pairs,
        expand_controls=expand_controls,
        raise_damping=raise_damping,
        expand_states=expand_states,
    )
