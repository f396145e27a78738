"""Lanes: their geometry, and which of them lead into or lie beside which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

Polyline = Float[np.ndarray, "n 2"]

LANE, SHOULDER = range(2)
"""What a lane is for: driving, or standing in an emergency."""


@dataclass(frozen=True)
class LaneGraph:
    """The lanes of a map. A lane is addressed by its place in these sequences, -1 is none.

    Attributes:
        ids: what the map calls each lane.
        left, right: boundaries of each lane, in driving direction [m].
        centre: centreline of each lane, in driving direction [m].
        successors: lanes that begin where a lane ends.
        left_of, right_of: the lane beside each lane that a vehicle may change to, in the same driving direction.
        adjacent_left, adjacent_right: the same, whether or not the marking between them may be crossed.
        speed_limit: [m/s], NaN where there is none or none is known.
        kind: LANE or SHOULDER.
    """

    ids: Int[np.ndarray, " W"]
    left: Sequence[Polyline]
    right: Sequence[Polyline]
    centre: Sequence[Polyline]
    successors: Sequence[tuple[int, ...]]
    left_of: Int[np.ndarray, " W"]
    right_of: Int[np.ndarray, " W"]
    adjacent_left: Int[np.ndarray, " W"]
    adjacent_right: Int[np.ndarray, " W"]
    speed_limit: Float[np.ndarray, " W"]
    kind: Int[np.ndarray, " W"]

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def predecessors(self) -> tuple[tuple[int, ...], ...]:
        """Lanes that end where a lane begins."""
        found: list[list[int]] = [[] for _ in range(len(self))]
        for lane, following in enumerate(self.successors):
            for successor in following:
                found[successor].append(lane)
        return tuple(tuple(lanes) for lanes in found)
