"""Modes: the different ways in which the agents can pass each other.

Two trajectories are one mode when they can be bent into each other without the agents meeting. With two agents in the plane
that is decided by the sign of the total rotation of the line of sight from robot to pedestrian. On main games DBSCAN
over whole trajectories (Peters, 2020) finds the same clusters, but it needs a radius and this does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epo_lightning.data.rpi.game import GameConstants
from epo_lightning.data.rpi.solve import Solutions

CLASSES = (1, -1)
SMALLEST_DISTANCE = 0.5
"""Solutions in which the agents' discs touch [m] are no ways of passing."""
TIE = 1e-6
"""Relative difference of costs below which the earlier start strategy wins."""


def sound(solutions: Solutions, constants: GameConstants) -> NDArray[np.bool_]:
    """Which solutions may become modes: converged, without contact, without driving backwards. Shape [S]."""
    return solutions.converged & (solutions.distance > SMALLEST_DISTANCE) & (solutions.speed >= constants.speed_min)


def cheapest(solutions: Solutions, constants: GameConstants) -> dict[int, int]:
    """The index of the cheapest sound solution of each homotopy class (+1, -1) that was found.

    Equal costs are the same solution up to the solver's tolerance; the one from the earliest start is kept, so that a
    strategy that is being executed stays what it is to the last bit.
    """
    good = sound(solutions, constants)
    found = {}
    for side in CLASSES:
        members = np.flatnonzero(good & (np.sign(solutions.rotation) == side))
        if len(members):
            costs = solutions.potential[members]
            found[side] = int(members[np.argmax(costs <= costs.min() * (1 + TIE))])
    return found
