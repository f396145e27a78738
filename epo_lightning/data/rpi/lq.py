"""Exact solutions of linear-quadratic problems, which the iterative solvers use in every iteration.

Dynamics x_{k+1} = A_k x_k + B_k u_k, k = 0 .. K-1, and costs

    sum_k 1/2 x_k' Q_k x_k + q_k' x_k  (k = 0 .. K)  +  sum_k 1/2 u_k' R_k u_k + r_k' u_k  (k = 0 .. K-1).

Both functions return an affine policy u_k = G_k x_k + f_k. Shapes: A [K, n, n], B [K, n, m], Q [K+1, n, n], q [K+1, n],
R [K, m, m], r [K, m]; with a leading dimension of players on Q, q, R, r in a game. ``lq_game`` works for any n, m and
number of players, ``lq_minimum`` for the 8 states and 4 controls of two unicycles.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from epo_lightning.data.rpi.game import Array

STATES, CONTROLS = 8, 4
"""Sizes n and m of the joint states and controls of two unicycles."""


@njit(cache=True)
def transposed_product(a: Array, b: Array, out: Array, rows: int, columns: int, width: int) -> None:
    """out = a' b for ``a`` [rows, columns] and ``b`` [rows, width], without zeros: most entries of a unicycle's are zero."""
    for i in range(columns):
        for j in range(width):
            out[i, j] = 0.0
    for k in range(rows):
        for i in range(columns):
            factor = a[k, i]
            if factor != 0.0:
                for j in range(width):
                    out[i, j] += factor * b[k, j]


@njit(cache=True)
def transpose(a: Array, out: Array) -> None:
    """out = a'."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]


# Pivots are checked, so that no division by zero can happen: error_model="numpy" leaves out the check of each division.
@njit(cache=True, error_model="numpy")
def solve_positive(a: Array, b: Array) -> bool:
    """Overwrite ``b`` with a^-1 b by Cholesky, ``a`` with its factor; False if ``a`` is not positive definite."""
    n = a.shape[0]
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        if not pivot > 1e-10:
            return False
        pivot = np.sqrt(pivot)
        a[j, j] = pivot
        for i in range(j + 1, n):
            entry = a[i, j]
            for k in range(j):
                entry -= a[i, k] * a[j, k]
            a[i, j] = entry / pivot
    for i in range(n):
        for k in range(i):
            for j in range(b.shape[1]):
                b[i, j] -= a[i, k] * b[k, j]
        for j in range(b.shape[1]):
            b[i, j] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for j in range(b.shape[1]):
                b[i, j] -= a[k, i] * b[k, j]
        for j in range(b.shape[1]):
            b[i, j] /= a[i, i]
    return True


@njit(cache=True)
def solve_general(a: Array, b: Array) -> bool:
    """Overwrite ``b`` with a^-1 b by Gaussian elimination with row pivoting; False if ``a`` is singular."""
    n = a.shape[0]
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(a[i, j]) > abs(a[best, j]):
                best = i
        if not abs(a[best, j]) > 1e-12:
            return False
        if best != j:
            for k in range(n):
                a[j, k], a[best, k] = a[best, k], a[j, k]
            for k in range(b.shape[1]):
                b[j, k], b[best, k] = b[best, k], b[j, k]
        for i in range(j + 1, n):
            factor = a[i, j] / a[j, j]
            if factor != 0.0:
                for k in range(j, n):
                    a[i, k] -= factor * a[j, k]
                for k in range(b.shape[1]):
                    b[i, k] -= factor * b[j, k]
    for i in range(n - 1, -1, -1):
        for j in range(b.shape[1]):
            for k in range(i + 1, n):
                b[i, j] -= a[i, k] * b[k, j]
            b[i, j] /= a[i, i]
    return True


@njit(cache=True, error_model="numpy")
def lq_minimum(
    A: Array, B: Array, Q: Array, q: Array, R: Array, r: Array, damping: float
) -> tuple[bool, Array, Array, float]:
    """Minimiser of one LQ problem, by the Riccati recursion; for a potential game, its open-loop Nash equilibrium.

    ``damping`` is added to the curvature in the controls (Levenberg). Sizes are constants, n = 8 and m = 4, so that the
    compiler unrolls and vectorises the inner loops: nearly all the time of a generation is spent here.

    Returns:
        whether every step was strictly convex, the gains G [K, m, n], the offsets f [K, m], and the decrease of the cost
        predicted by the first-order terms (the sum of -f' Q_u, positive).
    """
    steps = len(B)
    gains, offsets = np.zeros((steps, CONTROLS, STATES)), np.zeros((steps, CONTROLS))
    value, slope, new_slope = Q[steps].copy(), q[steps].copy(), np.empty(STATES)
    va, av, axx = np.empty((STATES, STATES)), np.empty((STATES, STATES)), np.empty((STATES, STATES))
    bv, vb = np.empty((CONTROLS, STATES)), np.empty((STATES, CONTROLS))
    qux, quu, qu = np.empty((CONTROLS, STATES)), np.empty((CONTROLS, CONTROLS)), np.empty(CONTROLS)
    half, factor = np.empty((CONTROLS, STATES)), np.empty((CONTROLS, CONTROLS))
    right = np.empty((CONTROLS, STATES + 1))
    promised = 0.0
    for k in range(steps - 1, -1, -1):
        transposed_product(A[k], value, av, STATES, STATES, STATES)
        transpose(av, va)
        transposed_product(A[k], va, axx, STATES, STATES, STATES)
        transposed_product(B[k], value, bv, STATES, CONTROLS, STATES)
        transpose(bv, vb)
        transposed_product(B[k], va, qux, STATES, CONTROLS, STATES)
        transposed_product(B[k], vb, quu, STATES, CONTROLS, CONTROLS)
        for i in range(CONTROLS):
            entry = r[k, i]
            for j in range(STATES):
                entry += B[k, j, i] * slope[j]
            qu[i] = entry
            for j in range(CONTROLS):
                quu[i, j] += R[k, i, j]
                factor[i, j] = quu[i, j]
            factor[i, i] += damping
            for j in range(STATES):
                right[i, j] = -qux[i, j]
            right[i, STATES] = -qu[i]
        if not solve_positive(factor, right):
            return False, gains, offsets, 0.0
        for i in range(CONTROLS):
            for j in range(STATES):
                gains[k, i, j] = right[i, j]
            offsets[k, i] = right[i, STATES]
            promised -= right[i, STATES] * qu[i]
        # V = Q_xx + G'(Q_uu G + Q_ux) + Q_ux' G and v = Q_x + G'(Q_uu f + Q_u) + Q_ux' f: exact under damping too.
        for i in range(CONTROLS):
            push = qu[i]
            for j in range(CONTROLS):
                push += quu[i, j] * right[j, STATES]
            qu[i] = push
            for j in range(STATES):
                half[i, j] = qux[i, j]
            for other in range(CONTROLS):
                weight = quu[i, other]
                for j in range(STATES):
                    half[i, j] += weight * right[other, j]
        for j in range(STATES):
            entry = q[k, j]
            for i in range(STATES):
                entry += A[k, i, j] * slope[i]
            for i in range(CONTROLS):
                entry += right[i, j] * qu[i] + qux[i, j] * right[i, STATES]
            new_slope[j] = entry
        slope[:] = new_slope
        for i in range(STATES):
            for j in range(STATES):
                value[i, j] = Q[k, i, j] + axx[i, j]
        for other in range(CONTROLS):
            for i in range(STATES):
                gain, mixed = right[other, i], qux[other, i]
                for j in range(STATES):
                    value[i, j] += gain * half[other, j] + mixed * right[other, j]
        for i in range(STATES):
            for j in range(i):
                mean = 0.5 * (value[i, j] + value[j, i])
                value[i, j] = mean
                value[j, i] = mean
    return True, gains, offsets, promised


@njit(cache=True)
def lq_game(A: Array, B: Array, Q: Array, q: Array, R: Array, r: Array, owner: Array) -> tuple[bool, Array, Array]:
    """Feedback Nash equilibrium of an LQ game, by the coupled Riccati recursion (Basar and Olsder, Corollary 6.1).

    At every step each player minimises its own cost to go against the others' policies; the N stationarity conditions
    are linear in the joint policy and are solved together. Here Q [N, K+1, n, n], q [N, K+1, n], R [N, K, m, m],
    r [N, K, m], and ``owner`` [m] says which player chooses each control.

    Returns:
        whether every step had a unique equilibrium, the gains G [K, m, n] and the offsets f [K, m].
    """
    steps, n, m = B.shape
    players = Q.shape[0]
    gains, offsets = np.zeros((steps, m, n)), np.zeros((steps, m))
    value, slope = np.empty((players, n, n)), np.empty((players, n))
    for i in range(players):
        value[i] = Q[i, steps]
        slope[i] = q[i, steps]
    system, right = np.empty((m, m)), np.empty((m, n + 1))
    bv, va, vb, closed = np.empty((m, n)), np.empty((n, n)), np.empty((n, m)), np.empty((n, n))
    mixed, square, product, inner = np.empty((m, n)), np.empty((m, m)), np.empty((n, n)), np.empty((n, n))
    drift, moved = np.empty(n), np.empty(n)
    for k in range(steps - 1, -1, -1):
        for player in range(players):
            transposed_product(B[k], value[player], bv, n, m, n)
            transpose(bv, vb)
            transposed_product(B[k], vb, square, n, m, m)
            transposed_product(vb, A[k], mixed, n, m, n)
            for row in range(m):
                if owner[row] == player:
                    for column in range(m):
                        system[row, column] = square[row, column] + R[player, k, row, column]
                    for column in range(n):
                        right[row, column] = -mixed[row, column]
                    entry = r[player, k, row]
                    for j in range(n):
                        entry += B[k, j, row] * slope[player, j]
                    right[row, n] = -entry
        if not solve_general(system, right):
            return False, gains, offsets
        for row in range(m):
            for column in range(n):
                gains[k, row, column] = right[row, column]
            offsets[k, row] = right[row, n]
        for i in range(n):
            drift[i] = 0.0
            for row in range(m):
                drift[i] += B[k, i, row] * offsets[k, row]
            for j in range(n):
                closed[i, j] = A[k, i, j]
                for row in range(m):
                    closed[i, j] += B[k, i, row] * gains[k, row, j]
        for player in range(players):
            # V = Q + G'RG + F'VF and v = q + G'(r + R f) + F'(v + V drift), with F = A + B G the closed loop.
            for i in range(n):
                moved[i] = slope[player, i]
                for j in range(n):
                    moved[i] += value[player, i, j] * drift[j]
            transposed_product(closed, value[player], product, n, n, n)
            transpose(product, va)
            transposed_product(closed, va, inner, n, n, n)
            for i in range(n):
                slope[player, i] = q[player, k, i]
                for j in range(n):
                    slope[player, i] += closed[j, i] * moved[j]
            for row in range(m):
                push = r[player, k, row]
                for column in range(m):
                    push += R[player, k, row, column] * offsets[k, column]
                for i in range(n):
                    slope[player, i] += gains[k, row, i] * push
            for i in range(n):
                for j in range(n):
                    value[player, i, j] = Q[player, k, i, j] + inner[i, j]
            for row in range(m):
                for column in range(m):
                    weight = R[player, k, row, column]
                    if weight != 0.0:
                        for i in range(n):
                            for j in range(n):
                                value[player, i, j] += weight * gains[k, row, i] * gains[k, column, j]
            for i in range(n):
                for j in range(i):
                    mean = 0.5 * (value[player, i, j] + value[player, j, i])
                    value[player, i, j] = mean
                    value[player, j, i] = mean
    return True, gains, offsets
