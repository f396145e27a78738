"""Trajectories of the unicycle and their tangents along changes of the controls, forwards in time, and the pullback of
cotangents, backwards. All of them are sums along time."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.solvers.gauss_newton.fused_kernel.constants import COSINE, SINE, SPEED, TURN_RATE, TURNED, X, Y
from epo_lightning.solvers.gauss_newton.fused_kernel.layout import Fast


@no_type_check
def make(T: Any, threads: SimpleNamespace, games: SimpleNamespace, fast: Fast, func: Any) -> SimpleNamespace:
    """The functions for numbers of type ``T``, with fast memory for ``fast``; ``func`` decorates the longer ones."""
    sync, lane, sums, sums_back, direction = (
        threads.sync,
        threads.lane,
        threads.sums,
        threads.sums_back,
        threads.direction,
    )
    Game, Gradients, Layout = games.Game, games.Gradients, games.Layout
    Array, Numbers, A, horizon = games.Array, games.Numbers, games.agents, games.horizon
    in_fast_memory = fast.path

    if fast.path < 0:

        @wp.func
        def path_of(work: Array, fast: Array):
            return work

        @wp.func
        def trace(at: Layout, K: int, quantity: int, i: int):
            return at.path + (quantity * A + i) * (K + 1)

    else:

        @wp.func
        def path_of(work: Array, fast: Array):
            """The memory that holds the trajectories."""
            return fast

        @wp.func
        def trace(at: Layout, K: int, quantity: int, i: int):
            """Start of one quantity of agent i's trajectory in it."""
            return in_fast_memory + (quantity * A + i) * (K + 1)

    @func
    def roll(g: Game, game: int, n: int, agents: Numbers, at: Layout, path: Array, controls: Array):
        """Headings and speeds are sums of the controls along time, and positions are sums of the motions that follow.

        The changes are summed on their own: added to a large coordinate, small ones would lose most of their digits.
        """
        K = horizon(g)
        for e in range(lane(), 2 * n, wp.block_dim()):
            i = e // 2
            channel = e - 2 * i
            row = (game // g.M) * g.N + agents[i]
            turning = channel == TURN_RATE
            start = g.initial[4 * row + wp.where(turning, 2, 3)]
            to = trace(at, K, wp.where(turning, TURNED, SPEED), i)
            sums(controls, (game * g.N + agents[i]) * K * 2 + channel, 2, K, start, g.dt, path, to)
        sync()
        for e in range(lane(), n * (K + 1), wp.block_dim()):
            i = e // (K + 1)
            k = e - i * (K + 1)
            sine = trace(at, K, SINE, i) + k
            cosine = trace(at, K, COSINE, i) + k
            direction(path[trace(at, K, TURNED, i) + k], path, sine, cosine)
            along = g.dt * path[trace(at, K, SPEED, i) + k]
            path[trace(at, K, X, i) + k] = along * path[cosine]
            path[trace(at, K, Y, i) + k] = along * path[sine]
        sync()
        for e in range(lane(), 2 * n, wp.block_dim()):
            i = e // 2
            axis = e - 2 * i
            start = g.initial[4 * ((game // g.M) * g.N + agents[i]) + axis]
            to = trace(at, K, wp.where(axis == 0, X, Y), i)
            sums(path, to, 1, K, start, T(1.0), path, to)
        sync()

    @wp.func
    def tangent(at: Layout, K: int, along_d: int, quantity: int, i: int):
        """Start of one quantity of a tangent of agent i's trajectory, along mu or along the step d."""
        return at.tangents + ((4 * along_d + quantity) * A + i) * (K + 1)

    @func
    def roll_tangents(
        g: Game, game: int, n: int, agents: Numbers, at: Layout, work: Array, path: Array, directions: Array
    ):
        """Tangents of the trajectories along mu and along the step d: sums along time, as the trajectories are."""
        K = horizon(g)
        for e in range(lane(), 4 * n, wp.block_dim()):
            i = e // 4
            channel = (e // 2) % 2
            along_d = e % 2
            to = tangent(at, K, along_d, wp.where(channel == TURN_RATE, TURNED, SPEED), i)
            if along_d == 1:
                first = (game * g.N + agents[i]) * K * 2 + channel
                sums(directions, first, 2, K, T(0.0), g.dt, work, to)
            else:
                sums(work, at.mu + 2 * i * K + channel, 2, K, T(0.0), g.dt, work, to)
        sync()
        for e in range(lane(), 2 * n * (K + 1), wp.block_dim()):
            k = e // (2 * n)
            i = (e - k * 2 * n) // 2
            along_d = e % 2
            s = path[trace(at, K, SINE, i) + k]
            c = path[trace(at, K, COSINE, i) + k]
            across = path[trace(at, K, SPEED, i) + k] * work[tangent(at, K, along_d, TURNED, i) + k]
            speed = work[tangent(at, K, along_d, SPEED, i) + k]
            work[tangent(at, K, along_d, X, i) + k] = g.dt * (speed * c - across * s)
            work[tangent(at, K, along_d, Y, i) + k] = g.dt * (speed * s + across * c)
        sync()
        for e in range(lane(), 4 * n, wp.block_dim()):
            i = e // 4
            to = tangent(at, K, e % 2, wp.where((e // 2) % 2 == 0, X, Y), i)
            sums(work, to, 1, K, T(0.0), T(1.0), work, to)
        sync()

    @wp.func
    def along(at: Layout, K: int, quantity: int, i: int):
        """Start of a cotangent along time: of positions 0 and 1, of their tangents along mu 2 and 3 and along d 4 and 5, of
        heading 6 and speed 7."""
        return at.along + (quantity * A + i) * K

    @func
    def pull_states(g: Game, by: Gradients, game: int, n: int, agents: Numbers, at: Layout, work: Array, path: Array):
        """Adds the pullback of the cotangent of the states to that of the controls: sums backwards in time."""
        K = horizon(g)
        for e in range(lane(), 4 * n, wp.block_dim()):
            i = e // 4
            q = e - 4 * i
            first = 4 * (game * g.N + agents[i]) * K + q
            if q < 2:
                sums_back(by.states, first, 4, K, work, along(at, K, q, i))
        sync()
        for e in range(lane(), n * K, wp.block_dim()):
            i = e // K
            k = e - i * K
            first = 4 * ((game * g.N + agents[i]) * K + k)
            heading = by.states[first + 2]
            speed = by.states[first + 3]
            if k + 1 < K:
                c = path[trace(at, K, COSINE, i) + k + 1]
                s = path[trace(at, K, SINE, i) + k + 1]
                x = work[along(at, K, 0, i) + k + 1]
                y = work[along(at, K, 1, i) + k + 1]
                heading += g.dt * path[trace(at, K, SPEED, i) + k + 1] * (c * y - s * x)
                speed += g.dt * (c * x + s * y)
            work[along(at, K, 6, i) + k] = heading
            work[along(at, K, 7, i) + k] = speed
        sync()
        for e in range(lane(), 2 * n, wp.block_dim()):
            i = e // 2
            to = along(at, K, 6 + e - 2 * i, i)
            sums_back(work, to, 1, K, work, to)
        sync()
        for e in range(lane(), 2 * n * K, wp.block_dim()):
            k = e // (2 * n)
            i = (e - k * 2 * n) // 2
            channel = e % 2
            u = 2 * ((game * g.N + agents[i]) * K + k) + channel
            force = work[along(at, K, wp.where(channel == TURN_RATE, 6, 7), i) + k]
            by.controls[u] = by.controls[u] + g.dt * force
        sync()

    return SimpleNamespace(
        path_of=path_of,
        trace=trace,
        roll=roll,
        tangent=tangent,
        roll_tangents=roll_tangents,
        along=along,
        pull_states=pull_states,
    )
