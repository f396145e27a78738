"""Bounds of signals by kind of agent: pedestrians, cyclists and vehicles have different limits of motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from epo_lightning.checks import is_number
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import KINDS

DEFAULT = "default"
"""Key of the bounds of all kinds that are not named."""

Bound = Sequence[float] | Mapping[str, Sequence[float]]
"""Lowest and highest value of a signal, of all agents or by kind."""


def check_bound(name: str, bound: Any) -> None:
    """Check the bounds of one signal, [lowest, highest] or a mapping of kinds to such pairs.

    Raises:
        ConfigError: a value that is not [lowest, highest], an unknown kind, or kinds without bounds.
    """
    if isinstance(bound, Mapping):
        for kind, pair in bound.items():
            if kind not in (*KINDS, DEFAULT):
                raise ConfigError(f"unknown kind energy.bounds.{name}.{kind}: {nearest(str(kind), (*KINDS, DEFAULT))}")
            check_bound(f"{name}.{kind}", pair)
        if missing := [kind for kind in KINDS if kind not in bound and DEFAULT not in bound]:
            raise ConfigError(
                f"energy.bounds.{name} has no bounds of the kind {missing[0]!r}: name it, or add {DEFAULT}: [lowest, "
                "highest]"
            )
        return
    pair = list(bound) if isinstance(bound, Sequence) and not isinstance(bound, str) else []
    if len(pair) != 2 or not all(map(is_number, pair)) or not pair[0] < pair[1]:
        raise ConfigError(f"energy.bounds.{name} must be [lowest, highest], two numbers in rising order, not {bound!r}")


def bounds_of_agents(
    bound: Mapping[str, Sequence[float]], kind: Int[Tensor, "B N"], dtype: torch.dtype
) -> tuple[Float[Tensor, "B 1 N 1"], Float[Tensor, "B 1 N 1"]]:
    """Lowest and highest value of a signal for every agent, by its kind.

    Args:
        bound: bounds by name of a kind.
        kind: indices into :data:`~epo_lightning.scene.KINDS`; of absent agents, any of them.
        dtype: number type of the result.
    """
    table = torch.tensor(
        [list(bound.get(name, bound.get(DEFAULT, ()))) for name in KINDS], dtype=dtype, device=kind.device
    )
    lower, upper = table[kind.long()][:, None, :, None].unbind(-1)
    return lower, upper
