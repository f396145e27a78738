"""Costs of states, pairs and controls with their first and second derivatives (Gauss-Newton); as in `kernel/step.hpp`."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game.features import SLOWEST_STEERING, WHEELBASE
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
    T: Any, threads: SimpleNamespace, games: SimpleNamespace, pairs: SimpleNamespace, func: Any
) -> SimpleNamespace:
    """The functions for numbers of type ``T``; ``func`` decorates the longer ones."""
    evaluate_pair = pairs.evaluate
    sync, lane = threads.sync, threads.lane
    Game, Layout, pair_index, pair_first, weight, trace = (
        games.Game,
        games.Layout,
        games.pair_index,
        games.pair_first,
        games.weight,
        games.trace,
    )
    set_motions, Array, Numbers = games.set_motions, games.Array, games.Numbers

    @wp.func
    def excess(g: Game, signal: int, value: T):
        low = g.bounds[2 * signal]
        high = g.bounds[2 * signal + 1]
        return wp.max(value - high, T(0.0)) + wp.max(low - value, T(0.0))

    @wp.func
    def excess_slope(g: Game, signal: int, value: T):
        low = g.bounds[2 * signal]
        high = g.bounds[2 * signal + 1]
        return wp.where(value > high, T(1.0), T(0.0)) - wp.where(value < low, T(1.0), T(0.0))

    @wp.func
    def add(w: T, value: T, slope: T, energy: T, force: T, stiffness: T):
        """Energy, first and second derivative with those of another residual of the same signal."""
        square = w * w
        return (
            energy + T(0.5) * square * value * value,
            force + square * slope * value,
            stiffness + square * slope * slope,
        )

    @func
    def state_costs(
        g: Game,
        game: int,
        n: int,
        agents: Numbers,
        at: Layout,
        work: Array,
        nearest: Array,
        fast: Array,
        state: int,
        end: int,
        curved: int,
    ):
        """Adds the costs of a state to energy and y and, if ``curved``, to P."""
        m = 2 * n
        ld = 3 * m
        each = n * (g.K + 1)
        for i in range(lane(), n, wp.block_dim()):
            row = game * g.N + agents[i]
            v = work[trace(at, n, g.K, SPEED, i) + state]
            energy = T(0.0)
            force = T(0.0)
            stiffness = T(0.0)
            if g.own_slot[VEL] >= 0:
                energy, force, stiffness = add(weight(g, VEL, row), v, T(1.0), energy, force, stiffness)
            if g.own_slot[VELREF] >= 0:
                apart = v - g.speeds[(game // g.M) * g.N + agents[i]]
                energy, force, stiffness = add(weight(g, VELREF, row), apart, T(1.0), energy, force, stiffness)
            if g.own_slot[VELB] >= 0:
                over = excess(g, BOUND_VEL, v)
                slope = excess_slope(g, BOUND_VEL, v)
                energy, force, stiffness = add(weight(g, VELB, row), over, slope, energy, force, stiffness)
            r = m + 2 * i + 1
            fast[at.y + r] += force
            if curved == 1:
                fast[r * ld + r] += stiffness
            if g.own_slot[HEADING] >= 0 and state == end:
                off = work[trace(at, n, g.K, TURNED, i) + state] - g.headings[row]
                force = T(0.0)
                stiffness = T(0.0)
                energy, force, stiffness = add(weight(g, HEADING, row), off, T(1.0), energy, force, stiffness)
                fast[at.y + r - 1] += force
                if curved == 1:
                    fast[(r - 1) * ld + r - 1] += stiffness
            px = work[trace(at, n, g.K, X, i) + state]
            py = work[trace(at, n, g.K, Y, i) + state]
            fx = T(0.0)
            fy = T(0.0)
            xx = T(0.0)
            xy = T(0.0)
            yy = T(0.0)
            if g.own_slot[LANE] >= 0 and agents[g.N + i] >= 0:
                w = weight(g, LANE, row)
                place = i * (g.K + 1) + state
                energy, fx, xx = add(w, px - nearest[NEAR_X * each + place], T(1.0), energy, fx, xx)
                energy, fy, yy = add(w, py - nearest[NEAR_Y * each + place], T(1.0), energy, fy, yy)
                if g.slides == 1:  # the nearest point of the line moves with the agent
                    tx = w * nearest[AHEAD_X * each + place]
                    ty = w * nearest[AHEAD_Y * each + place]
                    xx -= tx * tx
                    xy -= tx * ty
                    yy -= ty * ty
            if g.own_slot[GOAL] >= 0 and state == end:
                w = weight(g, GOAL, row)
                energy, fx, xx = add(w, px - g.goals[2 * row], T(1.0), energy, fx, xx)
                energy, fy, yy = add(w, py - g.goals[2 * row + 1], T(1.0), energy, fy, yy)
            fast[at.y + 2 * i] += fx
            fast[at.y + 2 * i + 1] += fy
            if curved == 1:
                fast[2 * i * ld + 2 * i] += xx
                fast[(2 * i + 1) * ld + 2 * i] += xy
                fast[(2 * i + 1) * ld + 2 * i + 1] += yy
            fast[at.energy + 2 * i] += energy
        sync()

    @wp.func
    def entry(i: int, e: int, m: int):
        """Index in P and y of position (e = 0, 1), heading and speed (2, 3) of agent i."""
        if e < 2:
            return 2 * i + e
        return m + 2 * i + e - 2

    @func
    def pair_costs(
        g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, fast: Array, state: int, curved: int
    ):
        """Adds the costs of all pair features at a state: each pair by one thread, then the pairs of each block of P."""
        m = 2 * n
        ld = 3 * m
        count = (n * (n - 1)) // 2
        four = int(4)
        all_pairs = (g.N * (g.N - 1)) // 2
        features = int(PAIRS)  # a variable, or the loops would be unrolled
        if state % g.pair_stride == 0:
            for f in range(features):
                if g.pair_slot[f] >= 0:
                    for p in range(lane(), count, wp.block_dim()):
                        i = pair_first(p, n)
                        j = p - pair_index(i, i + 1, n) + i + 1
                        b = (game // g.M) * g.N
                        place = game * all_pairs + pair_index(agents[i], agents[j], g.N)
                        w = g.pair[g.pair_slot[f] * g.G * all_pairs + place]
                        margin = T(0.0)
                        if g.margin_slot[f] >= 0:
                            margin = g.margins[g.margin_slot[f] * g.G * all_pairs + place]
                        value, x, y, turn1, faster1, turn2, faster2, by_margin = evaluate_pair(
                            f,
                            work[trace(at, n, g.K, X, i) + state],
                            work[trace(at, n, g.K, Y, i) + state],
                            work[trace(at, n, g.K, COSINE, i) + state],
                            work[trace(at, n, g.K, SINE, i) + state],
                            work[trace(at, n, g.K, SPEED, i) + state],
                            g.size[2 * (b + agents[i])],
                            g.size[2 * (b + agents[i]) + 1],
                            work[trace(at, n, g.K, X, j) + state],
                            work[trace(at, n, g.K, Y, j) + state],
                            work[trace(at, n, g.K, COSINE, j) + state],
                            work[trace(at, n, g.K, SINE, j) + state],
                            work[trace(at, n, g.K, SPEED, j) + state],
                            g.size[2 * (b + agents[j])],
                            g.size[2 * (b + agents[j]) + 1],
                            margin,
                        )
                        pushed = w * value
                        fast[at.pair_energy + p] += T(0.5) * pushed * pushed
                        rows = at.rows + 10 * p
                        fast[rows] = w * x
                        fast[rows + 1] = w * y
                        fast[rows + 2] = w * turn1
                        fast[rows + 3] = w * faster1
                        fast[rows + 4] = -w * x
                        fast[rows + 5] = -w * y
                        fast[rows + 6] = w * turn2
                        fast[rows + 7] = w * faster2
                        fast[rows + 8] = pushed
                    sync()
                    for block in range(lane(), n * n, wp.block_dim()):
                        i = block // n
                        j = block - i * n
                        if i == j:
                            for other in range(n):
                                if other != i:
                                    rows = at.rows + 10 * pair_index(wp.min(i, other), wp.max(i, other), n)
                                    side = wp.where(other < i, 4, 0)
                                    for e in range(four):
                                        here = fast[rows + side + e]
                                        fast[at.y + entry(i, e, m)] += fast[rows + 8] * here
                                        if curved == 1:
                                            for f2 in range(e + 1):
                                                fast[entry(i, e, m) * ld + entry(i, f2, m)] += (
                                                    here * fast[rows + side + f2]
                                                )
                        elif j < i and curved == 1:
                            rows = at.rows + 10 * pair_index(j, i, n)
                            for e in range(four):
                                for f2 in range(four):
                                    second = entry(i, e, m)
                                    first = entry(j, f2, m)
                                    fast[wp.max(first, second) * ld + wp.min(first, second)] += (
                                        fast[rows + 4 + e] * fast[rows + f2]
                                    )
                    sync()

    @wp.func
    def steering(wheelbase: T, turn: T, speed: T):
        """The angle atan(q omega), q = wheelbase / max(v, slowest), its first two derivatives, by turn rate and speed."""
        moving = speed > T(SLOWEST_STEERING)
        inverse = T(1.0) / wp.where(moving, speed, T(SLOWEST_STEERING))
        q = wheelbase * inverse
        t = q * turn
        d = T(1.0) / (T(1.0) + t * t)
        turn_turn = T(-2.0) * q * q * t * d * d
        by_speed = wp.where(moving, -t * d * inverse, T(0.0))
        turn_speed = wp.where(moving, q * d * inverse * (T(2.0) * t * t * d - T(1.0)), T(0.0))
        speed_speed = wp.where(moving, T(2.0) * t * d * d * inverse * inverse, T(0.0))
        return wp.atan(t), q * d, by_speed, turn_turn, turn_speed, speed_speed

    @func
    def control_costs(
        g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, fast: Array, controls: Array, k: int
    ):
        """Costs of the controls of step k, of their rates and of the steering angle; also sets Z."""
        for r in range(lane(), 2 * n, wp.block_dim()):
            i = r // 2
            turning = r == 2 * i
            row = game * g.N + agents[i]
            u = row * g.K * 2 + 2 * k + wp.where(turning, TURN_RATE, ACCELERATION)
            value = controls[u]
            plain = wp.where(turning, TURNR, ACC)
            bounded = wp.where(turning, TURNRB, ACCB)
            referring = wp.where(turning, TURNRREF, ACCREF)
            energy = T(0.0)
            force = T(0.0)
            stiffness = T(0.0)
            if g.own_slot[plain] >= 0:
                energy, force, stiffness = add(weight(g, plain, row), value, T(1.0), energy, force, stiffness)
            if g.own_slot[referring] >= 0:
                off = value - g.reference_controls[u]
                energy, force, stiffness = add(weight(g, referring, row), off, T(1.0), energy, force, stiffness)
            if g.own_slot[bounded] >= 0:
                signal = wp.where(turning, BOUND_TURNR, BOUND_ACC)
                energy, force, stiffness = add(
                    weight(g, bounded, row),
                    excess(g, signal, value),
                    excess_slope(g, signal, value),
                    energy,
                    force,
                    stiffness,
                )
            rate_force = T(0.0)
            rate_stiffness = T(0.0)
            if k > 0:
                change = (value - controls[u - 2]) * (T(1.0) / g.dt)
                rate = wp.where(turning, TURNACC, JERK)
                rate_bounded = wp.where(turning, TURNACCB, JERKB)
                if g.own_slot[rate] >= 0:
                    energy, rate_force, rate_stiffness = add(
                        weight(g, rate, row), change, T(1.0), energy, rate_force, rate_stiffness
                    )
                if g.own_slot[rate_bounded] >= 0:
                    signal = wp.where(turning, BOUND_TURNACC, BOUND_JERK)
                    energy, rate_force, rate_stiffness = add(
                        weight(g, rate_bounded, row),
                        excess(g, signal, change),
                        excess_slope(g, signal, change),
                        energy,
                        rate_force,
                        rate_stiffness,
                    )
                rate_force *= T(1.0) / g.dt
                rate_stiffness *= T(1.0) / (g.dt * g.dt)
            if turning:
                speed_pull = T(0.0)
                speed_stiffness = T(0.0)
                coupling = T(0.0)
                if g.own_slot[STEER] >= 0:
                    wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + agents[i])]
                    angle, by_turn, by_speed, turn_turn, turn_speed, speed_speed = steering(
                        wheelbase, value, work[trace(at, n, g.K, SPEED, i) + k]
                    )
                    w = weight(g, STEER, row)
                    square = w * w
                    energy += T(0.5) * square * angle * angle
                    force += square * angle * by_turn
                    stiffness += square * by_turn * by_turn
                    speed_pull = square * angle * by_speed
                    speed_stiffness = square * by_speed * by_speed
                    coupling = square * by_turn * by_speed
                fast[at.speed_pull + i] = speed_pull
                fast[at.speed_stiffness + i] = speed_stiffness
                fast[at.coupling + i] = coupling
            fast[at.pull + r] = force + rate_force
            fast[at.rate_pull + r] = rate_force
            fast[at.damped + r] = stiffness + rate_stiffness
            fast[at.rate_stiffness + r] = rate_stiffness
            fast[at.energy + r] += energy
        set_motions(g, n, at, work, fast, k)
        sync()

    @wp.func
    def forget(n: int, at: Layout, fast: Array, curved: int):
        """Sets y, energies and norms, and if ``curved`` P, to zero."""
        if curved == 1:
            for e in range(lane(), 36 * n * n, wp.block_dim()):
                fast[e] = T(0.0)
        for e in range(lane(), 6 * n, wp.block_dim()):
            fast[at.y + e] = T(0.0)
        for e in range(lane(), 2 * n, wp.block_dim()):
            fast[at.energy + e] = T(0.0)
            fast[at.norm + e] = T(0.0)
        for e in range(lane(), (n * (n - 1)) // 2, wp.block_dim()):
            fast[at.pair_energy + e] = T(0.0)
        sync()

    @wp.func
    def total(n: int, at: Layout, fast: Array):
        """The energy: that of every agent, then that of every pair."""
        energy = T(0.0)
        for r in range(2 * n):
            energy += fast[at.energy + r]
        for p in range((n * (n - 1)) // 2):
            energy += fast[at.pair_energy + p]
        return energy

    return SimpleNamespace(
        excess=excess,
        excess_slope=excess_slope,
        add=add,
        state_costs=state_costs,
        entry=entry,
        pair_costs=pair_costs,
        steering=steering,
        control_costs=control_costs,
        forget=forget,
        total=total,
    )
