"""The definition of interactive scenes with loops and polygons, slow and obvious."""

from __future__ import annotations

import itertools
import math

from epo_lightning.scene import Scene


def interact(scene: Scene, row: int, i: int, j: int, shape: str) -> bool:
    """The definition for one pair, with Python's numbers, a walk along the way, and intersections of polygons."""
    assert scene.future is not None
    assert scene.future_mask is not None
    assert scene.size is not None
    for agent in (i, j):
        if not scene.agent_mask[row, agent] or not scene.future_mask[row, agent].all():
            return False
    steps = scene.future.shape[2]
    ways = [[scene.history[row, agent, -1].tolist(), *scene.future[row, agent].tolist()] for agent in (i, j)]
    sizes = [scene.size[row, agent].tolist() for agent in (i, j)]

    def straight(state: list[float], time: float) -> list[float]:
        x, y, heading, speed = state
        return [x + speed * time * math.cos(heading), y + speed * time * math.sin(heading), heading]

    def walk(way: list[list[float]], time: float) -> list[float]:
        left = max(way[0][3], 0.0) * time
        for one, other in itertools.pairwise(way):
            length = math.hypot(other[0] - one[0], other[1] - one[1])
            if left <= length and length > 0:
                share = left / length
                turn = math.remainder(other[2] - one[2], 2 * math.pi)
                return [
                    one[0] + share * (other[0] - one[0]),
                    one[1] + share * (other[1] - one[1]),
                    one[2] + share * turn,
                ]
            left -= length
        return [way[-1][0] + left * math.cos(way[-1][2]), way[-1][1] + left * math.sin(way[-1][2]), way[-1][2]]

    def overlap(states: list[list[float]]) -> bool:
        if shape == "disc":
            reach = (sizes[0][0] + sizes[1][0]) / 2
            return math.hypot(states[0][0] - states[1][0], states[0][1] - states[1][1]) < reach
        return area(clipped(*(corners(*state[:3], *size) for state, size in zip(states, sizes, strict=True)))) > 1e-9

    moments = [0.1 * number for number in range(1, round((steps * scene.dt + 1.0) / 0.1) + 1)]
    if scene.lanes is None:
        conflict = any(overlap([straight(way[0], time) for way in ways]) for time in moments)
    else:
        conflict = any(overlap([walk(way, time) for way in ways]) for time in moments)
    happened = any(overlap([way[step] for way in ways]) for step in range(steps + 1))
    after = any(
        overlap([straight(way[-1], scene.dt * number) for way in ways])
        for number in range(1, round(1.0 / scene.dt) + 1)
    )
    return conflict and not happened and not after


Point = tuple[float, float]


def corners(x: float, y: float, heading: float, length: float, width: float) -> list[Point]:
    """Corners of a rectangle, counterclockwise."""
    c, s = math.cos(heading), math.sin(heading)
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ends = [(a * length / 2, b * width / 2) for a, b in signs]
    return [(x + c * a - s * b, y + s * a + c * b) for a, b in ends]


def clipped(polygon: list[Point], window: list[Point]) -> list[Point]:
    """The part of a polygon inside a convex one, by Sutherland and Hodgman."""
    for start, end in zip(window, [*window[1:], window[0]], strict=True):

        def side(p: Point, start: Point = start, end: Point = end) -> float:
            return (end[0] - start[0]) * (p[1] - start[1]) - (end[1] - start[1]) * (p[0] - start[0])

        kept: list[Point] = []
        for one, other in zip(polygon, [*polygon[1:], *polygon[:1]], strict=True):
            a, b = side(one), side(other)
            if a >= 0:
                kept.append(one)
            if (a > 0 > b) or (a < 0 < b):
                share = a / (a - b)
                kept.append((one[0] + share * (other[0] - one[0]), one[1] + share * (other[1] - one[1])))
        polygon = kept
    return polygon


def area(polygon: list[Point]) -> float:
    following = [*polygon[1:], *polygon[:1]]
    return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(polygon, following, strict=True))) / 2
