"""Pair features of the states of two agents with their gradients, for plain and for dual numbers; as in `kernel/pairs.hpp`.

Every feature is written once. With plain numbers it gives the value and the gradient; with dual numbers (vectors of a value
and its derivatives along two directions) also their derivatives along these directions, which the adjoint needs.

A feature returns its value and its derivatives by x and y of the first agent (those by the second are the negatives), by
heading and speed of the first and of the second agent, and by the margin; all are zero where the feature is not active.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game import circles as rows
from epo_lightning.game import vehicles
from epo_lightning.solvers.gauss_newton.kernel.interface import PAIR

CLEARANCE, CIRCLES, HEADWAY, LATERAL, CONFLICT = (
    PAIR.index(name) for name in ("clearance", "circles", "headway", "lateral", "time_to_conflict")
)


@no_type_check
def make(T: Any, func: Any) -> SimpleNamespace:
    """The function ``evaluate``, decorated by ``func``, for plain and dual numbers of type ``T``, and the type ``dual``."""
    dual = wp.types.vector(3, T)
    root_half = 0.5**0.5

    @wp.func
    def mul(x: T, y: T):
        return x * y

    @wp.func
    def mul(x: dual, y: dual):
        return dual(x[0] * y[0], x[0] * y[1] + x[1] * y[0], x[0] * y[2] + x[2] * y[0])

    @wp.func
    def inv(x: T):
        return T(1.0) / x

    @wp.func
    def inv(x: dual):
        r = T(1.0) / x[0]
        slope = -r * r
        return dual(r, slope * x[1], slope * x[2])

    @wp.func
    def root(x: T):
        return wp.sqrt(x)

    @wp.func
    def root(x: dual):
        r = wp.sqrt(x[0])
        slope = T(0.5) / r
        return dual(r, slope * x[1], slope * x[2])

    @wp.func
    def val(x: T):
        return x

    @wp.func
    def val(x: dual):
        return x[0]

    @wp.func
    def lift(like: T, value: T):
        return value

    @wp.func
    def lift(like: dual, value: T):
        return dual(value, T(0.0), T(0.0))

    @wp.func
    def discs(px: Any, py: Any, qx: Any, qy: Any, margin: Any, touching: T):
        zero = lift(px, T(0.0))
        one = lift(px, T(1.0))
        dx = px - qx
        dy = py - qy
        squared = mul(dx, dx) + mul(dy, dy)
        apart = val(squared) > T(0.0)
        safe = root(wp.where(apart, squared, one))
        depth = lift(px, touching) + margin - wp.where(apart, safe, zero)
        # The direction between two agents at the same point is undefined: the feature has the gradient zero there.
        scale = wp.where(apart, inv(safe), zero)
        active = val(depth) > T(0.0)
        value = wp.where(active, depth, zero)
        nx = wp.where(active, mul(dx, scale), zero)
        ny = wp.where(active, mul(dy, scale), zero)
        return value, -nx, -ny, zero, zero, zero, zero, wp.where(active, one, zero)

    @wp.func
    def place(slot: int, length: T, width: T):
        end = T(0.5) * (length - width)
        if slot == 0:
            return wp.where(length < T(rows.THREE_FROM), end, T(0.0))
        if slot <= 2:
            between = wp.where(length < T(rows.FIVE_FROM), end, T(0.5) * end)
            return wp.where(slot == 1, between, -between)
        return wp.where(slot == 3, end, -end)

    @wp.func
    def circles(px: Any, py: Any, pc: Any, ps: Any, pl: T, pw: T, qx: Any, qy: Any, qc: Any, qs: Any, ql: T, qw: T):
        zero = lift(px, T(0.0))
        one = lift(px, T(1.0))
        apart_x = val(px) - val(qx)
        apart_y = val(py) - val(qy)
        best = T(wp.inf)
        a = T(0.0)
        b = T(0.0)
        slots = int(5)
        for i in range(slots):
            first = place(i, pl, pw)
            for j in range(slots):
                second = place(j, ql, qw)
                x0 = apart_x + first * val(pc) - second * val(qc)
                y0 = apart_y + first * val(ps) - second * val(qs)
                square = x0 * x0 + y0 * y0
                if square < best:  # the first ones on a tie
                    best = square
                    a = first
                    b = second
        x = px - qx + a * pc - b * qc
        y = py - qy + a * ps - b * qs
        squared = mul(x, x) + mul(y, y)
        separate = val(squared) > T(0.0)
        distance = root(wp.where(separate, squared, one))
        depth = lift(px, T(root_half) * (pw + qw)) - wp.where(separate, distance, zero)
        scale = wp.where(separate, inv(distance), zero)
        active = val(depth) > T(0.0)
        value = wp.where(active, depth, zero)
        nx = wp.where(active, mul(x, scale), zero)
        ny = wp.where(active, mul(y, scale), zero)
        turn1 = a * (mul(nx, ps) - mul(ny, pc))
        turn2 = b * (mul(ny, qc) - mul(nx, qs))
        return value, -nx, -ny, turn1, zero, turn2, zero, zero

    @wp.func
    def boxes(
        feature: int,
        px: Any,
        py: Any,
        pc: Any,
        ps: Any,
        pv: Any,
        pl: T,
        pw: T,
        qx: Any,
        qy: Any,
        qc: Any,
        qs: Any,
        qv: Any,
        ql: T,
        qw: T,
        margin: Any,
    ):
        zero = lift(px, T(0.0))
        one = lift(px, T(1.0))
        half = T(0.5)
        across_lanes = feature == LATERAL
        follows = feature == HEADWAY
        gap = wp.where(follows, T(vehicles.TIME_GAP), T(0.0))
        length = half * (pl + ql)
        width = half * (pw + qw)
        cosine = mul(pc, qc) + mul(ps, qs)
        sine = mul(ps, qc) - mul(pc, qs)
        sign = wp.where(val(cosine) < T(0.0), T(-1.0), T(1.0))
        aligned = sign * cosine
        scale = inv(root(T(2.0) * (aligned + one)))
        ex = mul(pc + sign * qc, scale)
        ey = mul(ps + sign * qs, scale)
        dx = px - qx
        dy = py - qy
        along = mul(ex, dx) + mul(ey, dy)
        across = mul(ex, dy) - mul(ey, dx)
        main = wp.where(across_lanes, across, along)
        other = wp.where(across_lanes, along, across)
        extent = wp.where(across_lanes, width, length)
        side = wp.where(across_lanes, length, width)
        # The speed of the agent behind, and the share of the first agent in it.
        per_length = T(1.0) / wp.max(length, T(vehicles.LEAST_SIZE))
        raw = lift(px, half) - (half * per_length) * along
        above = val(raw) > T(0.0)
        inside = above and val(raw) < T(1.0)
        share = wp.where(inside, raw, wp.where(above, one, zero))
        blending = wp.where(inside, gap * half * per_length, T(0.0))
        apart = pv - qv
        rear = qv + mul(share, apart)
        at = val(main)
        direction = wp.where(at > T(0.0), T(1.0), wp.where(at < T(0.0), T(-1.0), T(0.0)))
        room = margin + lift(px, extent) - direction * main + gap * rear
        per_side = T(1.0) / wp.max(side, T(vehicles.LEAST_SIZE))
        ratio = per_side * other
        rest = one - mul(ratio, ratio)
        window = mul(rest, rest)
        active = val(room) > T(0.0) and val(rest) > T(0.0) and (not follows or val(cosine) > T(0.0))
        weighed = mul(aligned, window)
        by_main = -direction * weighed - blending * mul(weighed, apart)
        by_other = (T(-4.0) * per_side) * mul(mul(mul(aligned, room), rest), ratio)
        by_cosine = sign * mul(window, room)
        by_along = wp.where(across_lanes, by_other, by_main)
        by_across = wp.where(across_lanes, by_main, by_other)
        by_x = mul(by_along, ex) - mul(by_across, ey)
        by_y = mul(by_along, ey) + mul(by_across, ex)
        turned = half * (mul(by_along, across) - mul(by_across, along))
        spread = mul(by_cosine, sine)
        faster = gap * mul(weighed, share)
        if not active:
            return zero, zero, zero, zero, zero, zero, zero, zero
        return mul(weighed, room), by_x, by_y, turned - spread, faster, turned + spread, gap * weighed - faster, weighed

    @wp.func
    def conflict(
        px: Any,
        py: Any,
        pc: Any,
        ps: Any,
        pv: Any,
        pw: T,
        qx: Any,
        qy: Any,
        qc: Any,
        qs: Any,
        qv: Any,
        qw: T,
        margin: Any,
    ):
        zero = lift(px, T(0.0))
        one = lift(px, T(1.0))
        limit = T(vehicles.CONFLICT_TIME)
        dx = px - qx
        dy = py - qy
        vx = mul(pv, pc) - mul(qv, qc)
        vy = mul(pv, ps) - mul(qv, qs)
        per_square = inv(mul(vx, vx) + mul(vy, vy) + lift(px, T(vehicles.SLOW)))
        raw = -mul(mul(dx, vx) + mul(dy, vy), per_square)
        above = val(raw) > T(0.0)
        moving = above and val(raw) < limit
        time = wp.where(moving, raw, wp.where(above, lift(px, limit), zero))
        x = dx + mul(time, vx)
        y = dy + mul(time, vy)
        squared = mul(x, x) + mul(y, y)
        separate = val(squared) > T(0.0)
        distance = root(wp.where(separate, squared, one))
        scale = wp.where(separate, inv(distance), zero)
        nx = mul(x, scale)
        ny = mul(y, scale)
        room = margin + lift(px, T(0.5) * (pw + qw)) - wp.where(separate, distance, zero)
        soon = one - (T(1.0) / limit) * time
        active = val(room) > T(0.0) and val(soon) > T(0.0)
        # Derivatives by the time of the closest approach, of that time by offset and velocity, and then of the feature.
        by_time = wp.where(moving, -mul(soon, mul(nx, vx) + mul(ny, vy)) - (T(1.0) / limit) * room, zero)
        step = -mul(by_time, per_square)
        by_x = mul(step, vx) - mul(soon, nx)
        by_y = mul(step, vy) - mul(soon, ny)
        by_vx = mul(step, dx + T(2.0) * mul(time, vx)) - mul(mul(soon, nx), time)
        by_vy = mul(step, dy + T(2.0) * mul(time, vy)) - mul(mul(soon, ny), time)
        turn1 = mul(pv, mul(by_vy, pc) - mul(by_vx, ps))
        turn2 = mul(qv, mul(by_vx, qs) - mul(by_vy, qc))
        faster1 = mul(by_vx, pc) + mul(by_vy, ps)
        faster2 = -(mul(by_vx, qc) + mul(by_vy, qs))
        if not active:
            return zero, zero, zero, zero, zero, zero, zero, zero
        return mul(soon, room), by_x, by_y, turn1, faster1, turn2, faster2, soon

    @func
    def evaluate(
        feature: int,
        px: Any,
        py: Any,
        pc: Any,
        ps: Any,
        pv: Any,
        pl: T,
        pw: T,
        qx: Any,
        qy: Any,
        qc: Any,
        qs: Any,
        qv: Any,
        ql: T,
        qw: T,
        margin: Any,
    ):
        value, x, y, turn1, faster1, turn2, faster2, by_margin = discs(
            px, py, qx, qy, margin, T(0.5) * pl + T(0.5) * ql
        )
        if feature == CIRCLES:
            value, x, y, turn1, faster1, turn2, faster2, by_margin = circles(
                px, py, pc, ps, pl, pw, qx, qy, qc, qs, ql, qw
            )
        if feature > CIRCLES and feature < CONFLICT:
            value, x, y, turn1, faster1, turn2, faster2, by_margin = boxes(
                feature, px, py, pc, ps, pv, pl, pw, qx, qy, qc, qs, qv, ql, qw, margin
            )
        if feature == CONFLICT:
            value, x, y, turn1, faster1, turn2, faster2, by_margin = conflict(
                px, py, pc, ps, pv, pw, qx, qy, qc, qs, qv, qw, margin
            )
        return value, x, y, turn1, faster1, turn2, faster2, by_margin

    return SimpleNamespace(evaluate=evaluate, dual=dual)
