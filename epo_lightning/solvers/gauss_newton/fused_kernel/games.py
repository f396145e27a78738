"""The games as the kernels read them, their trajectories, and the nearest points of their reference lines."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import (
    ACCELERATION,
    AHEAD_X,
    AHEAD_Y,
    COSINE,
    LANE,
    NEAR_X,
    NEAR_Y,
    PAIRS,
    SINE,
    SPEED,
    STEER,
    TURN_RATE,
    TURNED,
    X,
    Y,
)
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, SIGNALS


@no_type_check
def make(T: Any, most: int, threads: SimpleNamespace, func: Any) -> SimpleNamespace:
    """Structures and functions for numbers of type ``T``; ``func`` decorates the longer functions.

    Args:
        most: largest number of agents, for which places in fast memory are constants; 0 for any number.
    """
    bytes_each = 8 if T is wp.float64 else 4
    Array = wp.array(dtype=T)
    Numbers = wp.array(dtype=wp.int32)
    OwnSlots = wp.types.vector(len(OWN), wp.int32)
    PairSlots = wp.types.vector(PAIRS, wp.int32)
    Bounds = wp.types.vector(2 * len(SIGNALS), T)
    sync, lane = threads.sync, threads.lane

    @wp.struct
    class Game:
        """Tensors of G = B M games, contiguous. Slots are positions of features in ``own``, ``pair``, ``margins``, or -1."""

        G: int
        M: int
        N: int
        K: int
        lines: int
        points: int
        pair_stride: int
        slides: int
        cut: int
        dt: T
        step_size: T
        own_slot: OwnSlots
        pair_slot: PairSlots
        margin_slot: PairSlots
        bounds: Bounds
        initial: Array
        size: Array
        own: Array
        pair: Array
        margins: Array
        goals: Array
        headings: Array
        references: Array
        speeds: Array
        reference_controls: Array
        damping: Array
        present: wp.array(dtype=wp.uint8)
        exists: wp.array(dtype=wp.uint8)
        reference: wp.array(dtype=wp.int64)
        ends: wp.array(dtype=wp.int64)

    @wp.struct
    class Run:
        """Steps, results and memory. Factors and nearest points are by step and game if recorded, and otherwise by block."""

        steps: int
        record: int
        blocks: int
        start: Array
        iterates: Array
        iterate_stride: wp.int64
        directions: Array
        direction_stride: wp.int64
        states: Array
        initial_energy: Array
        energy: Array
        gradient_norm: Array
        status: wp.array(dtype=wp.int64)
        factors: Array
        nearest: Array
        taken: Numbers
        work: Array
        work_numbers: int
        numbers: Numbers

    @wp.struct
    class Gradients:
        """Cotangents of the states and of all iterates (if not empty), and gradients; ``controls`` is both."""

        along_states: int
        along_iterates: int
        states: Array
        iterates: Array
        controls: Array
        own: Array
        pair: Array
        margins: Array
        goals: Array
        headings: Array
        reference_controls: Array

    @wp.struct
    class Layout:
        """Places in the fast memory of a game (P is at 0), and from ``path`` on in its slow memory."""

        y: int
        damped: int
        pull: int
        rate_pull: int
        rate_stiffness: int
        speed_pull: int
        speed_stiffness: int
        coupling: int
        Z: int
        x: int
        c: int
        L: int
        G: int
        energy: int
        norm: int
        pair_energy: int
        rows: int
        path: int
        h: int
        tangents: int
        mu: int

    @wp.func
    def layout(n: int, K: int):
        at = Layout()
        # With the largest number of agents, the places in fast memory are constants and take no registers.
        size = wp.static(most) if wp.static(most > 0) else n
        m = 2 * size
        at.y = 9 * m * m
        at.damped = at.y + 3 * m
        at.pull = at.damped + m
        at.rate_pull = at.pull + m
        at.rate_stiffness = at.rate_pull + m
        at.speed_pull = at.rate_stiffness + m
        at.speed_stiffness = at.speed_pull + size
        at.coupling = at.speed_stiffness + size
        at.Z = at.coupling + size
        at.x = at.Z + 4 * size
        at.c = at.x + 3 * m
        at.L = at.c + m
        at.G = at.L + m * m
        at.energy = at.G + 3 * m * m
        at.norm = at.energy + m
        at.pair_energy = at.norm + m
        at.rows = at.pair_energy + size * (size - 1) // 2
        at.path = 0
        at.h = 6 * n * (K + 1)
        at.tangents = at.h + 2 * n * K
        at.mu = at.tangents + 8 * n * (K + 1)
        return at

    @wp.func
    def part(whole: Array, start: wp.int64, count: int):
        return wp.array(ptr=whole.ptr + wp.uint64(start) * wp.uint64(bytes_each), shape=(count,), dtype=T)

    @wp.func
    def pair_index(i: int, j: int, n: int):
        return i * n - (i * (i + 1)) // 2 + j - i - 1

    @wp.func
    def pair_first(pair: int, n: int):
        i = int(0)
        rest = pair
        while rest >= n - 1 - i:
            rest -= n - 1 - i
            i += 1
        return i

    # ---- A game: its agents, their lines and whether its inputs are finite

    @func
    def set_up(g: Game, game: int, agents: Numbers):
        """The n present agents in ``agents[0..n)``, and the starts of their lines (-1 without one) in ``agents[N..N+n)``."""
        b = game // g.M
        n = int(0)
        for a in range(g.N):
            if g.present[b * g.N + a] != wp.uint8(0):
                if lane() == 0:
                    line = int(-1)
                    if g.own_slot[LANE] >= 0:
                        chosen = int(g.reference[game * g.N + a])
                        if chosen >= 0 and chosen < g.lines:
                            if g.exists[(b * g.N + a) * g.lines + chosen] != wp.uint8(0):
                                line = ((b * g.N + a) * g.lines + chosen) * g.points * 2
                    agents[n] = a
                    agents[g.N + n] = line
                n += 1
        sync()
        return n

    @wp.func
    def end_of(g: Game, game: int):
        if g.cut == 0:
            return g.K
        return wp.clamp(int(g.ends[game // g.M]), 0, g.K)

    @func
    def valid(g: Game, game: int, n: int, agents: Numbers):
        """Whether inputs are finite whose NaN may not show in the result, and whether the lines exist."""
        b = game // g.M
        flag = 2 * g.N
        if lane() == 0:
            agents[flag] = 1
        sync()
        any_pair = int(0)
        features = int(PAIRS)  # a variable, or the loops would be unrolled
        for f in range(features):
            if g.pair_slot[f] >= 0:
                any_pair = 1
        for i in range(lane(), n, wp.block_dim()):
            a = agents[i]
            row = b * g.N + a
            sound = int(1)
            for e in range(4):
                if not wp.isfinite(g.initial[4 * row + e]):
                    sound = 0
            if any_pair == 1 or g.own_slot[STEER] >= 0:
                if not wp.isfinite(g.size[2 * row]):
                    sound = 0
            for f in range(2, features):
                if g.pair_slot[f] >= 0:
                    if not wp.isfinite(g.size[2 * row + 1]):
                        sound = 0
            if g.own_slot[LANE] >= 0:
                chosen = int(g.reference[game * g.N + a])
                if chosen < 0 or chosen >= g.lines:
                    sound = 0
                if agents[g.N + i] >= 0:
                    for e in range(2 * g.points):
                        if not wp.isfinite(g.references[agents[g.N + i] + e]):
                            sound = 0
            for j in range(i + 1, n):
                c = agents[j]
                entry = game * ((g.N * (g.N - 1)) // 2) + pair_index(a, c, g.N)
                all_pairs = g.G * ((g.N * (g.N - 1)) // 2)
                for f in range(features):
                    if g.pair_slot[f] >= 0:
                        if not wp.isfinite(g.pair[g.pair_slot[f] * all_pairs + entry]):
                            sound = 0
                        if g.margin_slot[f] >= 0:
                            if not wp.isfinite(g.margins[g.margin_slot[f] * all_pairs + entry]):
                                sound = 0
            if sound == 0:
                agents[flag] = 0
        sync()
        return agents[flag]

    @wp.func
    def weight(g: Game, feature: int, row: int):
        slot = g.own_slot[feature]
        if slot < 0:
            return T(0.0)
        return g.own[slot * g.G * g.N + row]

    # ---- Trajectories

    @wp.func
    def trace(at: Layout, n: int, K: int, quantity: int, i: int):
        """Start of one quantity of agent i's trajectory in the slow memory."""
        return at.path + (quantity * n + i) * (K + 1)

    @func
    def roll(g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, controls: Array):
        for i in range(lane(), n, wp.block_dim()):
            a = agents[i]
            start = 4 * ((game // g.M) * g.N + a)
            u = (game * g.N + a) * g.K * 2
            x = trace(at, n, g.K, X, i)
            y = trace(at, n, g.K, Y, i)
            turned = trace(at, n, g.K, TURNED, i)
            faster = trace(at, n, g.K, SPEED, i)
            sine = trace(at, n, g.K, SINE, i)
            cosine = trace(at, n, g.K, COSINE, i)
            x0 = g.initial[start]
            y0 = g.initial[start + 1]
            heading0 = g.initial[start + 2]
            speed0 = g.initial[start + 3]
            # The changes are summed on their own: added to a large coordinate, small ones would lose most of their digits.
            dx = T(0.0)
            dy = T(0.0)
            dh = T(0.0)
            dv = T(0.0)
            for k in range(g.K + 1):
                heading = heading0 + dh
                speed = speed0 + dv
                s = wp.sin(heading)
                c = wp.cos(heading)
                work[x + k] = x0 + dx
                work[y + k] = y0 + dy
                work[turned + k] = heading
                work[faster + k] = speed
                work[sine + k] = s
                work[cosine + k] = c
                if k < g.K:
                    dx += g.dt * speed * c
                    dy += g.dt * speed * s
                    dh += g.dt * controls[u + 2 * k + TURN_RATE]
                    dv += g.dt * controls[u + 2 * k + ACCELERATION]
        sync()

    @wp.func
    def set_motions(g: Game, n: int, at: Layout, work: Array, fast: Array, k: int):
        """Z of step k; the caller waits."""
        for i in range(lane(), n, wp.block_dim()):
            s = work[trace(at, n, g.K, SINE, i) + k]
            c = work[trace(at, n, g.K, COSINE, i) + k]
            along = g.dt * work[trace(at, n, g.K, SPEED, i) + k]
            z = at.Z + 4 * i
            fast[z] = -along * s
            fast[z + 1] = along * c
            fast[z + 2] = g.dt * c
            fast[z + 3] = g.dt * s

    @func
    def find_nearest(g: Game, n: int, agents: Numbers, at: Layout, work: Array, nearest: Array):
        if g.own_slot[LANE] >= 0:
            for e in range(lane(), n * g.K, wp.block_dim()):
                i = e // g.K
                k = e - i * g.K + 1
                line = agents[g.N + i]
                x = work[trace(at, n, g.K, X, i) + k]
                y = work[trace(at, n, g.K, Y, i) + k]
                best = T(wp.inf)
                # If no comparison below is true, an input is NaN, and the nearest point stays NaN.
                near_x = T(wp.nan)
                near_y = T(wp.nan)
                ahead_x = T(0.0)
                ahead_y = T(0.0)
                inside = T(0.0)
                if line < 0:
                    near_x = x
                    near_y = y
                else:
                    for q in range(g.points - 1):
                        from_x = g.references[line + 2 * q]
                        from_y = g.references[line + 2 * q + 1]
                        dx = g.references[line + 2 * q + 2] - from_x
                        dy = g.references[line + 2 * q + 3] - from_y
                        length = dx * dx + dy * dy
                        inverse = T(0.0)
                        if length > T(0.0):
                            inverse = T(1.0) / length
                        raw = ((x - from_x) * dx + (y - from_y) * dy) * inverse
                        along = wp.min(wp.max(raw, T(0.0)), T(1.0))
                        at_x = from_x + along * dx
                        at_y = from_y + along * dy
                        square = (x - at_x) * (x - at_x) + (y - at_y) * (y - at_y)
                        if square < best:
                            best = square
                            near_x = at_x
                            near_y = at_y
                            ahead_x = dx
                            ahead_y = dy
                            inside = wp.where(along == raw, inverse, T(0.0))
                scale = wp.sqrt(inside)
                place = i * (g.K + 1) + k
                each = n * (g.K + 1)
                nearest[NEAR_X * each + place] = near_x
                nearest[NEAR_Y * each + place] = near_y
                nearest[AHEAD_X * each + place] = ahead_x * scale
                nearest[AHEAD_Y * each + place] = ahead_y * scale
            sync()

    return SimpleNamespace(
        Game=Game,
        Run=Run,
        Gradients=Gradients,
        Layout=Layout,
        layout=layout,
        part=part,
        pair_index=pair_index,
        pair_first=pair_first,
        set_up=set_up,
        end_of=end_of,
        valid=valid,
        weight=weight,
        trace=trace,
        roll=roll,
        set_motions=set_motions,
        find_nearest=find_nearest,
        Array=Array,
        Numbers=Numbers,
    )
