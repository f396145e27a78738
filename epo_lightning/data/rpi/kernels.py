"""Compiled functions of the game: rollout, costs and their derivatives, and characteristics of trajectories.

Joint states are rows of 8, agent after agent (x, y, heading, speed); joint controls rows of 4 (acceleration, turn
rate). States [K+1, 8] include the start state, which has no cost because it is given. ``c`` is ``GameConstants.array()``,
``goals`` [2, 3] are (x, y, heading) of each agent.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from epo_lightning.data.rpi.game import Array

DT, EFFORT, SLOWNESS, BOUND, TURN_LIMIT, ACCELERATION_LIMIT, SPEED_MIN, SPEED_MAX, TERMINAL, RADIUS = range(10)


@njit(cache=True)
def step(x: Array, u: Array, dt: float, out: Array) -> None:
    """One step of explicit Euler for both unicycles: positions change with the speed and heading before the step."""
    for s in (0, 4):
        a = s // 2
        out[s] = x[s] + dt * x[s + 3] * np.cos(x[s + 2])
        out[s + 1] = x[s + 1] + dt * x[s + 3] * np.sin(x[s + 2])
        out[s + 2] = x[s + 2] + dt * u[a + 1]
        out[s + 3] = x[s + 3] + dt * u[a]


@njit(cache=True)
def rollout(start: Array, u: Array, dt: float) -> Array:
    """States [K+1, 8] from a start state [8] and controls [K, 4]."""
    x = np.empty((len(u) + 1, 8))
    x[0] = start
    for k in range(len(u)):
        step(x[k], u[k], dt, x[k + 1])
    return x


@njit(cache=True)
def excess(value: float, low: float, high: float) -> float:
    """Signed distance of ``value`` from the interval [low, high]; zero inside."""
    return min(value - low, 0.0) + max(value - high, 0.0)


@njit(cache=True)
def costs(x: Array, u: Array, c: Array, goals: Array, w: float) -> tuple[float, float, float]:
    """Own cost of the robot, own cost of the pedestrian, and the shared proximity cost."""
    own = np.zeros(2)
    pair = 0.0
    steps = len(u)
    for i in range(2):
        s, a = 4 * i, 2 * i
        total = 0.0
        for k in range(steps):
            acceleration, turn = u[k, a], u[k, a + 1]
            v = x[k + 1, s + 3]
            total += 0.5 * c[EFFORT] * (acceleration**2 + turn**2) + 0.5 * c[SLOWNESS] * v**2
            total += c[BOUND] * excess(turn, -c[TURN_LIMIT], c[TURN_LIMIT]) ** 2
            total += c[BOUND] * excess(acceleration, -c[ACCELERATION_LIMIT], c[ACCELERATION_LIMIT]) ** 2
            total += c[BOUND] * excess(v, c[SPEED_MIN], c[SPEED_MAX]) ** 2
        for j in range(3):
            total += 0.5 * c[TERMINAL] * (x[steps, s + j] - goals[i, j]) ** 2
        own[i] = total
    for k in range(1, steps + 1):
        distance = np.hypot(x[k, 4] - x[k, 0], x[k, 5] - x[k, 1])
        pair += w * max(0.0, c[RADIUS] - distance) ** 2
    return own[0], own[1], pair


@njit(cache=True)
def linearise(x: Array, c: Array, moves: Array, A: Array, B: Array) -> None:
    """Jacobians A, B of the step. Controls of an agent with ``moves`` 0 are fixed: its columns of B are zero."""
    dt = c[DT]
    A[:] = 0.0
    B[:] = 0.0
    for k in range(len(A)):
        for i in range(2):
            s, a = 4 * i, 2 * i
            cos, sin, v = np.cos(x[k, s + 2]), np.sin(x[k, s + 2]), x[k, s + 3]
            for j in range(s, s + 4):
                A[k, j, j] = 1.0
            A[k, s, s + 2], A[k, s, s + 3] = -dt * v * sin, dt * cos
            A[k, s + 1, s + 2], A[k, s + 1, s + 3] = dt * v * cos, dt * sin
            B[k, s + 3, a] = dt * moves[i]
            B[k, s + 2, a + 1] = dt * moves[i]


@njit(cache=True)
def add_own(i: int, x: Array, u: Array, c: Array, goals: Array, Q: Array, q: Array, R: Array, r: Array) -> None:
    """Add the gradient and the exact Hessian of agent i's own cost."""
    s, a = 4 * i, 2 * i
    steps = len(u)
    for k in range(steps):
        for j in (a, a + 1):
            limit = c[ACCELERATION_LIMIT] if j == a else c[TURN_LIMIT]
            over = excess(u[k, j], -limit, limit)
            r[k, j] += c[EFFORT] * u[k, j] + 2 * c[BOUND] * over
            R[k, j, j] += c[EFFORT] + (2 * c[BOUND] if over != 0.0 else 0.0)
        over = excess(x[k + 1, s + 3], c[SPEED_MIN], c[SPEED_MAX])
        q[k + 1, s + 3] += c[SLOWNESS] * x[k + 1, s + 3] + 2 * c[BOUND] * over
        Q[k + 1, s + 3, s + 3] += c[SLOWNESS] + (2 * c[BOUND] if over != 0.0 else 0.0)
    for j in range(3):
        q[steps, s + j] += c[TERMINAL] * (x[steps, s + j] - goals[i, j])
        Q[steps, s + j, s + j] += c[TERMINAL]


@njit(cache=True)
def add_pair(x: Array, c: Array, w: float, exact: bool, Q: Array, q: Array) -> None:
    """Add gradient and Hessian of the proximity cost w max(0, radius - d)^2; Gauss-Newton unless ``exact``.

    The exact Hessian in the relative position is 2w (n n' - (radius - d) / d (I - n n')) with n the unit vector between
    the agents. Its second term is negative across n, because stepping aside increases the distance; Gauss-Newton drops it.
    """
    block = np.empty((2, 2))
    for k in range(1, len(x)):
        dx, dy = x[k, 4] - x[k, 0], x[k, 5] - x[k, 1]
        distance = np.hypot(dx, dy)
        depth = c[RADIUS] - distance
        if depth <= 0.0 or distance < 1e-9:
            continue
        nx, ny = dx / distance, dy / distance
        across = -depth / distance if exact else 0.0
        block[0, 0] = 2 * w * (nx * nx + across * ny * ny)
        block[1, 1] = 2 * w * (ny * ny + across * nx * nx)
        block[0, 1] = 2 * w * (1.0 - across) * nx * ny
        block[1, 0] = block[0, 1]
        for i in range(2):
            sign = 2 * i - 1
            q[k, 4 * i] -= sign * 2 * w * depth * nx
            q[k, 4 * i + 1] -= sign * 2 * w * depth * ny
            for j in range(2):
                other = sign * (2 * j - 1)
                for row in range(2):
                    for column in range(2):
                        Q[k, 4 * i + row, 4 * j + column] += other * block[row, column]


@njit(cache=True)
def adjoint(A: Array, B: Array, q: Array, r: Array) -> tuple[Array, Array]:
    """Gradient [K, 4] of the total cost in the controls, and the costates [K+1, 8], by the backward recursion."""
    steps, n, m = B.shape
    gradient = np.empty((steps, m))
    costates = q.copy()
    for k in range(steps - 1, -1, -1):
        for i in range(m):
            gradient[k, i] = r[k, i]
            for j in range(n):
                gradient[k, i] += B[k, j, i] * costates[k + 1, j]
        for j in range(n):
            for i in range(n):
                costates[k, i] += A[k, j, i] * costates[k + 1, j]
    return gradient, costates


@njit(cache=True)
def add_curvature(x: Array, c: Array, costates: Array, Q: Array) -> None:
    """Add the second derivatives of the step times the costates, which turn the iteration into Newton's method."""
    dt = c[DT]
    for k in range(len(x) - 1):
        for s in (0, 4):
            cos, sin, v = np.cos(x[k, s + 2]), np.sin(x[k, s + 2]), x[k, s + 3]
            px, py = costates[k + 1, s], costates[k + 1, s + 1]
            Q[k, s + 2, s + 2] -= dt * v * (px * cos + py * sin)
            mixed = dt * (py * cos - px * sin)
            Q[k, s + 2, s + 3] += mixed
            Q[k, s + 3, s + 2] += mixed


@njit(cache=True)
def potential_gradient(x: Array, u: Array, c: Array, goals: Array, w: float) -> Array:
    """Gradient [K, 4] of the potential. Its columns are each agent's unilateral gradient: zero at an open-loop Nash."""
    steps = len(u)
    A, B = np.empty((steps, 8, 8)), np.empty((steps, 8, 4))
    Q, q = np.zeros((steps + 1, 8, 8)), np.zeros((steps + 1, 8))
    R, r = np.zeros((steps, 4, 4)), np.zeros((steps, 4))
    linearise(x, c, np.ones(2), A, B)
    add_own(0, x, u, c, goals, Q, q, R, r)
    add_own(1, x, u, c, goals, Q, q, R, r)
    add_pair(x, c, w, False, Q, q)
    return adjoint(A, B, q, r)[0]


@njit(cache=True)
def passage(x: Array) -> tuple[float, int, float, float]:
    """Smallest distance [m], its step, total rotation [rad] of the line of sight, and smallest speed [m/s].

    The sign of the rotation is the homotopy class: the side on which the agents pass each other.
    """
    smallest, when, rotation, slowest = np.inf, 0, 0.0, np.inf
    for k in range(len(x)):
        dx, dy = x[k, 4] - x[k, 0], x[k, 5] - x[k, 1]
        distance = np.hypot(dx, dy)
        if distance < smallest:
            smallest, when = distance, k
        if k > 0:
            ex, ey = x[k - 1, 4] - x[k - 1, 0], x[k - 1, 5] - x[k - 1, 1]
            rotation += np.arctan2(ex * dy - ey * dx, ex * dx + ey * dy)
        slowest = min(slowest, x[k, 3], x[k, 7])
    return smallest, when, rotation, slowest
