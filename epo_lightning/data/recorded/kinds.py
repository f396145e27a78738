"""Kinds of agents: their sizes where a format gives none, and the names that formats have for them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

import numpy as np
from jaxtyping import Float, Int

from epo_lightning.scene import KINDS

TYPICAL_SIZE: Mapping[str, tuple[float, float]] = {
    "car": (4.5, 1.8),
    "van": (5.5, 2.0),
    "truck": (10.0, 2.5),
    "bus": (12.0, 2.5),
    "motorcycle": (2.2, 0.9),
    "bicycle": (1.8, 0.7),
    "pedestrian": (0.5, 0.5),
    "other": (1.0, 1.0),
}
"""Length and width [m] of agents whose size is not recorded, by kind."""


def typical_sizes(kind: Int[np.ndarray, " A"]) -> Float[np.ndarray, "A 2"]:
    """Typical length and width [m] of agents by kind, for formats without sizes.

    Args:
        kind: indices into :data:`~epo_lightning.scene.KINDS`.
    """
    return np.array([TYPICAL_SIZE[name] for name in KINDS])[kind].reshape(-1, 2)


def completed_sizes(
    size: Float[np.ndarray, "A 2"],
    kind: Int[np.ndarray, " A"],
    dropped: Counter[str],
    of: Collection[str] = tuple(TYPICAL_SIZE),
) -> Float[np.ndarray, "A 2"]:
    """Sizes, with the typical one of its kind for each agent whose length and width are both 0.

    Args:
        size: recorded length and width [m].
        kind: indices into :data:`~epo_lightning.scene.KINDS`.
        dropped: the numbers of completed sizes are added to it, by kind.
        of: kinds that a format may leave without a size; zeros of other kinds stay, and are an error of the recording.
    """
    size = np.array(size, dtype=float)
    without = (size == 0).all(1)
    for name in of:
        chosen = without & (kind == KINDS.index(name))
        if chosen.any():
            length, width = TYPICAL_SIZE[name]
            size[chosen] = length, width
            dropped[f"{name}s without a size, taken as {length} x {width} m"] += int(chosen.sum())
    return size


def kinds_of(
    names: Iterable[str], dropped: Counter[str], aliases: Mapping[str, str] | None = None
) -> Int[np.ndarray, " A"]:
    """Kinds of agents as indices into :data:`~epo_lightning.scene.KINDS`, by their names in a file.

    Args:
        names: one per agent; letter case and surrounding spaces do not matter.
        dropped: the number of unknown names is added to it; these agents are ``other``.
        aliases: kinds by further names, in lower case.
    """
    number = {kind: index for index, kind in enumerate(KINDS)}
    number |= {name: number[kind] for name, kind in (aliases or {}).items()}
    kinds = np.array([number.get(name.strip().lower(), -1) for name in names], dtype=int)
    if unknown := int((kinds < 0).sum()):
        dropped["agents of a class that is unknown, taken as 'other'"] += unknown
    return np.where(kinds < 0, number["other"], kinds)
