"""Lane polylines around scenes: the pieces that a network gets, and how much of the road they leave out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.data.recorded.tables import SceneTables

FAR = 10.0
"""Distance [m] from the nearest given lane point beyond which an agent's end counts as far from all lanes."""
MOVING = 1.0
"""Displacement [m] within the horizon above which an agent counts as moving."""
CHUNK = 4096
"""Number of scenes whose distances are computed at once, to bound the memory."""


def nearest_pieces(
    polylines: Float[np.ndarray, "T V+1 2"], centre: Float[np.ndarray, "scenes 2"], most: int
) -> Int[np.ndarray, "scenes L"]:
    """Indices of the polylines whose middles are nearest to each centre, nearest first; padded with -1."""
    found = np.full((len(centre), most), -1, dtype=np.int32)
    if len(polylines):
        middle = polylines[:, polylines.shape[1] // 2]
        kept = min(most, len(middle))
        for chunk in range(0, len(centre), CHUNK):
            rows = slice(chunk, chunk + CHUNK)
            distance = ((centre[rows, None] - middle) ** 2).sum(-1)
            found[rows, :kept] = np.argsort(distance, axis=1, kind="stable")[:, :kept]
    return found


def reachable_pieces(
    polylines: Float[np.ndarray, "T V+1 2"],
    position: Float[np.ndarray, "A 2"],
    far: Float[np.ndarray, " A"],
    members: Int[np.ndarray, "scenes N"],
    centre: Float[np.ndarray, "scenes 2"],
) -> Int[np.ndarray, "scenes L"]:
    """Indices of the polylines with a point within reach of an agent of the scene, nearest to the centre first.

    L is the largest number of any scene; the others are padded with -1.

    Args:
        polylines: points of the map's polylines.
        position: position of each agent.
        far: distance [m] within which an agent may be at the end of the horizon.
        members: agents of each scene, -1 for none.
        centre: centre of each scene.
    """
    points = polylines.reshape(-1, 2)
    near = np.zeros((len(position), len(polylines)), dtype=bool)
    for chunk in range(0, len(position), CHUNK // 16):
        rows = slice(chunk, chunk + CHUNK // 16)
        distance = np.linalg.norm(position[rows, None] - points, axis=-1).reshape(
            -1, len(polylines), polylines.shape[1]
        )
        near[rows] = (distance <= far[rows, None, None]).any(-1)
    there = np.zeros((len(members), len(polylines)), dtype=bool)
    for column in members.T:
        there |= near[column] & (column >= 0)[:, None]
    ordered = nearest_pieces(polylines, centre, len(polylines))
    kept = np.take_along_axis(there, ordered, 1)
    count = kept.sum(1)
    # Kept pieces come first, in their order.
    place = np.argsort(~kept, axis=1, kind="stable")[:, : count.max(initial=0)]
    found = np.take_along_axis(ordered, place, 1)
    return np.where(np.arange(place.shape[1]) < count[:, None], found, -1).astype(np.int32)


def far_from_lanes(scenes: SceneTables) -> tuple[int, int]:
    """Numbers of moving agents that end farther than ``FAR`` from every lane point of their scene, and of all moving agents.

    An agent counts once per scene. Without a map, and for agents whose end is not observed, there is nothing to count.
    """
    if not len(scenes.polylines):
        return 0, 0
    end = scenes.future[:, -1, :2]
    moving = scenes.future_mask[:, -1] & (np.linalg.norm(end - scenes.history[:, -1, :2], axis=1) > MOVING)
    far = total = 0
    chunk = max(1, CHUNK // 8)
    for start in range(0, len(scenes), chunk):
        members, lanes = scenes.agents[start : start + chunk], scenes.lanes[start : start + chunk]
        lanes = lanes[:, (lanes >= 0).any(0)]
        counted = (members >= 0) & moving[members]
        points = np.where((lanes >= 0)[..., None, None], scenes.polylines[lanes], np.inf).reshape(len(lanes), -1, 2)
        nearest = np.full(members.shape, np.inf)
        for agent in range(members.shape[1]):  # one agent at a time bounds the memory
            way = points - end[members[:, agent], None]
            nearest[:, agent] = (way**2).sum(-1).min(1, initial=np.inf)
        far += int((counted & (nearest > FAR**2)).sum())
        total += int(counted.sum())
    return far, total
