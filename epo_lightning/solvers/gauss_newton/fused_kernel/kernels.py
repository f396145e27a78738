"""The two kernels: all steps of a game, and their adjoint. Their formulas are those of `kernel/group.hpp` and `step.hpp`."""

import functools
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from epo_lightning.game.features import SLOWEST_STEERING, WHEELBASE
from epo_lightning.scene import ACCELERATION, TURN_RATE, Status
from epo_lightning.solvers.gauss_newton.fused_kernel import pairs as pair_features
from epo_lightning.solvers.gauss_newton.fused_kernel import riccati, threads
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, PAIR, SIGNALS
from epo_lightning.solvers.gauss_newton.structured import LEAST_RAISED_DAMPING, RETRIES

GOAL, LANE, VELREF, VEL, HEADING, STEER, VELB = (
    OWN.index(name) for name in ("goal", "lane", "velref", "vel", "heading", "steer", "velb")
)
# Features of accelerations and of turn rates.
ACC, TURNR = OWN.index("acc"), OWN.index("turnr")
ACCB, TURNRB = OWN.index("accb"), OWN.index("turnrb")
ACCREF, TURNRREF = OWN.index("accref"), OWN.index("turnrref")
JERK, TURNACC = OWN.index("jerk"), OWN.index("turnacc")
JERKB, TURNACCB = OWN.index("jerkb"), OWN.index("turnaccb")
BOUND_VEL, BOUND_ACC, BOUND_TURNR, BOUND_JERK, BOUND_TURNACC = range(len(SIGNALS))
PAIRS = len(PAIR)
SOLVED, DAMPED, STOPPED = (int(status) for status in (Status.SOLVED, Status.DAMPED, Status.STOPPED))
X, Y, TURNED, SPEED, SINE, COSINE = range(6)  # arrays of a trajectory
NEAR_X, NEAR_Y, AHEAD_X, AHEAD_Y = range(4)  # nearest points of reference lines, and unit tangents there
OPTIONS = {"cpu_compiler_flags": "-march=native"}
"""Without Warp's flags for more inlining on CPUs, which double the time of compilation."""


@functools.cache
@no_type_check
def make(double: bool, most: int, inlined: bool) -> SimpleNamespace:
    """The kernels ``solve`` and ``differentiate`` and the structures of their arguments.

    Args:
        double: whether numbers have double precision.
        most: largest number of agents, if fast memory is to be shared memory; 0 for games of any size.
        inlined: whether long functions are inlined. For CPUs they are not, or they would be compiled as often as they are
            called. For GPUs they are, because a call would copy its arguments, which describe the game, to the stack.
    """
    T = wp.float64 if double else wp.float32
    bytes_each = 8 if double else 4
    basics = threads.make(T, most)
    sync, lane, fast_memory = basics.sync, basics.lane, basics.fast_memory
    func = functools.partial(wp.func, inline=None if inlined else False)
    features = pair_features.make(T)
    evaluate_pair, dual = features.evaluate, features.dual
    Array = wp.array(dtype=T)
    Numbers = wp.array(dtype=wp.int32)
    OwnSlots = wp.types.vector(len(OWN), wp.int32)
    PairSlots = wp.types.vector(PAIRS, wp.int32)
    Bounds = wp.types.vector(2 * len(SIGNALS), T)

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

    recursion = riccati.make(T, basics, Layout, func)
    control_block, factorise, transition = recursion.control_block, recursion.factorise, recursion.transition
    eliminate, pull, push = recursion.eliminate, recursion.pull, recursion.push

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
    def set_up(g: Game, game: int, who: Numbers):
        """The n present agents in ``who[0..n)``, and the starts of their lines (-1 without one) in ``who[N..N+n)``."""
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
                    who[n] = a
                    who[g.N + n] = line
                n += 1
        sync()
        return n

    @wp.func
    def end_of(g: Game, game: int):
        if g.cut == 0:
            return g.K
        return wp.clamp(int(g.ends[game // g.M]), 0, g.K)

    @func
    def valid(g: Game, game: int, n: int, who: Numbers):
        """Whether inputs are finite whose NaN may not show in the result, and whether the lines exist."""
        b = game // g.M
        flag = 2 * g.N
        if lane() == 0:
            who[flag] = 1
        sync()
        any_pair = int(0)
        features = int(PAIRS)  # a variable, or the loops would be unrolled
        for f in range(features):
            if g.pair_slot[f] >= 0:
                any_pair = 1
        for i in range(lane(), n, wp.block_dim()):
            a = who[i]
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
                if who[g.N + i] >= 0:
                    for e in range(2 * g.points):
                        if not wp.isfinite(g.references[who[g.N + i] + e]):
                            sound = 0
            for j in range(i + 1, n):
                c = who[j]
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
                who[flag] = 0
        sync()
        return who[flag]

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
    def roll(g: Game, game: int, n: int, who: Numbers, at: Layout, work: Array, controls: Array):
        for i in range(lane(), n, wp.block_dim()):
            a = who[i]
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
    def find_nearest(g: Game, n: int, who: Numbers, at: Layout, work: Array, nearest: Array):
        if g.own_slot[LANE] >= 0:
            for e in range(lane(), n * g.K, wp.block_dim()):
                i = e // g.K
                k = e - i * g.K + 1
                line = who[g.N + i]
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

    # ---- Costs with first and second derivatives

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
        who: Numbers,
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
            row = game * g.N + who[i]
            v = work[trace(at, n, g.K, SPEED, i) + state]
            energy = T(0.0)
            force = T(0.0)
            stiffness = T(0.0)
            if g.own_slot[VEL] >= 0:
                energy, force, stiffness = add(weight(g, VEL, row), v, T(1.0), energy, force, stiffness)
            if g.own_slot[VELREF] >= 0:
                apart = v - g.speeds[(game // g.M) * g.N + who[i]]
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
            if g.own_slot[LANE] >= 0 and who[g.N + i] >= 0:
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
        g: Game, game: int, n: int, who: Numbers, at: Layout, work: Array, fast: Array, state: int, curved: int
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
                        place = game * all_pairs + pair_index(who[i], who[j], g.N)
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
                            g.size[2 * (b + who[i])],
                            g.size[2 * (b + who[i]) + 1],
                            work[trace(at, n, g.K, X, j) + state],
                            work[trace(at, n, g.K, Y, j) + state],
                            work[trace(at, n, g.K, COSINE, j) + state],
                            work[trace(at, n, g.K, SINE, j) + state],
                            work[trace(at, n, g.K, SPEED, j) + state],
                            g.size[2 * (b + who[j])],
                            g.size[2 * (b + who[j]) + 1],
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
        g: Game, game: int, n: int, who: Numbers, at: Layout, work: Array, fast: Array, controls: Array, k: int
    ):
        """Costs of the controls of step k, of their rates and of the steering angle; also sets Z."""
        for r in range(lane(), 2 * n, wp.block_dim()):
            i = r // 2
            turning = r == 2 * i
            row = game * g.N + who[i]
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
                    wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + who[i])]
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

    # ---- A step

    @func
    def push_all(
        g: Game,
        game: int,
        n: int,
        who: Numbers,
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
                    place = 2 * ((game * g.N + who[i]) * g.K + k)
                to[place + wp.where(r == 2 * i, TURN_RATE, ACCELERATION)] = fast[at.c + r]
            sync()

    @func
    def solve_step(
        g: Game,
        game: int,
        n: int,
        who: Numbers,
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
            state_costs(g, game, n, who, at, work, nearest, fast, k + 1, end, 1)
            pair_costs(g, game, n, who, at, work, fast, k + 1, 1)
            control_costs(g, game, n, who, at, work, fast, controls, k)
            for r in range(lane(), m, wp.block_dim()):
                given = g.damping[game * g.N + who[r // 2]]
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
        push_all(g, game, n, who, at, work, fast, factors, end, directions, 0)
        return positive

    @func
    def evaluate(
        g: Game,
        game: int,
        n: int,
        who: Numbers,
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
            state_costs(g, game, n, who, at, work, nearest, fast, k + 1, end, 0)
            pair_costs(g, game, n, who, at, work, fast, k + 1, 0)
            control_costs(g, game, n, who, at, work, fast, controls, k)
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

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS)
    def solve(g: Game, run: Run):
        block, _ = wp.tid()
        row = g.N * g.K * 2
        everything = g.G * row
        each_factor = 16 * g.N * g.N * g.K
        each_nearest = 4 * g.N * (g.K + 1)
        work = part(run.work, wp.int64(block) * wp.int64(run.work_numbers), run.work_numbers)
        rest = work.ptr + wp.uint64((14 * g.N * (g.K + 1) + 4 * g.N * g.K) * bytes_each)
        fast = wp.array(ptr=fast_memory(rest), shape=(run.work_numbers,), dtype=T)
        who = wp.array(ptr=run.numbers.ptr + wp.uint64(block * (2 * g.N + 2) * 4), shape=(2 * g.N + 2,), dtype=wp.int32)
        for game in range(block, g.G, run.blocks):
            n = set_up(g, game, who)
            at = layout(n, g.K)
            end = end_of(g, game)
            sound = valid(g, game, n, who)
            status = SOLVED
            if sound == 0:
                status = STOPPED
            first = part(run.iterates, wp.int64(0), everything)
            for e in range(lane(), row, wp.block_dim()):
                there = g.present[(game // g.M) * g.N + e // (2 * g.K)] != wp.uint8(0)
                first[game * row + e] = wp.where(there, run.start[game * row + e], T(0.0))
            sync()
            slot = wp.where(run.record == 1, game, block)
            for s in range(run.steps):
                controls = part(run.iterates, wp.int64(s) * run.iterate_stride, everything)
                onward = part(run.iterates, wp.int64(s + 1) * run.iterate_stride, everything)
                directions = part(run.directions, wp.int64(s) * run.direction_stride, everything)
                tape = wp.int64(wp.where(run.record == 1, s * g.G, 0) + slot)
                factors = part(run.factors, tape * wp.int64(each_factor), each_factor)
                nearest = part(run.nearest, tape * wp.int64(each_nearest), each_nearest)
                for e in range(lane(), row, wp.block_dim()):
                    directions[game * row + e] = T(0.0)
                roll(g, game, n, who, at, work, controls)
                find_nearest(g, n, who, at, work, nearest)
                raised = T(0.0)
                positive = int(0)
                attempt = int(0)
                while positive == 0 and attempt <= RETRIES:
                    positive = solve_step(
                        g, game, n, who, at, work, nearest, fast, factors, controls, end, raised, directions
                    )
                    if positive == 0:
                        status = wp.max(status, DAMPED)
                        raised = wp.where(attempt == 0, T(10.0), T(10.0) * raised)
                    attempt += 1
                if s == 0 and lane() == 0:
                    run.initial_energy[game] = total(n, at, fast)
                flag = 2 * g.N
                if lane() == 0:
                    who[flag] = sound * positive
                sync()
                for e in range(lane(), row, wp.block_dim()):
                    moved = controls[game * row + e] + g.step_size * directions[game * row + e]
                    if not wp.isfinite(moved):
                        who[flag] = 0
                sync()
                taken = who[flag]
                if taken == 0:
                    status = STOPPED
                for e in range(lane(), row, wp.block_dim()):
                    here = controls[game * row + e]
                    if taken == 1:
                        here += g.step_size * directions[game * row + e]
                    onward[game * row + e] = here
                if run.record == 1 and lane() == 0:
                    run.taken[s * g.G + game] = taken
                sync()
            last = part(run.iterates, wp.int64(run.steps) * run.iterate_stride, everything)
            # Nearest points of the last iterate go where those of the first step are, which are needed again if recorded.
            final = part(
                run.nearest, wp.int64(run.steps * run.record * g.G + slot) * wp.int64(each_nearest), each_nearest
            )
            roll(g, game, n, who, at, work, last)
            find_nearest(g, n, who, at, work, final)
            energy, squared = evaluate(g, game, n, who, at, work, final, fast, last, end)
            if lane() == 0:
                run.energy[game] = energy
                run.gradient_norm[game] = wp.sqrt(squared)
                run.status[game] = wp.int64(status)
                if run.steps == 0:
                    run.initial_energy[game] = energy
            for e in range(lane(), 2 * row, wp.block_dim()):
                run.states[game * 2 * row + e] = T(0.0)
            sync()
            for e in range(lane(), n * g.K, wp.block_dim()):
                i = e // g.K
                k = e - i * g.K
                to = ((game * g.N + who[i]) * g.K + k) * 4
                for q in range(4):
                    run.states[to + q] = work[trace(at, n, g.K, q, i) + k + 1]
            sync()

    # ---- The adjoint

    @wp.func
    def roll_tangents(g: Game, game: int, n: int, who: Numbers, at: Layout, work: Array, directions: Array):
        """Tangents of the trajectories along mu (first half of the place) and along the direction d (second half)."""
        half = 4 * n * (g.K + 1)
        for e in range(lane(), 2 * n, wp.block_dim()):
            along_d = e // n
            i = e - along_d * n
            to = at.tangents + along_d * half
            row = 2 * (game * g.N + who[i]) * g.K
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
        who: Numbers,
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
            row = game * g.N + who[i]
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
                off = v - g.speeds[(game // g.M) * g.N + who[i]]
                fast[node + 1] += residual_adjoint(g, by, VELREF, row, off, T(1.0), speed1, speed2)
            if g.own_slot[VELB] >= 0:
                over = excess(g, BOUND_VEL, v)
                slope = excess_slope(g, BOUND_VEL, v)
                fast[node + 1] += residual_adjoint(g, by, VELB, row, over, slope, speed1, speed2)
            px = work[trace(at, n, g.K, X, i) + state]
            py = work[trace(at, n, g.K, Y, i) + state]
            if g.own_slot[LANE] >= 0 and who[g.N + i] >= 0:
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
        who: Numbers,
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
                        place = game * all_pairs + pair_index(who[i], who[j], g.N)
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
                            g.size[2 * (b + who[i])],
                            g.size[2 * (b + who[i]) + 1],
                            moving(g, at, n, work, X, j, state),
                            moving(g, at, n, work, Y, j, state),
                            dual(c2, -s2 * turn2a, -s2 * turn2b),
                            dual(s2, c2 * turn2a, c2 * turn2b),
                            moving(g, at, n, work, SPEED, j, state),
                            g.size[2 * (b + who[j])],
                            g.size[2 * (b + who[j]) + 1],
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
        who: Numbers,
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
            row = game * g.N + who[i]
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
                wheelbase = T(WHEELBASE) * g.size[2 * ((game // g.M) * g.N + who[i])]
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
    def pull_states(g: Game, by: Gradients, game: int, n: int, who: Numbers, at: Layout, work: Array):
        """Adds the pullback of the cotangent of the states to that of the controls."""
        for i in range(lane(), n, wp.block_dim()):
            row = (game * g.N + who[i]) * g.K
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

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS)
    def differentiate(g: Game, run: Run, by: Gradients):
        block, _ = wp.tid()
        row = g.N * g.K * 2
        everything = g.G * row
        each_factor = 16 * g.N * g.N * g.K
        each_nearest = 4 * g.N * (g.K + 1)
        work = part(run.work, wp.int64(block) * wp.int64(run.work_numbers), run.work_numbers)
        rest = work.ptr + wp.uint64((14 * g.N * (g.K + 1) + 4 * g.N * g.K) * bytes_each)
        fast = wp.array(ptr=fast_memory(rest), shape=(run.work_numbers,), dtype=T)
        who = wp.array(ptr=run.numbers.ptr + wp.uint64(block * (2 * g.N + 2) * 4), shape=(2 * g.N + 2,), dtype=wp.int32)
        for game in range(block, g.G, run.blocks):
            n = set_up(g, game, who)
            at = layout(n, g.K)
            m = 2 * n
            end = end_of(g, game)
            if by.along_states == 1:
                roll(
                    g, game, n, who, at, work, part(run.iterates, wp.int64(run.steps) * run.iterate_stride, everything)
                )
                pull_states(g, by, game, n, who, at, work)
            for turn in range(run.steps + 1):
                s = run.steps - turn
                if s < run.steps:
                    if run.taken[s * g.G + game] == 1:  # a step that was not taken passes its cotangent on unchanged
                        controls = part(run.iterates, wp.int64(s) * run.iterate_stride, everything)
                        directions = part(run.directions, wp.int64(s) * run.direction_stride, everything)
                        tape = wp.int64(s * g.G + game)
                        factors = part(run.factors, tape * wp.int64(each_factor), each_factor)
                        nearest = part(run.nearest, tape * wp.int64(each_nearest), each_nearest)
                        roll(g, game, n, who, at, work, controls)
                        # mu = alpha H^-1 times the cotangent; zero after the end of the game.
                        for e in range(lane(), m * g.K, wp.block_dim()):
                            work[at.mu + e] = T(0.0)
                        for e in range(lane(), 3 * m, wp.block_dim()):
                            fast[at.y + e] = T(0.0)
                        sync()
                        for back in range(end):
                            k = end - 1 - back
                            set_motions(g, n, at, work, fast, k)
                            for r in range(lane(), m, wp.block_dim()):
                                i = r // 2
                                u = 2 * ((game * g.N + who[i]) * g.K + k) + wp.where(
                                    r == 2 * i, TURN_RATE, ACCELERATION
                                )
                                work[at.h + k * m + r] = -g.step_size * by.controls[u]
                            sync()
                            first = wp.where(k == 0, 1, 0)
                            pull(
                                factors,
                                k * 4 * m * m,
                                k * 4 * m * m + m * m,
                                fast,
                                at,
                                n,
                                g.dt,
                                first,
                                work,
                                at.h + k * m,
                            )
                        push_all(g, game, n, who, at, work, fast, factors, end, work, 1)
                        roll_tangents(g, game, n, who, at, work, directions)
                        for e in range(lane(), 8 * n, wp.block_dim()):
                            fast[e] = T(0.0)
                        sync()
                        for back in range(end):
                            k = end - 1 - back
                            state_adjoint(g, by, game, n, who, at, work, nearest, fast, k + 1, end)
                            pair_adjoint(g, by, game, n, who, at, work, fast, k + 1)
                            control_adjoint(g, by, game, n, who, at, work, fast, controls, directions, k)
                if by.along_iterates == 1:
                    for e in range(lane(), row, wp.block_dim()):
                        u = game * row + e
                        by.controls[u] = by.controls[u] + by.iterates[s * everything + u]
                    sync()
            for e in range(lane(), row, wp.block_dim()):
                if g.present[(game // g.M) * g.N + e // (2 * g.K)] == wp.uint8(0):
                    by.controls[game * row + e] = T(0.0)
            sync()

    return SimpleNamespace(
        solve=solve, differentiate=differentiate, Game=Game, Run=Run, Gradients=Gradients, Array=Array
    )
