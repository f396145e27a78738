"""The two kernels: all steps of a game, and their adjoint. Their formulas are those of `kernel/group.hpp` and `step.hpp`."""

import functools
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.backends.pytorch import RETRIES
from epo_lightning.solvers.gauss_newton.fused_kernel import adjoint as adjoints
from epo_lightning.solvers.gauss_newton.fused_kernel import expansion as expansions
from epo_lightning.solvers.gauss_newton.fused_kernel import games as all_games
from epo_lightning.solvers.gauss_newton.fused_kernel import layout, threads
from epo_lightning.solvers.gauss_newton.fused_kernel import pair_adjoint as pair_adjoints
from epo_lightning.solvers.gauss_newton.fused_kernel import pair_expansion as pair_expansions
from epo_lightning.solvers.gauss_newton.fused_kernel import pairs as pair_features
from epo_lightning.solvers.gauss_newton.fused_kernel import places as all_places
from epo_lightning.solvers.gauss_newton.fused_kernel import position_adjoint as position_adjoints
from epo_lightning.solvers.gauss_newton.fused_kernel import products as all_products
from epo_lightning.solvers.gauss_newton.fused_kernel import recursion as recursions
from epo_lightning.solvers.gauss_newton.fused_kernel import residuals as all_residuals
from epo_lightning.solvers.gauss_newton.fused_kernel import totals as all_totals
from epo_lightning.solvers.gauss_newton.fused_kernel import trajectories as all_trajectories
from epo_lightning.solvers.gauss_newton.fused_kernel.constants import COMPLETED, DAMPED, PAIRS, STOPPED, TEAM, WARP
from epo_lightning.solvers.gauss_newton.fused_kernel.features import Features
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN

REGISTERS = {WARP: 128, TEAM: 255}
"""Registers of a thread on a GPU, at most. With 128, some numbers are in local memory, but twice as many games are solved at
a time as with 255; that hides the latency of memory where there are many games."""
OPTIONS = {"cpu_compiler_flags": "-march=native"}
"""Without Warp's flags for more inlining on CPUs, which double the time of compilation."""


@functools.cache
@no_type_check
def make(
    double: bool,
    agents: int,
    features: Features | None = None,
    steps: int | None = None,
    count: int = WARP,
    backwards: bool = False,
) -> SimpleNamespace:
    """The kernels ``solve`` and ``differentiate`` and the structures of their arguments.

    Args:
        double: whether numbers have double precision.
        agents: number of agents that a game has at most.
        features: the features of the games, for kernels that are compiled for them and have all functions inlined, as GPUs
            need it; None for kernels that solve games with any features and take a few seconds to compile, for CPUs.
        steps: the games' number of steps K, with ``features``.
        count: number of threads of a game on a GPU. On a CPU a game has one, unless Warp is set to run blocks of threads
            there (``warp.config.enable_cpu_blocks``), as tests of the barriers do.
        backwards: whether a CPU runs the threads of a game in the opposite order, for tests.
    """
    T = wp.float64 if double else wp.float32
    func = functools.partial(wp.func, inline=None if features else False)
    own, pair = (len(features.own), len(features.pair)) if features else (len(OWN), PAIRS)
    fast = layout.fast(agents, own, pair, steps, double, count)
    basics = threads.make(T, agents, fast, backwards)
    games = all_games.make(T, agents, features, steps, basics, func)
    trajectories = all_trajectories.make(T, basics, games, fast, func)
    pairs = pair_features.make(T, func)
    residuals = all_residuals.make(T, games)
    places = all_places.make(T, basics, games, fast, func)
    expand_pairs = pair_expansions.make(T, basics, games, pairs, trajectories, places, func).expand_pairs
    expansion = expansions.make(T, basics, games, residuals, trajectories, places, fast, func)
    totals = all_totals.make(T, basics, games)
    recursion = recursions.make(T, agents, fast, backwards)
    products = all_products.make(T, basics, games, func)
    pair_adjoint = pair_adjoints.make(T, basics, games, pairs, trajectories, products, func).pair_adjoint
    position_adjoint = position_adjoints.make(T, basics, games, trajectories, products, func).position_adjoint
    adjoint = adjoints.make(T, basics, games, residuals, trajectories, products, func)
    sync, lane, fast_memory, fast_numbers = basics.sync, basics.lane, basics.fast_memory, basics.fast_numbers
    Game, Run, Gradients, part, set_up = games.Game, games.Run, games.Gradients, games.part, games.set_up
    pair_count = games.pair_count
    end_of, valid, horizon = games.end_of, games.valid, games.horizon
    path_of, trace, roll = trajectories.path_of, trajectories.trace, trajectories.roll
    copy_weights = places.copy_weights
    expand_controls, expand_states = expansion.expand_controls, expansion.expand_states
    total, squared_slope = totals.total, totals.squared_slope
    begin, add_slopes, eliminate, pull, push = (
        recursion.begin,
        recursion.add_slopes,
        recursion.eliminate,
        recursion.pull,
        recursion.push,
    )
    roll_tangents, pull_states = trajectories.roll_tangents, trajectories.pull_states
    forget_products, add_products = products.forget_products, products.add_products
    motion_adjoint, control_adjoint = adjoint.motion_adjoint, adjoint.control_adjoint
    registers = 255 if double else REGISTERS[count]
    each_factor = layout.factor_numbers(agents)
    rows = 2 * agents
    together = fast.steps

    @wp.kernel(
        enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False, cuda_max_registers=registers
    )
    def solve(g: Game, run: Run):
        block, _ = wp.tid()
        at = run.at
        K = horizon(g)
        row = g.N * K * 2
        everything = g.G * row
        factors_of_step = each_factor * K
        each_nearest = 4 * g.N * (K + 1)
        work = part(run.work, wp.int64(block) * wp.int64(at.numbers), at.numbers)
        costs = fast_memory(work, at.fast)
        path = path_of(work, costs)
        memory = wp.array(
            ptr=run.numbers.ptr + wp.uint64(block * (4 * g.N + 2) * 4), shape=(4 * g.N + 2,), dtype=wp.int32
        )
        agents = fast_numbers(memory)
        for game in range(block, g.G, run.blocks):
            n = set_up(g, game, agents)
            end = end_of(g, game)
            sound = valid(g, game, n, agents)
            copy_weights(g, game, n, agents, costs)
            status = COMPLETED
            if sound == 0:
                status = STOPPED
            initial = part(run.iterates, wp.int64(0), everything)
            for e in range(lane(), row, wp.block_dim()):
                there = g.present[(game // g.M) * g.N + e // (2 * K)] != wp.uint8(0)
                initial[game * row + e] = wp.where(there, run.start[game * row + e], T(0.0))
            sync()
            slot = wp.where(run.record == 1, game, block)
            flag = 2 * g.N
            # The last turn takes no step: it evaluates the last iterate. Code that is inlined once is shorter than twice.
            for s in range(run.steps + 1):
                stepping = wp.where(s < run.steps, 1, 0)
                controls = part(run.iterates, wp.int64(s) * run.iterate_stride, everything)
                tape = wp.int64(wp.where(run.record == 1, s, 0)) * wp.int64(run.slots) + wp.int64(slot)
                keep = stepping * run.record
                nearest = part(run.nearest, tape * wp.int64(each_nearest * keep), each_nearest)
                factors = part(run.factors, tape * wp.int64(factors_of_step * stepping), factors_of_step)
                roll(g, game, n, agents, at, path, controls)
                positive = int(0)
                attempt = int(0)
                raised = T(0.0)
                while positive == 0 and attempt <= RETRIES:
                    positive = int(1)
                    begin(costs, end)
                    # Backwards in time: the costs of a few steps, then the recursion over them.
                    for back in range((end + together - 1) // together):
                        last = end - back * together
                        first = wp.max(last - together, 0)
                        expand_pairs(g, game, n, agents, at, work, path, costs, first, last)
                        expand_controls(g, game, n, agents, at, work, path, costs, controls, first, last, raised)
                        sync()
                        expand_states(
                            g,
                            game,
                            n,
                            agents,
                            at,
                            work,
                            path,
                            costs,
                            nearest,
                            controls,
                            first,
                            last,
                            end,
                            stepping,
                            keep,
                        )
                        if stepping == 1:
                            solved = eliminate(
                                work, at.linear, costs, factors, run.record, pair_count(g), first, last, end, g.dt
                            )
                            positive = wp.min(positive, solved)
                        else:
                            add_slopes(costs, n, first, last, g.dt)
                    if positive == 0:
                        status = wp.max(status, DAMPED)
                        raised = wp.where(attempt == 0, T(10.0), T(10.0) * raised)
                    attempt += 1
                if s == 0 or stepping == 0:
                    energy = total(at, work, K, end)
                    if lane() == 0:
                        run.energy[game] = energy
                        if s == 0:
                            run.initial_energy[game] = energy
                if stepping == 1:
                    onward = part(run.iterates, wp.int64(s + 1) * run.iterate_stride, everything)
                    directions = part(run.directions, wp.int64(s) * run.direction_stride, everything)
                    for e in range(lane(), row, wp.block_dim()):
                        directions[game * row + e] = T(0.0)
                    sync()
                    push(
                        work,
                        at.linear,
                        costs,
                        factors,
                        end,
                        g.dt,
                        directions,
                        game * row,
                        0,
                        agents,
                        n,
                        K,
                    )
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
            squared = squared_slope(n, costs)
            if lane() == 0:
                run.gradient_norm[game] = wp.sqrt(squared)
                run.status[game] = wp.int64(status)
            for e in range(lane(), 2 * row, wp.block_dim()):
                run.states[game * 2 * row + e] = T(0.0)
            sync()
            for e in range(lane(), n * K * 4, wp.block_dim()):
                q = e % 4
                k = (e // 4) % K
                i = e // (4 * K)
                to = ((game * g.N + agents[i]) * K + k) * 4 + q
                run.states[to] = path[trace(at, K, q, i) + k + 1]
            sync()

    @wp.kernel(
        enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False, cuda_max_registers=registers
    )
    def differentiate(g: Game, run: Run, by: Gradients):
        block, _ = wp.tid()
        at = run.at
        K = horizon(g)
        row = g.N * K * 2
        everything = g.G * row
        factors_of_step = each_factor * K
        each_nearest = 4 * g.N * (K + 1)
        work = part(run.work, wp.int64(block) * wp.int64(at.numbers), at.numbers)
        costs = fast_memory(work, at.fast)
        path = path_of(work, costs)
        memory = wp.array(
            ptr=run.numbers.ptr + wp.uint64(block * (4 * g.N + 2) * 4), shape=(4 * g.N + 2,), dtype=wp.int32
        )
        agents = fast_numbers(memory)
        for game in range(block, g.G, run.blocks):
            n = set_up(g, game, agents)
            end = end_of(g, game)
            for turn in range(run.steps + 1):
                s = run.steps - turn
                # A step that was not taken passes its cotangent on unchanged.
                active = by.along_states
                if s < run.steps:
                    active = run.taken[s * g.G + game]
                if active == 1:
                    controls = part(run.iterates, wp.int64(s) * run.iterate_stride, everything)
                    roll(g, game, n, agents, at, path, controls)
                    if s == run.steps:
                        pull_states(g, by, game, n, agents, at, work, path)
                    else:
                        directions = part(run.directions, wp.int64(s) * run.direction_stride, everything)
                        tape = wp.int64(s) * wp.int64(run.slots) + wp.int64(game)
                        factors = part(run.factors, tape * wp.int64(factors_of_step), factors_of_step)
                        nearest = part(run.nearest, tape * wp.int64(each_nearest), each_nearest)
                        # mu = alpha H^-1 times the cotangent; zero after the end of the game.
                        m = 2 * n
                        for e in range(lane(), m * K, wp.block_dim()):
                            work[at.mu + e] = T(0.0)
                        for e in range(lane(), rows * end, wp.block_dim()):
                            k = e // rows
                            r = e - k * rows  # turn rate and acceleration of each agent
                            value = T(0.0)
                            if r < m:
                                u = 2 * ((game * g.N + agents[r // 2]) * K + k) + 1 - r % 2
                                value = -g.step_size * by.controls[u]
                            work[at.linear + e] = value
                        sync()
                        pull(work, at.linear, costs, factors, end, g.dt)
                        push(
                            work,
                            at.linear,
                            costs,
                            factors,
                            end,
                            g.dt,
                            work,
                            at.mu,
                            1,
                            agents,
                            n,
                            K,
                        )
                        roll_tangents(g, game, n, agents, at, work, path, directions)
                        forget_products(g, at, work)
                        if pair_count(g) > 0:
                            pair_adjoint(g, game, n, agents, at, work, path, end)
                        position_adjoint(g, by, game, n, agents, at, work, path, nearest, end)
                        motion_adjoint(g, by, game, n, agents, at, work, path, controls, directions, end)
                        control_adjoint(g, by, game, n, agents, at, work, path, controls, directions, end)
                        add_products(g, by, game, n, agents, at, work, end)
                if by.along_iterates == 1:
                    given = part(by.iterates, wp.int64(s) * wp.int64(everything), everything)
                    for e in range(lane(), row, wp.block_dim()):
                        u = game * row + e
                        by.controls[u] = by.controls[u] + given[u]
                    sync()
            for e in range(lane(), row, wp.block_dim()):
                if g.present[(game // g.M) * g.N + e // (2 * K)] == wp.uint8(0):
                    by.controls[game * row + e] = T(0.0)
            sync()

    return SimpleNamespace(
        solve=solve,
        differentiate=differentiate,
        Game=Game,
        Run=Run,
        Gradients=Gradients,
        threads=count,
        fast=fast,
    )
