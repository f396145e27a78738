"""Compiled functions of LQ games: equilibria, their derivative, and trajectories that follow their policies.

Letters are those of :mod:`~epo_lightning.solvers.feedback.lq_game`; a bar marks the derivative of a loss by an array.
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
            _add_costs(own_cost[s, :, k], pair_cost[s, :, k], rho if free[s, :, k].any() else 0.0, value)
            _stationarity(
                A[s, :, k], B[s, :, k], effort[s, :, k], push[s, :, k], rho, free[s, :, k], value, matrix, policy
            )
            if not _solve(matrix, policy):
                unique[s] = False
                break
            gains[s, k], offsets[s, k] = policy[:, :n], policy[:, n]
            _close(A[s, :, k], B[s, :, k], policy, closed)
            for i in range(agents):
                _cost_to_go(i, effort[s, i, k], push[s, i, k], rho, policy, closed, value[i], ahead)
    return gains, offsets, unique


@njit(cache=True)
def pull_back(
    A: Array,
    B: Array,
    own_cost: Array,
    pair_cost: Array,
    effort: Array,
    push: Array,
    rho: float,
    free: Mask,
    gains: Array,
    offsets: Array,
    unique: Mask,
    deviation_bar: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """The derivative of :func:`equilibria`, from that by the controls which the policies choose from x_0 = 0 on, [S, K, m].

    It is right where all offsets are zero, as at a solution of the iteration: then the deviation from the trajectory is
    zero, and depends on the gains and the dynamics only through the offsets. Games without a unique equilibrium have zeros.

    Returns:
        the derivatives by ``A``, ``B``, ``own_cost``, ``pair_cost``, ``effort`` and ``push``.
    """
    count, agents, horizon = free.shape
    n, m = STATE * agents, CONTROL * agents
    A_bar, B_bar, own_bar, pair_bar = (
        np.zeros_like(A),
        np.zeros_like(B),
        np.zeros_like(own_cost),
        np.zeros_like(pair_cost),
    )
    effort_bar, push_bar = np.zeros_like(effort), np.zeros_like(push)
    values = np.empty((horizon, agents, n, n + 1))
    value, ahead = np.empty((agents, n, n + 1)), np.empty((n, n + 1))
    policy, closed = np.empty((m, n + 1)), np.empty((n, n + 1))
    for s in range(count):
        if not unique[s]:
            continue
        value[:] = 0.0
        for k in range(horizon - 1, -1, -1):
            _add_costs(own_cost[s, :, k], pair_cost[s, :, k], rho if free[s, :, k].any() else 0.0, value)
            values[k] = value
            policy[:, :n], policy[:, n] = gains[s, k], offsets[s, k]
            _close(A[s, :, k], B[s, :, k], policy, closed)
            for i in range(agents):
                _cost_to_go(i, effort[s, i, k], push[s, i, k], rho, policy, closed, value[i], ahead)
        offset_bar = _of_offsets(A[s], B[s], gains[s], deviation_bar[s])
        value[:] = 0.0  # from here on, the derivative by the cost-to-go
        for k in range(horizon):
            policy[:, :n], policy[:, n] = gains[s, k], offsets[s, k]
            _pull_back_stage(
                A[s, :, k],
                B[s, :, k],
                effort[s, :, k],
                push[s, :, k],
                rho,
                free[s, :, k],
                values[k],
                policy,
                offset_bar[k],
                value,
                A_bar[s, :, k],
                B_bar[s, :, k],
                effort_bar[s, :, k],
                push_bar[s, :, k],
            )
            _pull_back_costs(value, own_bar[s, :, k], pair_bar[s, :, k])
    return A_bar, B_bar, own_bar, pair_bar, effort_bar, push_bar


@njit(cache=True)
def _add_costs(own: Array, pair: Array, rho: float, value: Array) -> None:
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
                row = _place(i, j, a)
                for member in (i, j):
                    for b in range(2 * STATE):
                        value[member, row, _place(i, j, b)] += pair[p, a, b]
                    value[member, row, n] += pair[p, a, 2 * STATE]
            p += 1


@njit(cache=True)
def _pull_back_costs(value_bar: Array, own_bar: Array, pair_bar: Array) -> None:
    """The derivative of :func:`_add_costs`."""
    agents, n = value_bar.shape[0], value_bar.shape[1]
    for i in range(agents):
        for a in range(STATE):
            for b in range(STATE):
                own_bar[i, a, b] = value_bar[i, STATE * i + a, STATE * i + b]
            own_bar[i, a, STATE] = value_bar[i, STATE * i + a, n]
    p = 0
    for i in range(agents):
        for j in range(i + 1, agents):
            for a in range(2 * STATE):
                row = _place(i, j, a)
                for b in range(2 * STATE):
                    column = _place(i, j, b)
                    pair_bar[p, a, b] = value_bar[i, row, column] + value_bar[j, row, column]
                pair_bar[p, a, 2 * STATE] = value_bar[i, row, n] + value_bar[j, row, n]
            p += 1


@njit(cache=True)
def _place(i: int, j: int, a: int) -> int:
    """The entry of the joint state that is entry ``a`` of the states of the pair (i, j)."""
    return STATE * i + a if a < STATE else STATE * (j - 1) + a


@njit(cache=True)
def _slopes(B: Array, value: Array, slope: Array) -> None:
    """B_i' [V_i | v_i] for the controls of every agent."""
    agents = value.shape[0]
    slope[:] = 0.0
    for i in range(agents):
        for r in range(CONTROL):
            for a in range(STATE):
                if B[i, a, r] != 0.0:
                    slope[CONTROL * i + r] += B[i, a, r] * value[i, STATE * i + a]


@njit(cache=True)
def _stationarity(
    A: Array, B: Array, effort: Array, push: Array, rho: float, free: Mask, value: Array, matrix: Array, right: Array
) -> None:
    """The linear system of all agents' stationarity conditions: matrix [G | f] = right."""
    agents, n = value.shape[0], value.shape[1]
    slope = np.empty((CONTROL * agents, n + 1))
    _slopes(B, value, slope)
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
def _solve(matrix: Array, right: Array) -> bool:
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
def _close(A: Array, B: Array, policy: Array, closed: Array) -> None:
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
def _carry(value: Array, closed: Array, ahead: Array) -> None:
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
def _cost_to_go(
    i: int, effort: Array, push: Array, rho: float, policy: Array, closed: Array, value: Array, ahead: Array
) -> None:
    """Overwrite the cost-to-go [V | v] of agent i by that of the state before; ``ahead`` is an array to work in."""
    n, m = closed.shape[0], policy.shape[0]
    _carry(value, closed, ahead)
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
def _of_offsets(A: Array, B: Array, gains: Array, deviation_bar: Array) -> Array:
    """The derivative by the offsets [K, m], from that by the controls that they lead to."""
    horizon, m, n = gains.shape
    agents = len(A)
    offset_bar, state_bar = deviation_bar.copy(), np.zeros(n)
    for k in range(horizon - 1, -1, -1):
        before = np.zeros(n)
        for i in range(agents):
            for a in range(STATE):
                for c in range(CONTROL):
                    offset_bar[k, CONTROL * i + c] += B[i, k, a, c] * state_bar[STATE * i + a]
                for b in range(STATE):
                    before[STATE * i + b] += A[i, k, a, b] * state_bar[STATE * i + a]
        for r in range(m):
            for b in range(n):
                before[b] += gains[k, r, b] * offset_bar[k, r]
        state_bar = before
    return offset_bar


@njit(cache=True)
def _add_product(left: Array, right: Array, rows: int, inner: int, width: int, scale: float, out: Array) -> None:
    """Add ``scale`` times the product of the first ``inner`` columns of ``left`` and rows of ``right``.

    ``rows`` and ``width`` are the numbers of rows and columns that are computed. Numbers are added along rows, which the
    compiler vectorises; sums of products would keep their order.
    """
    for i in range(rows):
        for k in range(inner):
            factor = scale * left[i, k]
            if factor != 0.0:
                for j in range(width):
                    out[i, j] += factor * right[k, j]


@njit(cache=True)
def _transpose(matrix: Array, out: Array) -> None:
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[j, i] = matrix[i, j]


@njit(cache=True)
def _pull_back_stage(
    A: Array,
    B: Array,
    effort: Array,
    push: Array,
    rho: float,
    free: Mask,
    value: Array,
    policy: Array,
    offset_bar: Array,
    value_bar: Array,
    A_bar: Array,
    B_bar: Array,
    effort_bar: Array,
    push_bar: Array,
) -> None:
    """The derivative of one stage of the recursion.

    ``value_bar`` is the derivative by the costs-to-go of the state before the stage, and is overwritten by that of the state
    after it, ``value``. The derivatives by the stage's own arrays are added to those with a bar.
    """
    agents, n = value.shape[0], value.shape[1]
    m = CONTROL * agents
    closed, ahead, ahead_bar = np.empty((n, n + 1)), np.empty((n, n + 1)), np.empty((n, n + 1))
    spent, spent_bar = np.empty((CONTROL, n + 1)), np.empty((CONTROL, n + 1))
    by_value, by_values = np.empty((n, n + 1)), np.zeros((n, n + 1))
    value_turned, policy_turned, closed_turned = np.empty((n + 1, n)), np.empty((n + 1, m)), np.empty((n + 1, n))
    policy_bar, closed_bar = np.zeros((m, n + 1)), np.zeros((n, n + 1))
    _close(A, B, policy, closed)
    _transpose(policy, policy_turned)
    _transpose(closed, closed_turned)
    for r in range(m):
        policy_bar[r, n] = offset_bar[r]
    # V = F' ahead + G_i' (R_i [G_i | f_i] + [0 | r_i]) + rho G' [G | f], with ahead = V [F | B f] + [0 | v].
    for i in range(agents):
        by_value[:] = value_bar[i]
        by_values += by_value
        _transpose(by_value, value_turned)
        _carry(value[i], closed, ahead)
        ahead_bar[:] = 0.0
        _add_product(closed, by_value, n, n, n + 1, 1.0, ahead_bar)
        _add_product(ahead, value_turned, n, n + 1, n, 1.0, closed_bar)
        value_bar[i] = 0.0
        _add_product(ahead_bar, closed_turned, n, n + 1, n, 1.0, value_bar[i])
        for a in range(n):
            value_bar[i, a, n] = ahead_bar[a, n]
            for b in range(n):
                entry = value[i, a, b]
                for column in range(n + 1):
                    closed_bar[b, column] += entry * ahead_bar[a, column]
        first = CONTROL * i
        own, own_bar = policy[first : first + CONTROL], policy_bar[first : first + CONTROL]
        spent[:] = 0.0
        spent_bar[:] = 0.0
        _add_product(effort[i], own, CONTROL, CONTROL, n + 1, 1.0, spent)
        _add_product(own, by_value, CONTROL, n, n + 1, 1.0, spent_bar)
        for r in range(CONTROL):
            spent[r, n] += push[i, r]
            push_bar[i, r] += spent_bar[r, n]
            for c in range(CONTROL):
                for column in range(n + 1):
                    own_bar[c, column] += effort[i, r, c] * spent_bar[r, column]
                    effort_bar[i, r, c] += spent_bar[r, column] * own[c, column]
        _add_product(spent, value_turned, CONTROL, n + 1, n, 1.0, own_bar)
    _transpose(by_values, value_turned)
    _add_product(policy, value_turned, m, n + 1, n, rho, policy_bar)
    _add_product(policy, by_values, m, n, n + 1, rho, policy_bar)
    # [F | B f] = [A | 0] + B [G | f].
    for i in range(agents):
        for a in range(STATE):
            row = STATE * i + a
            for b in range(STATE):
                A_bar[i, a, b] += closed_bar[row, STATE * i + b]
            for c in range(CONTROL):
                for column in range(n + 1):
                    B_bar[i, a, c] += closed_bar[row, column] * policy[CONTROL * i + c, column]
                    policy_bar[CONTROL * i + c, column] += B[i, a, c] * closed_bar[row, column]
    # matrix [G | f] = right.
    matrix, right_bar, matrix_bar = np.empty((m, m)), np.empty((m, n + 1)), np.zeros((m, m))
    _stationarity(A, B, effort, push, rho, free, value, matrix, right_bar)
    right_bar[:] = policy_bar
    _solve(matrix.T.copy(), right_bar)
    _add_product(right_bar, policy_turned, m, n + 1, m, -1.0, matrix_bar)
    slope, slope_bar = np.empty((m, n + 1)), np.zeros((m, n + 1))
    _slopes(B, value, slope)
    # matrix = S B + R, right = -(S [A | 0] + [0 | s + r]) with [S | s] the slopes.
    for i in range(agents):
        if not free[i]:
            continue
        for r in range(CONTROL):
            row = CONTROL * i + r
            for j in range(agents):
                for a in range(STATE):
                    place = STATE * j + a
                    for c in range(CONTROL):
                        bar = matrix_bar[row, CONTROL * j + c]
                        slope_bar[row, place] += bar * B[j, a, c]
                        B_bar[j, a, c] += bar * slope[row, place]
                    for b in range(STATE):
                        bar = right_bar[row, STATE * j + b]
                        slope_bar[row, place] -= bar * A[j, a, b]
                        A_bar[j, a, b] -= bar * slope[row, place]
            slope_bar[row, n] = -right_bar[row, n]
            push_bar[i, r] -= right_bar[row, n]
            for c in range(CONTROL):
                effort_bar[i, r, c] += matrix_bar[row, CONTROL * i + c]
            # [S | s] = B_i' [V_i | v_i].
            for a in range(STATE):
                value_bar[i, STATE * i + a] += B[i, a, r] * slope_bar[row]
                for column in range(n + 1):
                    B_bar[i, a, r] += value[i, STATE * i + a, column] * slope_bar[row, column]


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
