"""The task of a data set: sizes and units of its scenes. A forecaster is built for one task."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from epo_lightning.registry import ConfigError
from epo_lightning.scene import SHAPES


@dataclass(frozen=True)
class Task:
    """Sizes and units of the scenes of a data set.

    Attributes:
        horizon: number K of future steps.
        dt: length of a time step [s].
        subsets: names of the subsets; ``Scene.subset`` holds indices of them. Metrics are also reported for each subset.
        shape: agents' outline in the overlap rates, ``disc`` or ``box``.
        candidates: number G of goal candidates per agent: 0 for data without goals, 1 for a given goal. Scenes with more
            candidates also have reference lines, the line of each candidate, and reference speeds.
        map: whether scenes have lanes.
        scale: unit [m] of positions at inputs and outputs of networks.
        history: number H of observed steps; None if it is not known, as for checkpoints of older versions.

    Raises:
        ConfigError: a size or unit that no scene can have.
    """

    horizon: int
    dt: float
    subsets: tuple[str, ...] = ()
    shape: str = "disc"
    candidates: int = 1
    map: bool = False
    scale: float = 1.0
    history: int | None = None

    def __post_init__(self) -> None:
        if self.horizon < 1 or self.candidates < 0:
            raise ConfigError(
                f"a task has 1 future step or more and 0 goal candidates or more, not horizon={self.horizon}, "
                f"candidates={self.candidates}"
            )
        if self.history is not None and self.history < 1:
            raise ConfigError(f"a task's history must be 1 step or more, not {self.history}")
        for name in ("dt", "scale"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"a task's {name} must be positive and finite, not {getattr(self, name)}")
        if self.shape not in SHAPES:
            raise ConfigError(f"a task's shape must be {' or '.join(SHAPES)}, not {self.shape!r}")
        if taken := {"initial", "own"} & {*self.subsets}:
            raise ConfigError(
                f"a task has a subset {min(taken)!r}, but scores such as initial/minSADE and own/<metric> have this "
                "beginning: choose another name"
            )

    @classmethod
    def from_config(cls, model: Mapping[str, Any]) -> Task:
        """The task in a model's configuration; checkpoints of older versions may lack entries that have a default."""
        values = {name: model[name] for name in TASK_KEYS if name in model}
        return cls(**{**values, "subsets": tuple(values.get("subsets", ()))})

    def to_config(self) -> dict[str, Any]:
        """Plain values, as a checkpoint stores them."""
        return {**dataclasses.asdict(self), "subsets": list(self.subsets)}


TASK_KEYS = tuple(field.name for field in dataclasses.fields(Task))
"""Keys of a model's configuration that belong to its task."""
