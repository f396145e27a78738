"""A junction, and vehicles that turn there or go straight on."""

from __future__ import annotations

import numpy as np

from epo_lightning.data.recorded.lanes import LaneGraph, Polylines
from epo_lightning.data.recorded.tracks import Recording, TrackTable

from .roads import WIDTH


def graph(centres, successors, left=None, right=None, kind=None) -> LaneGraph:
    """A lane graph of centrelines, with boundaries beside them."""
    count = len(centres)
    centres = [np.asarray(line, dtype=float) for line in centres]
    across = []
    for line in centres:
        way = np.gradient(line, axis=0)
        normal = np.stack([-way[:, 1], way[:, 0]], 1)
        across.append(WIDTH / 2 * normal / np.linalg.norm(normal, axis=1, keepdims=True))
    none = np.full(count, -1)
    left = none if left is None else np.array(left)
    right = none if right is None else np.array(right)
    return LaneGraph(
        np.arange(count),
        [line + side for line, side in zip(centres, across, strict=True)],
        [line - side for line, side in zip(centres, across, strict=True)],
        centres,
        successors,
        left,
        right,
        left,
        right,
        np.full(count, np.nan),
        np.zeros(count, int) if kind is None else np.array(kind),
    ).check("graph")


def crossing() -> LaneGraph:
    """A road that ends in a junction: lanes 1, 4 lead to the left, 2, 5 straight on, and 3, 6 to the right."""
    turn = np.linspace(0, np.pi / 2, 12)
    left = np.stack([12 * np.sin(turn), 12 - 12 * np.cos(turn)], 1)
    right = np.stack([8 * np.sin(turn), 8 * np.cos(turn) - 8], 1)
    return graph(
        [
            np.stack([np.linspace(-60, 0, 13), np.zeros(13)], 1),
            left,
            [[0, 0], [12, 0]],
            right,
            [[12, 12], [12, 150]],
            [[12, 0], [150, 0]],
            [[8, -8], [8, -150]],
        ],
        [(1, 2, 3), (4,), (5,), (6,), (), (), ()],
    )


def turning_traffic(seed: int, name: str = "crossing", rate: float = 5.0, seconds: float = 9.0) -> Recording:
    """Six vehicles that reach a junction one after the other, two on each way, with small offsets from the middle."""
    random = np.random.default_rng(seed)
    lanes = crossing()
    lines = Polylines([np.concatenate([lanes.centre[lane] for lane in (0, way, way + 3)]) for way in (1, 2, 3)])
    time = np.arange(round(seconds * rate) + 1) / rate
    rows = []
    for number in range(6):
        speed = random.uniform(6.0, 9.0)
        along = 2.0 + 8.0 * number + speed * time + 0.2 * np.sin(time)
        line = np.full(len(time), number % 3)
        position, tangent = lines.at(line, along)
        position = position + random.uniform(-0.4, 0.4) * np.stack([-tangent[:, 1], tangent[:, 0]], 1)
        velocity = np.gradient(position, 1 / rate, axis=0)
        heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        rows.append((np.full(len(time), number), np.arange(len(time)), position, heading, velocity))
    agent, frame, position, heading, velocity = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    size, kind = np.tile([4.5, 1.8], (6, 1)), np.zeros(6, dtype=int)
    tracks = TrackTable(rate, agent, frame, position, heading, velocity, np.arange(6), size, kind).check(name)
    return Recording(name, name, tracks, lanes)
