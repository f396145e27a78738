"""The derivative of feedback equilibria of LQ games, compiled: the adjoint of the recursion in :mod:`.compiled`.

A bar marks the derivative of a loss by an array: ``A_bar`` is that by ``A``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from epo_lightning.solvers.feedback.compiled import (
    CONTROL,
    STATE,
    Array,
    Mask,
    add_costs,
    carry,
    close,
    cost_to_go,
    place,
    slopes,
    solve,
    stationarity,
)


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
    """The derivative of :func:`~.compiled.equilibria`, from ``deviation_bar`` [S, K, m].

    The deviation is the controls that the policies choose from x_0 = 0 on. The derivative is right where all offsets are
    zero, as at a solution of the iteration: there the deviation is zero, and depends on the gains and the dynamics only
    through the offsets. Games without a unique equilibrium have zeros.

    Returns:
        the derivatives by ``A``, ``B``, ``own_cost``, ``pair_cost``, ``effort`` and ``push``.
    """
    count, agents, horizon = free.shape
    n, m = STATE * agents, CONTROL * agents
    A_bar, B_bar = np.zeros_like(A), np.zeros_like(B)
    own_bar, pair_bar = np.zeros_like(own_cost), np.zeros_like(pair_cost)
    effort_bar, push_bar = np.zeros_like(effort), np.zeros_like(push)
    values = np.empty((horizon, agents, n, n + 1))
    value, value_bar, ahead = np.empty((agents, n, n + 1)), np.empty((agents, n, n + 1)), np.empty((n, n + 1))
    policy, closed = np.empty((m, n + 1)), np.empty((n, n + 1))
    for s in range(count):
        if not unique[s]:
            continue
        value[:] = 0.0
        for k in range(horizon - 1, -1, -1):
            add_costs(own_cost[s, :, k], pair_cost[s, :, k], rho if free[s, :, k].any() else 0.0, value)
            values[k] = value
            policy[:, :n], policy[:, n] = gains[s, k], offsets[s, k]
            close(A[s, :, k], B[s, :, k], policy, closed)
            for i in range(agents):
                cost_to_go(i, effort[s, i, k], push[s, i, k], rho, policy, closed, value[i], ahead)
        offset_bar = _of_offsets(A[s], B[s], gains[s], deviation_bar[s])
        value_bar[:] = 0.0
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
                value_bar,
                A_bar[s, :, k],
                B_bar[s, :, k],
                effort_bar[s, :, k],
                push_bar[s, :, k],
            )
            _pull_back_costs(value_bar, own_bar[s, :, k], pair_bar[s, :, k])
    return A_bar, B_bar, own_bar, pair_bar, effort_bar, push_bar


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
    close(A, B, policy, closed)
    _transpose(policy, policy_turned)
    _transpose(closed, closed_turned)
    for r in range(m):
        policy_bar[r, n] = offset_bar[r]
    # V = F' ahead + G_i' (R_i [G_i | f_i] + [0 | r_i]) + rho G' [G | f], with ahead = V [F | B f] + [0 | v].
    for i in range(agents):
        by_value[:] = value_bar[i]
        by_values += by_value
        _transpose(by_value, value_turned)
        carry(value[i], closed, ahead)
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
    stationarity(A, B, effort, push, rho, free, value, matrix, right_bar)
    right_bar[:] = policy_bar
    solve(matrix.T.copy(), right_bar)
    _add_product(right_bar, policy_turned, m, n + 1, m, -1.0, matrix_bar)
    slope, slope_bar = np.empty((m, n + 1)), np.zeros((m, n + 1))
    slopes(B, value, slope)
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
def _pull_back_costs(value_bar: Array, own_bar: Array, pair_bar: Array) -> None:
    """The derivative of :func:`~.compiled.add_costs`."""
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
                row = place(i, j, a)
                for b in range(2 * STATE):
                    column = place(i, j, b)
                    pair_bar[p, a, b] = value_bar[i, row, column] + value_bar[j, row, column]
                pair_bar[p, a, 2 * STATE] = value_bar[i, row, n] + value_bar[j, row, n]
            p += 1


@njit(cache=True)
def _add_product(left: Array, right: Array, rows: int, inner: int, width: int, scale: float, out: Array) -> None:
    """Add ``scale`` times the product of the first ``inner`` columns of ``left`` and rows of ``right``.

    ``rows`` and ``width`` are the numbers of rows and columns of ``out`` that are computed. The innermost loop adds to
    neighbouring entries, which the compiler vectorises; it may not reorder the sum of a scalar product.
    """
    for i in range(rows):
        for k in range(inner):
            factor = scale * left[i, k]
            if factor != 0.0:
                for j in range(width):
                    out[i, j] += factor * right[k, j]


@njit(cache=True)
def _transpose(matrix: Array, out: Array) -> None:
    """The transpose of ``matrix``, written to ``out``."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[j, i] = matrix[i, j]
