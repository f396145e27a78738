"""The damped step as a linear-quadratic problem: the recursions of `kernel/riccati.hpp`, shared out among a game's threads.

The state of n agents with m = 2n controls holds the changes of positions p, of z = (heading, speed), and of the controls c
of the step before:  p+ = p + Z z,  z+ = z + dt c,  c+ = c.  A step eliminates its controls,

    L L' = H_cc,   G = L^-1 H_cx,   P = H_xx - G' G.

P is the lower triangle of a [3m, 3m] array in the order (p, z, c). L [m, m] holds reciprocals on its diagonal; G is [m, 3m].
All arrays are parts of ``fast``, at the places that ``at`` names (``Layout`` in `games.py`). Threads share out their
entries, and a barrier separates what writes an entry from what reads it.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp


@no_type_check
def make(T: Any, threads: SimpleNamespace, Layout: Any, func: Any) -> SimpleNamespace:
    """The recursions for numbers of type ``T``; ``func`` decorates the longer ones."""
    sync, lane = threads.sync, threads.lane
    Array = wp.array(dtype=T)

    @wp.func
    def low(P: Array, ld: int, i: int, j: int):
        if i >= j:
            return P[i * ld + j]
        return P[j * ld + i]

    @func
    def control_block(fast: Array, at: Layout, n: int, dt: T):
        """H_cc from the cost-to-go of the next state and the damped stiffness of the controls."""
        m = 2 * n
        ld = 3 * m
        for e in range(lane(), m * m, wp.block_dim()):
            r = e // m
            s = e - r * m
            if s <= r:
                entry = (
                    dt
                    * (
                        dt * fast[(m + r) * ld + m + s]
                        + fast[(2 * m + r) * ld + m + s]
                        + fast[(2 * m + s) * ld + m + r]
                    )
                    + fast[(2 * m + r) * ld + 2 * m + s]
                )
                if s == r:
                    entry += fast[at.damped + r]
                fast[at.L + r * m + s] = entry
        sync()

    @func
    def factorise(fast: Array, at: Layout, n: int):
        """The Cholesky factor in place, with reciprocals on its diagonal; returns 0 where a pivot is not positive."""
        m = 2 * n
        positive = int(1)
        for j in range(m):
            row = at.L + j * m
            pivot = fast[row + j]
            for k in range(j):
                pivot -= fast[row + k] * fast[row + k]
            if not (pivot > T(0.0)):
                positive = 0
            inverse = T(1.0) / wp.sqrt(pivot)
            sync()
            if lane() == 0:
                fast[row + j] = inverse
            for i in range(j + 1 + lane(), m, wp.block_dim()):
                entry = fast[at.L + i * m + j]
                for k in range(j):
                    entry -= fast[at.L + i * m + k] * fast[row + k]
                fast[at.L + i * m + j] = entry * inverse
            sync()
        return positive

    @func
    def transition(fast: Array, at: Layout, n: int, dt: T):
        """H_cx, written to G, and P <- A' P A, of which the rows of the controls are set by :func:`eliminate`."""
        m = 2 * n
        ld = 3 * m
        for e in range(lane(), m * ld, wp.block_dim()):
            r = e // ld
            c = e - r * ld
            z = (m + r) * ld
            u = (2 * m + r) * ld
            entry = T(0.0)
            if c < m:
                entry = dt * fast[z + c] + fast[u + c]
            elif c < 2 * m:
                a = (c - m) // 2
                by_x = dt * fast[z + 2 * a] + fast[u + 2 * a]
                by_y = dt * fast[z + 2 * a + 1] + fast[u + 2 * a + 1]
                motion = at.Z + 4 * a + 2 * (c - m - 2 * a)
                entry = dt * low(fast, ld, m + r, c) + fast[u + c] + by_x * fast[motion] + by_y * fast[motion + 1]
                if r == 2 * a and c == m + 2 * a + 1:
                    entry += fast[at.coupling + a]
            elif c - 2 * m == r:
                entry = -fast[at.rate_stiffness + r]
            fast[at.G + e] = entry
        sync()
        # H_zp = P_zp + Z' P_pp and H_zz = P_zz + Z' P_pz + H_zp Z. The term Z' P_pz needs the old P_zp and comes first.
        for e in range(lane(), 4 * n * n, wp.block_dim()):
            r = e // m
            s = e - r * m
            if s <= r:
                a = r // 2
                motion = at.Z + 4 * a + 2 * (r - 2 * a)
                other = (m + s) * ld + 2 * a
                fast[(m + r) * ld + m + s] += fast[motion] * fast[other] + fast[motion + 1] * fast[other + 1]
        sync()
        for e in range(lane(), m * m, wp.block_dim()):
            r = e // m
            j = e - r * m
            a = r // 2
            motion = at.Z + 4 * a + 2 * (r - 2 * a)
            x = low(fast, ld, 2 * a, j)
            y = low(fast, ld, 2 * a + 1, j)
            fast[(m + r) * ld + j] += fast[motion] * x + fast[motion + 1] * y
        sync()
        for e in range(lane(), m * m, wp.block_dim()):
            r = e // m
            s = e - r * m
            if s <= r:
                b = s // 2
                motion = at.Z + 4 * b + 2 * (s - 2 * b)
                row = (m + r) * ld
                fast[row + m + s] += fast[row + 2 * b] * fast[motion] + fast[row + 2 * b + 1] * fast[motion + 1]
        sync()

    @func
    def eliminate(fast: Array, at: Layout, n: int):
        """G <- L^-1 G and P <- P - G' G; the last m columns of G are lower triangular."""
        m = 2 * n
        ld = 3 * m
        for c in range(lane(), ld, wp.block_dim()):
            first = wp.max(c - 2 * m, 0)
            for r in range(first, m):
                entry = fast[at.G + r * ld + c]
                for k in range(first, r):
                    entry -= fast[at.L + r * m + k] * fast[at.G + k * ld + c]
                fast[at.G + r * ld + c] = entry * fast[at.L + r * m + r]
        sync()
        # The lower triangle as a rectangle: the rows i and ld - 1 - i have ld + 1 entries together.
        for e in range(lane(), (ld // 2) * (ld + 1), wp.block_dim()):
            short = e // (ld + 1)
            i = ld - 1 - short
            j = e - short * (ld + 1)
            if j > i:
                j -= i + 1
                i = short
            first = wp.max(i - 2 * m, 0)
            entry = T(0.0)
            if i < 2 * m:
                entry = fast[i * ld + j]
            elif i == j:
                entry = fast[at.rate_stiffness + i - 2 * m]
            for k in range(first, m):
                entry -= fast[at.G + k * ld + i] * fast[at.G + k * ld + j]
            fast[i * ld + j] = entry
        sync()

    @func
    def pull(factors: Array, L: int, G: int, fast: Array, at: Layout, n: int, dt: T, first: int, linear: Array, h: int):
        """Linear terms one step back in time: y becomes that of this step's state, and h L^-1 times the gradient by c."""
        m = 2 * n
        ld = 3 * m
        for r in range(lane(), m, wp.block_dim()):
            linear[h + r] = linear[h + r] + dt * fast[at.y + m + r] + fast[at.y + 2 * m + r]
        sync()
        for r in range(m):
            value = linear[h + r] * factors[L + r * m + r]
            sync()
            if lane() == 0:
                linear[h + r] = value
            for q in range(r + 1 + lane(), m, wp.block_dim()):
                linear[h + q] = linear[h + q] - factors[L + q * m + r] * value
            sync()
        if first == 0:
            for r in range(lane(), m, wp.block_dim()):
                a = r // 2
                motion = at.Z + 4 * a + 2 * (r - 2 * a)
                by = at.y + 2 * a
                fast[at.y + m + r] += fast[motion] * fast[by] + fast[motion + 1] * fast[by + 1]
            sync()
            for j in range(lane(), ld, wp.block_dim()):
                entry = T(0.0)
                if j < 2 * m:
                    entry = fast[at.y + j]
                for r in range(wp.max(j - 2 * m, 0), m):
                    entry -= factors[G + r * ld + j] * linear[h + r]
                fast[at.y + j] = entry
            sync()

    @func
    def push(factors: Array, L: int, G: int, fast: Array, at: Layout, n: int, dt: T, first: int, linear: Array, h: int):
        """One step forward in time: the change of the controls, -L^-T (h + G x), in ``fast[at.c]``, and the next state x."""
        m = 2 * n
        ld = 3 * m
        for r in range(lane(), m, wp.block_dim()):
            entry = linear[h + r]
            if first == 0:
                for j in range(2 * m + r + 1):
                    entry += factors[G + r * ld + j] * fast[at.x + j]
            fast[at.c + r] = -entry
        sync()
        for back in range(m):
            r = m - 1 - back
            value = fast[at.c + r] * factors[L + r * m + r]
            sync()
            if lane() == 0:
                fast[at.c + r] = value
            for q in range(lane(), r, wp.block_dim()):
                fast[at.c + q] -= factors[L + r * m + q] * value
            sync()
        for r in range(lane(), m, wp.block_dim()):
            a = r // 2
            axis = r - 2 * a
            z = at.x + m + 2 * a
            motion = at.Z + 4 * a + axis
            fast[at.x + r] += fast[motion] * fast[z] + fast[motion + 2] * fast[z + 1]
        sync()
        for r in range(lane(), m, wp.block_dim()):
            fast[at.x + m + r] += dt * fast[at.c + r]
            fast[at.x + 2 * m + r] = fast[at.c + r]
        sync()

    return SimpleNamespace(
        control_block=control_block,
        factorise=factorise,
        transition=transition,
        eliminate=eliminate,
        pull=pull,
        push=push,
    )
