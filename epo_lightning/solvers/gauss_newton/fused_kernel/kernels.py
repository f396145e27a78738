"""The two kernels: all steps of a game, and their adjoint. Their formulas are those of `kernel/group.hpp` and `step.hpp`."""

import functools
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel import adjoint as adjoints
from epo_lightning.solvers.gauss_newton.fused_kernel import costs as all_costs
from epo_lightning.solvers.gauss_newton.fused_kernel import games as all_games
from epo_lightning.solvers.gauss_newton.fused_kernel import pairs as pair_features
from epo_lightning.solvers.gauss_newton.fused_kernel import riccati, threads
from epo_lightning.solvers.gauss_newton.fused_kernel import steps as all_steps
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import (
    ACCELERATION,
    DAMPED,
    SOLVED,
    STOPPED,
    TURN_RATE,
)
from epo_lightning.solvers.gauss_newton.structured import RETRIES

OPTIONS = {"cpu_compiler_flags": "-march=native"}
"""Without Warp's flags for more inlining on CPUs, which double the time of compilation."""


@functools.cache
@no_type_check
def make(double: bool, most: int, inlined: bool, backwards: bool = False) -> SimpleNamespace:
    """The kernels ``solve`` and ``differentiate`` and the structures of their arguments.

    Args:
        double: whether numbers have double precision.
        most: largest number of agents, if fast memory is to be shared memory; 0 for games of any size.
        inlined: whether long functions are inlined. For CPUs they are not, or they would be compiled as often as they are
            called. For GPUs they are, because a call would copy its arguments, which describe the game, to the stack.
        backwards: whether a CPU runs the threads of a game in the opposite order, for tests.
    """
    T = wp.float64 if double else wp.float32
    bytes_each = 8 if double else 4
    func = functools.partial(wp.func, inline=None if inlined else False)
    basics = threads.make(T, most, backwards)
    games = all_games.make(T, most, basics, func)
    features = pair_features.make(T)
    costs = all_costs.make(T, basics, games, features, func)
    recursion = riccati.make(T, basics, games.Layout, func)
    steps = all_steps.make(T, basics, games, costs, recursion, func)
    adjoint = adjoints.make(T, basics, games, costs, features, func)
    sync, lane, fast_memory = basics.sync, basics.lane, basics.fast_memory
    Game, Run, Gradients, layout, part, set_up = (
        games.Game,
        games.Run,
        games.Gradients,
        games.layout,
        games.part,
        games.set_up,
    )
    end_of, valid, trace, roll, set_motions, find_nearest = (
        games.end_of,
        games.valid,
        games.trace,
        games.roll,
        games.set_motions,
        games.find_nearest,
    )
    total = costs.total
    pull = recursion.pull
    push_all, solve_step, evaluate = steps.push_all, steps.solve_step, steps.evaluate
    roll_tangents, state_adjoint, pair_adjoint, control_adjoint, pull_states = (
        adjoint.roll_tangents,
        adjoint.state_adjoint,
        adjoint.pair_adjoint,
        adjoint.control_adjoint,
        adjoint.pull_states,
    )

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def solve(g: Game, run: Run):
        block, _ = wp.tid()
        row = g.N * g.K * 2
        everything = g.G * row
        each_factor = 16 * g.N * g.N * g.K
        each_nearest = 4 * g.N * (g.K + 1)
        work = part(run.work, wp.int64(block) * wp.int64(run.work_numbers), run.work_numbers)
        rest = work.ptr + wp.uint64((14 * g.N * (g.K + 1) + 4 * g.N * g.K) * bytes_each)
        fast = wp.array(ptr=fast_memory(rest), shape=(run.work_numbers,), dtype=T)
        agents = wp.array(
            ptr=run.numbers.ptr + wp.uint64(block * (2 * g.N + 2) * 4), shape=(2 * g.N + 2,), dtype=wp.int32
        )
        for game in range(block, g.G, run.blocks):
            n = set_up(g, game, agents)
            at = layout(n, g.K)
            end = end_of(g, game)
            sound = valid(g, game, n, agents)
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
                roll(g, game, n, agents, at, work, controls)
                find_nearest(g, n, agents, at, work, nearest)
                raised = T(0.0)
                positive = int(0)
                attempt = int(0)
                while positive == 0 and attempt <= RETRIES:
                    positive = solve_step(
                        g, game, n, agents, at, work, nearest, fast, factors, controls, end, raised, directions
                    )
                    if positive == 0:
                        status = wp.max(status, DAMPED)
                        raised = wp.where(attempt == 0, T(10.0), T(10.0) * raised)
                    attempt += 1
                if s == 0 and lane() == 0:
                    run.initial_energy[game] = total(n, at, fast)
                flag = 2 * g.N
                if lane() == 0:
                    agents[flag] = sound * positive
                sync()
                for e in range(lane(), row, wp.block_dim()):
                    moved = controls[game * row + e] + g.step_size * directions[game * row + e]
                    if not wp.isfinite(moved):
                        agents[flag] = 0
                sync()
                taken = agents[flag]
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
            roll(g, game, n, agents, at, work, last)
            find_nearest(g, n, agents, at, work, final)
            energy, squared = evaluate(g, game, n, agents, at, work, final, fast, last, end)
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
                to = ((game * g.N + agents[i]) * g.K + k) * 4
                for q in range(4):
                    run.states[to + q] = work[trace(at, n, g.K, q, i) + k + 1]
            sync()

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def differentiate(g: Game, run: Run, by: Gradients):
        block, _ = wp.tid()
        row = g.N * g.K * 2
        everything = g.G * row
        each_factor = 16 * g.N * g.N * g.K
        each_nearest = 4 * g.N * (g.K + 1)
        work = part(run.work, wp.int64(block) * wp.int64(run.work_numbers), run.work_numbers)
        rest = work.ptr + wp.uint64((14 * g.N * (g.K + 1) + 4 * g.N * g.K) * bytes_each)
        fast = wp.array(ptr=fast_memory(rest), shape=(run.work_numbers,), dtype=T)
        agents = wp.array(
            ptr=run.numbers.ptr + wp.uint64(block * (2 * g.N + 2) * 4), shape=(2 * g.N + 2,), dtype=wp.int32
        )
        for game in range(block, g.G, run.blocks):
            n = set_up(g, game, agents)
            at = layout(n, g.K)
            m = 2 * n
            end = end_of(g, game)
            if by.along_states == 1:
                roll(
                    g,
                    game,
                    n,
                    agents,
                    at,
                    work,
                    part(run.iterates, wp.int64(run.steps) * run.iterate_stride, everything),
                )
                pull_states(g, by, game, n, agents, at, work)
            for turn in range(run.steps + 1):
                s = run.steps - turn
                if s < run.steps:
                    if run.taken[s * g.G + game] == 1:  # a step that was not taken passes its cotangent on unchanged
                        controls = part(run.iterates, wp.int64(s) * run.iterate_stride, everything)
                        directions = part(run.directions, wp.int64(s) * run.direction_stride, everything)
                        tape = wp.int64(s * g.G + game)
                        factors = part(run.factors, tape * wp.int64(each_factor), each_factor)
                        nearest = part(run.nearest, tape * wp.int64(each_nearest), each_nearest)
                        roll(g, game, n, agents, at, work, controls)
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
                                u = 2 * ((game * g.N + agents[i]) * g.K + k) + wp.where(
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
                        push_all(g, game, n, agents, at, work, fast, factors, end, work, 1)
                        roll_tangents(g, game, n, agents, at, work, directions)
                        for e in range(lane(), 8 * n, wp.block_dim()):
                            fast[e] = T(0.0)
                        sync()
                        for back in range(end):
                            k = end - 1 - back
                            state_adjoint(g, by, game, n, agents, at, work, nearest, fast, k + 1, end)
                            pair_adjoint(g, by, game, n, agents, at, work, fast, k + 1)
                            control_adjoint(g, by, game, n, agents, at, work, fast, controls, directions, k)
                if by.along_iterates == 1:
                    for e in range(lane(), row, wp.block_dim()):
                        u = game * row + e
                        by.controls[u] = by.controls[u] + by.iterates[s * everything + u]
                    sync()
            for e in range(lane(), row, wp.block_dim()):
                if g.present[(game // g.M) * g.N + e // (2 * g.K)] == wp.uint8(0):
                    by.controls[game * row + e] = T(0.0)
            sync()

    return SimpleNamespace(solve=solve, differentiate=differentiate, Game=Game, Run=Run, Gradients=Gradients)
