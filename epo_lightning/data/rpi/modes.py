"""Modes: the homotopy classes of joint trajectories, which differ in the side on which the agents pass each other.

Two joint trajectories belong to one mode if one can be deformed into the other without a collision. For two agents in the
plane, the sign of the total rotation of the line of sight from robot to pedestrian decides. On main games, DBSCAN over whole
trajectories (Peters, 2020) finds the same clusters, but it needs a radius.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epo_lightning.data.rpi.game import DISC_DIAMETER, GameConstants
from epo_lightning.data.rpi.solve import Solutions

CLASSES = (1, -1)
"""Signs of the rotation of the line of sight."""
TIE = 1e-6
"""Relative difference of costs below which the solution from the earlier start strategy is taken."""


def admissible(solutions: Solutions, constants: GameConstants) -> NDArray[np.bool_]:
    """Mask [starts] of the solutions that may become modes: converged, without contact, without driving backwards."""
    return solutions.converged & (solutions.distance > DISC_DIAMETER) & (solutions.speed >= constants.speed_min)


def cheapest(solutions: Solutions, constants: GameConstants) -> dict[int, int]:
    """Index of the cheapest admissible solution of each homotopy class (+1, -1) that was found.

    Solutions of equal cost are the same up to the solver's tolerance. The one from the earliest start strategy is taken, so
    that a strategy that is being executed does not change by rounding.
    """
    good = admissible(solutions, constants)
    found = {}
    for side in CLASSES:
        members = np.flatnonzero(good & (np.sign(solutions.rotation) == side))
        if len(members):
            costs = solutions.potential[members]
            found[side] = int(members[np.argmax(costs <= costs.min() * (1 + TIE))])
    return found
