"""The interface of objectives: the training losses of a forecaster's network (Table 1, column 3: imitation, which learns
through the solution, and conditional density estimation, CDE)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from epo_lightning.checks import is_number
from epo_lightning.forecast import JointForecast
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

Terms = dict[str, tuple[float, Tensor]]
"""Weight lambda and value of every named term of a training loss; their weighted sum is minimised, and all are logged."""


class Objective(ABC):
    """The interface of all objectives: weighted, named terms from a scene with its future and a forecast of it.

    Attributes:
        term_names: names of the terms, which are also the names of the weights lambda in the configuration.
        observed_orders: whether games are solved with the observed orders of agents during training, where the energy has
            orders: the games of orders that were not observed have no observed solution.
        through_solution: whether it needs the derivative of the minimiser's solution; otherwise it uses energies alone.
        needs_from_solver: properties (:mod:`epo_lightning.solvers.base`) of which the minimiser must provide at least one;
            empty if nothing is needed.
        needs_from_energy: properties that the energy must offer (:mod:`epo_lightning.game.energy`).
    """

    term_names: ClassVar[tuple[str, ...]]
    through_solution: ClassVar[bool] = False
    observed_orders: ClassVar[bool] = False
    needs_from_solver: ClassVar[frozenset[str]] = frozenset()
    needs_from_energy: ClassVar[frozenset[str]] = frozenset()
    weights: Mapping[str, float]

    @abstractmethod
    def __call__(self, scene: Scene, forecast: JointForecast, energy: Energy, step: int = 0) -> Terms:
        """The terms of a batch.

        Args:
            scene: the scene with its future.
            forecast: the forecast with ``parameters`` and ``solution``, and with ``initial_states`` unless gradients reach
                the initial strategies through the solution.
            energy: the energy that was minimised.
            step: number of optimisation steps so far. In a CUDA graph, a number that is computed from it stays the same,
                unless it is that of a :class:`~epo_lightning.schedules.Schedule` among the attributes of the objective.

        Raises:
            ValueError: the scene has no future.
        """


def checked_weights(
    weights: Mapping[str, float], names: tuple[str, ...], key: str = "objective.weights"
) -> dict[str, float]:
    """The weights lambda: all of ``names`` and no others, each a finite number of 0 or more, not all of them 0.

    Args:
        weights: the configured weights.
        names: names of the terms.
        key: key of the weights in the configuration, for messages.

    Raises:
        ConfigError: a missing or unknown name, a value that is not a weight, or only weights of 0.
    """
    differences = {"unknown": set(weights) - set(names), "missing": set(names) - set(weights)}
    if found := [f"{what}: {', '.join(sorted(some))}" for what, some in differences.items() if some]:
        raise ConfigError(
            f"{key} must name {', '.join(names)} ({'; '.join(found)}); a new term needs an objective of its own "
            "(docs/extend.md)"
        )
    for name, value in weights.items():
        if not is_number(value) or not 0 <= value < math.inf:
            raise ConfigError(f"{key}.{name} must be a number, 0 or more, not {value!r}")
    if not any(weights.values()):
        raise ConfigError(f"{key} are all 0, so there is no loss: give at least one of {list(names)} a positive weight")
    return dict(weights)
