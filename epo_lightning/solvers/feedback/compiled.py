"""Compiled functions of LQ games: equilibria, and trajectories that follow their policies.

Letters are those of :mod:`~epo_lightning.solvers.feedback.lq_game`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STATE, CONTROL = 4, 2
"""Numbers of an agent's state and control."""


@njit(cache=True)
def equilibria(
    A: Array, B: Array, own_cost: Array, pair_cost: Array, effort: Array, push: Array, rho: float, free: Mask
) -> tuple[Array, Array, Mask]:
    """Feedback Nash equilibria, by the coupled Riccati recursion (Basar and Olsder, Dynamic Noncooperative Game Theory,
    Corollary 6.1).

    From the last stage to the first: the stationarity conditions of all agents are linear in the joint policy and are solved
    together; then the cost-to-go of every agent is updated.

    Returns:
        gains [S, K, m, n], offsets [S, K, m], and a mask of the games with a unique equilibrium [S].
    """
    count, agents, horizon = free.shape
    n, m = STATE * agents, CONTROL * agents
    gains, offsets = np.zeros((count, horizon, m, n)), np.zeros((count, horizon, m))
    unique = np.ones(count, dtype=np.bool_)
    value, ahead = np.empty((agents, n, n + 1)), np.empty((n, n + 1))
    matrix, policy, closed = np.empty((m, m)), np.empty((m, n + 1)), np.empty((n, n + 1))
    for s in range(count):
        value[:] = 0.0
        for k in range(horizon - 1, -1, -1):
            add_costs(own_cost[s, :, k], pair_cost[s, :, k], rho if free[s, :, k].any() else 0.0, value)
            stationarity(
                A[s, :, k], B[s, :, k], effort[s, :, k], push[s, :, k], rho, free[s, :, k], value, matrix, policy
            )
            if not solve(matrix, policy):
                unique[s] = False
                break
            gains[s, k], offsets[s, k] = policy[:, :n], policy[:, n]
            close(A[s, :, k], B[s, :, k], policy, closed)
            for i in range(agents):
                cost_to_go(i, effort[s, i, k], push[s, i, k], rho, policy, closed, value[i], ahead)
    return gains, offsets, unique


@njit(cache=True)
def add_costs(own: Array, pair: Array, rho: float, value: Array) -> None:
    """Add the costs of a stage to the costs-to-go [V | v]."""
    agents, n = value.shape[0], value.shape[1]
    for i in range(agents):
        for a in range(n):
            value[i, a, a] += rho
        for a in range(STATE):
            for b in range(STATE):
                value[i, STATE * i + a, STATE * i + b] += own[i, a, b]
            value[i, STATE * i + a, n] += own[i, a, STATE]
    p = 0
    for i in range(agents):
        for j in range(i + 1, agents):
            for a in range(2 * STATE):
                row = place(i, j, a)
                for member in (i, j):
                    for b in range(2 * STATE):
                        value[member, row, place(i, j, b)] += pair[p, a, b]
                    value[member, row, n] += pair[p, a, 2 * STATE]
            p += 1


@njit(cache=True)
def place(i: int, j: int, a: int) -> int:
    """The entry of the joint state that is entry ``a`` of the states of the pair (i, j)."""
    return STATE * i + a if a < STATE else STATE * (j - 1) + a


@njit(cache=True)
def slopes(B: Array, value: Array, slope: Array) -> None:
    """B_i' [V_i | v_i] for the controls of every agent."""
    agents = value.shape[0]
    slope[:] = 0.0
    for i in range(agents):
        for r in range(CONTROL):
            for a in range(STATE):
                if B[i, a, r] != 0.0:
                    slope[CONTROL * i + r] += B[i, a, r] * value[i, STATE * i + a]


@njit(cache=True)
def stationarity(
    A: Array, B: Array, effort: Array, push: Array, rho: float, free: Mask, value: Array, matrix: Array, right: Array
) -> None:
    """The linear system of all agents' stationarity conditions: matrix [G | f] = right."""
    agents, n = value.shape[0], value.shape[1]
    slope = np.empty((CONTROL * agents, n + 1))
    slopes(B, value, slope)
    matrix[:] = 0.0
    right[:] = 0.0
    for i in range(agents):
        for r in range(CONTROL):
            row = CONTROL * i + r
            if not free[i]:
                matrix[row, row] = 1.0
                continue
            for j in range(agents):
                for a in range(STATE):
                    entry = slope[row, STATE * j + a]
                    for c in range(CONTROL):
                        matrix[row, CONTROL * j + c] += entry * B[j, a, c]
                    for b in range(STATE):
                        right[row, STATE * j + b] -= entry * A[j, a, b]
            right[row, n] = -slope[row, n] - push[i, r]
            for c in range(CONTROL):
                matrix[row, CONTROL * i + c] += effort[i, r, c]
            matrix[row, row] += rho


@njit(cache=True)
def solve(matrix: Array, right: Array) -> bool:
    """Overwrite ``right`` with matrix^-1 right, by elimination with row pivoting; False if the matrix is singular."""
    m, width = right.shape
    for j in range(m):
        best = j
        for i in range(j + 1, m):
            if abs(matrix[i, j]) > abs(matrix[best, j]):
                best = i
        if not abs(matrix[best, j]) > 1e-12:
            return False
        if best != j:
            for c in range(m):
                matrix[j, c], matrix[best, c] = matrix[best, c], matrix[j, c]
            for c in range(width):
                right[j, c], right[best, c] = right[best, c], right[j, c]
        inverse = 1.0 / matrix[j, j]
        for i in range(m):
            factor = matrix[i, j] * inverse
            if i != j and factor != 0.0:
                for c in range(j, m):
                    matrix[i, c] -= factor * matrix[j, c]
                for c in range(width):
                    right[i, c] -= factor * right[j, c]
        for c in range(j, m):
            matrix[j, c] *= inverse
        for c in range(width):
            right[j, c] *= inverse
    return True


@njit(cache=True)
def close(A: Array, B: Array, policy: Array, closed: Array) -> None:
    """The dynamics under the policies, [A + B G | B f]."""
    agents = A.shape[0]
    closed[:] = 0.0
    for i in range(agents):
        for a in range(STATE):
            row = STATE * i + a
            for b in range(STATE):
                closed[row, STATE * i + b] = A[i, a, b]
            for c in range(CONTROL):
                if B[i, a, c] != 0.0:
                    closed[row] += B[i, a, c] * policy[CONTROL * i + c]


@njit(cache=True)
def carry(value: Array, closed: Array, ahead: Array) -> None:
    """ahead = [V (A + B G) | V B f + v], the gradient of a cost-to-go at the next state, as a function of the state."""
    n = value.shape[0]
    for a in range(n):
        for column in range(n + 1):
            ahead[a, column] = 0.0
        ahead[a, n] = value[a, n]
        for b in range(n):
            entry = value[a, b]
            for column in range(n + 1):
                ahead[a, column] += entry * closed[b, column]


@njit(cache=True)
def cost_to_go(
    i: int, effort: Array, push: Array, rho: float, policy: Array, closed: Array, value: Array, ahead: Array
) -> None:
    """Overwrite the cost-to-go [V | v] of agent i by that of the state before; ``ahead`` is an array to work in."""
    n, m = closed.shape[0], policy.shape[0]
    carry(value, closed, ahead)
    value[:] = 0.0
    for a in range(n):
        for b in range(n):
            entry = closed[a, b]
            if entry != 0.0:
                for column in range(n + 1):
                    value[b, column] += entry * ahead[a, column]
    for r in range(m):
        own = r - CONTROL * i
        for column in range(n + 1):
            entry = rho * policy[r, column]
            if 0 <= own < CONTROL:
                for c in range(CONTROL):
                    entry += effort[own, c] * policy[CONTROL * i + c, column]
                if column == n:
                    entry += push[own]
            for b in range(n):
                value[b, column] += policy[r, b] * entry


@njit(cache=True)
def follow(
    start: Array, states: Array, controls: Array, gains: Array, offsets: Array, length: Array, dt: float, beta: float
) -> tuple[Array, Array]:
    """Trajectories of unicycles that follow policies around given ones.

    Args:
        start: states x_0 [S, N, 4].
        states, controls: the given trajectories [S, N, K, 4] and [S, N, K, 2].
        gains, offsets: the policies.
        length: factor of the offsets [S].
        dt, beta: time step [s], and the share of the velocity before a step in its displacement.

    Returns:
        their states and controls.
    """
    count, agents, horizon = controls.shape[:3]
    visited, chosen = np.empty_like(states), np.empty_like(controls)
    away = np.empty(STATE * agents)
    for s in range(count):
        for k in range(horizon):
            for i in range(agents):
                for a in range(STATE):
                    away[STATE * i + a] = 0.0 if k == 0 else visited[s, i, k - 1, a] - states[s, i, k - 1, a]
            for i in range(agents):
                for c in range(CONTROL):
                    change = length[s] * offsets[s, k, CONTROL * i + c]
                    for a in range(STATE * agents):
                        change += gains[s, k, CONTROL * i + c, a] * away[a]
                    chosen[s, i, k, c] = controls[s, i, k, c] + change
                x, y, heading, speed = start[s, i] if k == 0 else visited[s, i, k - 1]
                turned, faster = heading + dt * chosen[s, i, k, 1], speed + dt * chosen[s, i, k, 0]
                ahead_x = beta * speed * np.cos(heading) + (1.0 - beta) * faster * np.cos(turned)
                ahead_y = beta * speed * np.sin(heading) + (1.0 - beta) * faster * np.sin(turned)
                visited[s, i, k, 0], visited[s, i, k, 1] = x + dt * ahead_x, y + dt * ahead_y
                visited[s, i, k, 2], visited[s, i, k, 3] = turned, faster
    return visited, chosen
