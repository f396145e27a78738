"""Which record belongs to training, validation and test.

``paper``: validation and test are unseen main games. They differ from the training games only in w and in jitter.
``hard``: the test holds what training never saw: the main games with the most extreme w, and of all games the placements
where the pedestrian crosses about at right angles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from epo_lightning.data.rpi.game import generator

SPLITS = ("paper", "hard")
PARTS = ("train", "val", "test")
PAPER_SIZES = (47822, 6228, 6228)
"""Printed numbers of records of training, validation and test."""
HARD_SECTOR = (75.0, 105.0)
"""|phi| in degrees that ``hard`` keeps for the test."""

Index = NDArray[np.int64]


def games_of(split: str, weights: NDArray[np.float64]) -> dict[str, Index]:
    """Main games of training, validation and test; a tenth of them, at least one, for each of the last two.

    Args:
        split: ``paper`` or ``hard``.
        weights: w of every main game; there are at least three.
    """
    count = len(weights)
    share = max(1, count // 10)
    games = np.arange(count)
    if split == "paper":
        # The games are independent draws: the last ones are as random as any others.
        return {"train": games[: -2 * share], "val": games[-2 * share : -share], "test": games[-share:]}
    by_weight = np.argsort(weights, kind="stable")
    highest = (share + 1) // 2
    lowest = share - highest
    test = np.concatenate([by_weight[:lowest], by_weight[count - highest :]])
    rest = np.setdiff1d(games, test)
    return {"train": rest[:-share], "val": rest[-share:], "test": np.sort(test)}


def assign(
    split: str,
    seed: int,
    weights: NDArray[np.float64],
    game: Index,
    phi: NDArray[np.float64],
    sizes: Sequence[int] | None,
) -> dict[str, Index]:
    """Indices of the records of each part, in the order of the pool.

    Args:
        split: ``paper`` or ``hard``.
        seed: of the subsampling.
        weights: w of every main game.
        game, phi: main game and pedestrian's angle [rad] of every record.
        sizes: most records of each part; None keeps all.
    """
    angle = np.abs(np.degrees(phi))
    sector = (angle >= HARD_SECTOR[0]) & (angle <= HARD_SECTOR[1]) & (split == "hard")
    found = {}
    for number, (part, games) in enumerate(games_of(split, weights).items()):
        mine = np.isin(game, games)
        mine = mine | sector if part == "test" else mine & ~sector
        index = np.flatnonzero(mine)
        if sizes is not None and len(index) > sizes[number]:
            index = np.sort(generator(seed, 1_000_003, number).choice(index, sizes[number], replace=False))
        found[part] = index
    return found
