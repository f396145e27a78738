"""The games as the kernels read them, and the nearest points of their reference lines."""

from dataclasses import fields
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel import layout
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import LANE, PAIRS, STEER
from epo_lightning.solvers.gauss_newton.fused_kernel.features import Features
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, SIGNALS


@no_type_check
def make(
    T: Any,
    agents: int,
    features: Features | None,
    steps: int | None,
    threads: SimpleNamespace,
    func: Any,
) -> SimpleNamespace:
    """Structures and functions for numbers of type ``T``; ``func`` decorates the longer functions.

    Args:
        agents: number of agents for which memory is laid out; a game has that many or fewer.
        features: the only features that the games have, so that the compiler leaves out all others; None for any.
        steps: the only number of steps K that the games have; None for any.
    """
    A = agents
    bytes_each = 8 if T is wp.float64 else 4
    Array = wp.array(dtype=T)
    Numbers = wp.array(dtype=wp.int32)
    OwnSlots = wp.types.vector(len(OWN), wp.int32)
    PairSlots = wp.types.vector(PAIRS, wp.int32)
    Bounds = wp.types.vector(2 * len(SIGNALS), T)
    known = features or Features((), ())
    own_slots, pair_features, margin_slots = (
        OwnSlots(*known.own_slots),
        PairSlots(*known.pair_features),
        PairSlots(*known.margin_slots),
    )
    own_number, pair_number = len(known.own), len(known.pair)
    sync, lane, nearest_segment = threads.sync, threads.lane, threads.nearest_segment

    # The fields of `layout.Layout`, as a structure of Warp.
    Layout = wp.struct(type("Layout", (), {"__annotations__": {field.name: int for field in fields(layout.Layout)}}))

    @wp.struct
    class Game:
        """Tensors of G = B M games, contiguous, and the features of their energy, as :class:`Features` has them.

        The damping of agent a in a game is at ``game * damping_of_game + a * damping_of_agent``.
        """

        G: int
        M: int
        N: int
        K: int
        lines: int
        points: int
        pair_stride: int
        slides: int
        cut: int
        own_count: int
        pair_count: int
        dt: T
        step_size: T
        own_slot: OwnSlots
        pair_feature: PairSlots
        margin_slot: PairSlots
        bounds: Bounds
        initial: Array
        size: Array
        own: Array
        pair: Array
        margins: Array
        goals: Array
        goal_headings: Array
        references: Array
        speeds: Array
        reference_controls: Array
        damping: Array
        damping_of_game: int
        damping_of_agent: int
        present: wp.array(dtype=wp.uint8)
        exists: wp.array(dtype=wp.uint8)
        reference: wp.array(dtype=wp.int64)
        ends: wp.array(dtype=wp.int64)

    @wp.struct
    class Run:
        """Steps, results and memory. Factors and nearest points are by step and game if recorded, and otherwise by block;
        ``slots`` is the number of games or of blocks."""

        steps: int
        record: int
        blocks: int
        slots: int
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
        at: Layout
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
        goal_headings: Array
        reference_controls: Array

    @wp.func
    def part(whole: Array, start: wp.int64, count: int):
        return wp.array(ptr=whole.ptr + wp.uint64(start) * wp.uint64(bytes_each), shape=(count,), dtype=T)

    @wp.func
    def pair_index(i: int, j: int, n: int):
        return i * n - (i * (i + 1)) // 2 + j - i - 1

    @wp.func
    def pair_first(pair: int, n: int):
        """The first agent of a pair of n agents."""
        i = int(0)
        rest = pair
        while rest >= n - 1 - i:
            rest -= n - 1 - i
            i += 1
        return i

    @wp.func
    def first_agent(pair: int):
        """The same for a pair of A agents, without a loop that the compiler cannot unroll."""
        i = int(0)
        for r in range(1, A - 1):
            i += wp.where(pair >= r * A - (r * (r + 1)) // 2, 1, 0)
        return i

    # ---- Features and the number of steps: constants if the kernels are compiled for them

    if features is None:

        @wp.func
        def own_slot(g: Game, feature: int):
            return g.own_slot[feature]

        @wp.func
        def pair_feature(g: Game, slot: int):
            return g.pair_feature[slot]

        @wp.func
        def margin_slot(g: Game, slot: int):
            return g.margin_slot[slot]

        @wp.func
        def own_count(g: Game):
            return g.own_count

        @wp.func
        def pair_count(g: Game):
            return g.pair_count

    else:

        @wp.func
        def own_slot(g: Game, feature: int):
            return own_slots[feature]

        @wp.func
        def pair_feature(g: Game, slot: int):
            return pair_features[slot]

        @wp.func
        def margin_slot(g: Game, slot: int):
            return margin_slots[slot]

        @wp.func
        def own_count(g: Game):
            return own_number

        @wp.func
        def pair_count(g: Game):
            return pair_number

    if steps is None:

        @wp.func
        def horizon(g: Game):
            return g.K

    else:

        @wp.func
        def horizon(g: Game):
            return steps

    # ---- A game: its agents, their lines and whether its inputs are finite

    @func
    def set_up(g: Game, game: int, agents: Numbers):
        """The n present agents in ``agents[0..n)``, and the starts of their lines (-1 without one) in ``agents[N..N+n)``."""
        b = game // g.M
        line_of = 2 * g.N + 2  # by agent, also the absent ones, which have -2
        for a in range(lane(), g.N, wp.block_dim()):
            line = int(-2)
            if g.present[b * g.N + a] != wp.uint8(0):
                line = -1
                if own_slot(g, LANE) >= 0:
                    chosen = int(g.reference[game * g.N + a])
                    if chosen >= 0 and chosen < g.lines:
                        if g.exists[(b * g.N + a) * g.lines + chosen] != wp.uint8(0):
                            line = ((b * g.N + a) * g.lines + chosen) * g.points * 2
            agents[line_of + a] = line
        sync()
        n = int(0)
        for a in range(g.N):
            line = agents[line_of + a]
            if line >= -1:
                if lane() == 0:
                    agents[n] = a
                    agents[g.N + n] = line
                n += 1
        sync()
        return n

    @wp.func
    def end_of(g: Game, game: int):
        K = horizon(g)
        if g.cut == 0:
            return K
        return wp.clamp(int(g.ends[game // g.M]), 0, K)

    @func
    def valid(g: Game, game: int, n: int, agents: Numbers):
        """Whether inputs are finite whose NaN may not show in the result, no size is negative, and the lines exist."""
        b = game // g.M
        flag = 2 * g.N
        if lane() == 0:
            agents[flag] = 1
        sync()
        sound = int(1)
        for i in range(lane(), n, wp.block_dim()):
            row = b * g.N + agents[i]
            for e in range(4):
                if not wp.isfinite(g.initial[4 * row + e]):
                    sound = 0
            if pair_count(g) > 0 or own_slot(g, STEER) >= 0:
                if g.size[2 * row] < T(0.0) or not wp.isfinite(g.size[2 * row]):
                    sound = 0
            for slot in range(pair_count(g)):
                if pair_feature(g, slot) >= 2:  # all but those of discs read the width
                    if g.size[2 * row + 1] < T(0.0) or not wp.isfinite(g.size[2 * row + 1]):
                        sound = 0
            if own_slot(g, LANE) >= 0:
                chosen = int(g.reference[game * g.N + agents[i]])
                if chosen < 0 or chosen >= g.lines:
                    sound = 0
        if own_slot(g, LANE) >= 0:
            for e in range(lane(), n * 2 * g.points, wp.block_dim()):
                i = e // (2 * g.points)
                if agents[g.N + i] >= 0:
                    if not wp.isfinite(g.references[agents[g.N + i] + e - i * 2 * g.points]):
                        sound = 0
        all_pairs = (g.N * (g.N - 1)) // 2
        for e in range(lane(), pair_count(g) * ((n * (n - 1)) // 2), wp.block_dim()):
            slot = e // ((n * (n - 1)) // 2)
            p = e - slot * ((n * (n - 1)) // 2)
            i = pair_first(p, n)
            j = p - pair_index(i, i + 1, n) + i + 1
            entry = game * all_pairs + pair_index(agents[i], agents[j], g.N)
            if not wp.isfinite(g.pair[slot * g.G * all_pairs + entry]):
                sound = 0
            if margin_slot(g, slot) >= 0:
                if not wp.isfinite(g.margins[margin_slot(g, slot) * g.G * all_pairs + entry]):
                    sound = 0
        if sound == 0:
            agents[flag] = 0
        sync()
        return agents[flag]

    @func
    def nearest_point(g: Game, line: int, x: T, y: T):
        """The nearest point of a line, and the tangent there where it moves along; without a line, the point itself."""
        # Without a nearest segment an input is NaN, and the nearest point stays NaN.
        near_x = T(wp.nan)
        near_y = T(wp.nan)
        ahead_x = T(0.0)
        ahead_y = T(0.0)
        inside = T(0.0)
        if line < 0:
            near_x = x
            near_y = y
        else:
            segment = nearest_segment(g.references, line, g.points, x, y)
            if segment >= 0:
                from_x = g.references[line + 2 * segment]
                from_y = g.references[line + 2 * segment + 1]
                ahead_x = g.references[line + 2 * segment + 2] - from_x
                ahead_y = g.references[line + 2 * segment + 3] - from_y
                length = ahead_x * ahead_x + ahead_y * ahead_y
                inverse = T(0.0)
                if length > T(0.0):
                    inverse = T(1.0) / length
                raw = ((x - from_x) * ahead_x + (y - from_y) * ahead_y) * inverse
                along = wp.min(wp.max(raw, T(0.0)), T(1.0))
                near_x = from_x + along * ahead_x
                near_y = from_y + along * ahead_y
                inside = wp.where(along == raw, inverse, T(0.0))
        scale = wp.sqrt(inside)
        return near_x, near_y, ahead_x * scale, ahead_y * scale

    @wp.func
    def weight(g: Game, feature: int, row: int):
        """The weight of an own feature that the energy has."""
        return g.own[own_slot(g, feature) * g.G * g.N + row]

    return SimpleNamespace(
        Game=Game,
        Run=Run,
        Gradients=Gradients,
        Layout=Layout,
        agents=A,
        own_slot=own_slot,
        own_count=own_count,
        pair_feature=pair_feature,
        pair_count=pair_count,
        margin_slot=margin_slot,
        part=part,
        pair_index=pair_index,
        pair_first=pair_first,
        set_up=set_up,
        end_of=end_of,
        valid=valid,
        weight=weight,
        horizon=horizon,
        first_agent=first_agent,
        nearest_point=nearest_point,
        Array=Array,
        Numbers=Numbers,
    )
