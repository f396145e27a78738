"""Rules that assign records to training, validation and test.

``paper``: validation and test are unseen main games, which differ from the training games only in w and in jitter.
``hard``: the test split holds situations without any counterpart in training: the main games with the most extreme w, and
from all games the placements in which the pedestrian crosses at about a right angle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from epo_lightning.data.rpi.game import generator

RULES = ("paper", "hard")
PAPER_SIZES = (47822, 6228, 6228)
"""Numbers of records of training, validation and test that the paper prints."""
HARD_SECTOR = (75.0, 105.0)
"""Range of |phi| [degrees] whose records the rule ``hard`` assigns to the test split."""

Index = NDArray[np.int64]


def games_of(split: str, weights: NDArray[np.float64]) -> dict[str, Index]:
    """Main games of training, validation and test; a tenth of them, at least one, for each of the last two.

    Args:
        split: rule, ``paper`` or ``hard``.
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
    """Indices of the records of each split, in the order of the pool.

    Args:
        split: rule, ``paper`` or ``hard``.
        seed: seed of the random choice of records for splits that have more records than their size.
        weights: w of every main game.
        game, phi: main game and pedestrian's angle [rad] of every record.
        sizes: most records of each split; None keeps all.
    """
    angle = np.abs(np.degrees(phi))
    sector = (angle >= HARD_SECTOR[0]) & (angle <= HARD_SECTOR[1]) & (split == "hard")
    found = {}
    for number, (name, games) in enumerate(games_of(split, weights).items()):
        mine = np.isin(game, games)
        mine = mine | sector if name == "test" else mine & ~sector
        index = np.flatnonzero(mine)
        if sizes is not None and len(index) > sizes[number]:
            index = np.sort(generator(seed, 1_000_003, number).choice(index, sizes[number], replace=False))
        found[name] = index
    return found
