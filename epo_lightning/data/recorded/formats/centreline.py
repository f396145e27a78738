"""Centreline of a lanelet, as the Lanelet2 library computes it (lanelet2_core, Lanelet.cpp).

A *rung* is a line between a point of the left and a point of the right boundary. The midpoints of the rungs are the
centreline.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from epo_lightning.data.recorded.lanes import Polyline


@njit(cache=True)
def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> float:
    """Cross product that is positive if a point is left of the line from a to b."""
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])


@njit(cache=True)
def _between(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point of the line through a and b lies between them."""
    return min(a[0], b[0]) <= point[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= point[1] <= max(a[1], b[1])


@njit(cache=True)
def _meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """Whether the segments from a to b and from c to d have a point in common."""
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    c_side, d_side = _side(a, b, c), _side(a, b, d)
    a_side, b_side = _side(c, d, a), _side(c, d, b)
    if (
        (c_side == 0 and _between(a, b, c))
        or (d_side == 0 and _between(a, b, d))
        or (a_side == 0 and _between(c, d, a))
        or (b_side == 0 and _between(c, d, b))
    ):
        return True
    return (c_side > 0) != (d_side > 0) and (a_side > 0) != (b_side > 0) and c_side * d_side * a_side * b_side != 0


@njit(cache=True)
def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return a[0] == b[0] and a[1] == b[1]


@njit(cache=True)
def _clear(
    last: np.ndarray, middle: np.ndarray, near: np.ndarray, far: np.ndarray, end: np.ndarray, line: np.ndarray
) -> bool:
    """Whether neither the step from ``last`` to ``middle`` nor the rung crosses a boundary, except at the rung's end."""
    for k in range(len(line) - 1):
        a, b = line[k], line[k + 1]
        if not _same(a, last) and _meet(last, middle, a, b):
            return False
        if not _same(a, end) and not _same(b, end) and _meet(near, far, a, b):
            return False
    return True


@njit(cache=True)
def _connects(last: np.ndarray, near: np.ndarray, far: np.ndarray, near_line: np.ndarray, far_line: np.ndarray) -> bool:
    """Whether a rung from ``near`` on one boundary to ``far`` on the other, and the centreline from its ``last`` point to
    the middle of the rung, cross neither boundary."""
    middle = 0.5 * (near + far)
    return _clear(last, middle, near, far, near, near_line) and _clear(last, middle, near, far, far, far_line)


@njit(cache=True)
def _next_rung(
    last: np.ndarray, near_line: np.ndarray, near: int, far_line: np.ndarray, far: int, gates: np.ndarray
) -> tuple[int, float]:
    """Index of the nearest point after ``far`` on one boundary that a rung can connect to point ``near`` of the other one,
    and the length of that rung; -1 if there is none. ``gates`` are entry and exit, each with the lanelet to its right."""
    lengths = np.empty(len(far_line))
    lengths[: far + 1] = np.inf
    for k in range(far + 1, len(far_line)):
        lengths[k] = np.hypot(far_line[k, 0] - near_line[near, 0], far_line[k, 1] - near_line[near, 1])
    for _ in range(far + 1, len(far_line)):
        k = int(lengths.argmin())
        middle = 0.5 * (near_line[near] + far_line[k])
        leaves = False
        for gate in range(2):
            if _side(gates[gate, 0], gates[gate, 1], middle) > 0 and _meet(
                last, middle, gates[gate, 0], gates[gate, 1]
            ):
                leaves = True
        if not leaves and _connects(last, near_line[near], far_line[k], near_line, far_line):
            return k, lengths[k]
        lengths[k] = np.inf
    return -1, np.inf


@njit(cache=True)
def _climb(left: np.ndarray, right: np.ndarray, touching: bool) -> np.ndarray:
    """The centreline; see :func:`centreline`."""
    gates = np.empty((2, 2, 2))
    gates[0, 0], gates[0, 1] = right[0], left[0]
    gates[1, 0], gates[1, 1] = left[-1], right[-1]
    centre = np.empty((len(left) + len(right), 2))
    centre[0] = 0.5 * (left[0] + right[0])
    count = 1
    at_left, at_right = int(touching), 0
    while True:
        last = centre[count - 1]
        next_left, left_length = _next_rung(last, right, at_right, left, at_left, gates)
        next_right, right_length = _next_rung(last, left, at_left, right, at_right, gates)
        if next_left < 0 and next_right < 0:
            break
        if left_length <= right_length:
            at_left = next_left
        else:
            at_right = next_right
        centre[count] = 0.5 * (left[at_left] + right[at_right])
        count += 1
    if at_left < len(left) - 1 or at_right < len(right) - 1:
        centre[count] = 0.5 * (left[-1] + right[-1])
        count += 1
    return centre[:count]


def centreline(left: Polyline, right: Polyline, touching: bool = False) -> Polyline:
    """The line midway between two boundaries, as the Lanelet2 library computes it.

    From one rung to the next, one end stays and the other end moves to the nearest later point whose rung crosses no
    boundary. Of the two ends, the one is moved that gives the shorter rung.

    Args:
        left, right: boundaries in driving direction [m].
        touching: whether both begin at the same node.
    """
    return _climb(np.ascontiguousarray(left), np.ascontiguousarray(right), touching)
