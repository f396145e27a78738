"""The interface of minimisers: maps from an energy and initial strategies to joint strategies (Table 1, column 2).

Minimisers differ in the properties of the energy that they need and in those of the solution that they provide for
learning. Both are declared, so that combinations that cannot work are refused before anything runs
(:mod:`epo_lightning.forecasters.combination`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from epo_lightning.game.energy import Energy
from epo_lightning.scene import GameParameters, Scene, Solution

PATH, STEPS, STATIONARY, SAMPLES, TABLES = "path", "steps", "stationary", "samples", "tables"
"""Properties of a minimiser's solution: a path that can be differentiated; steps that can be interrupted and continued;
strategies with a vanishing gradient; samples of exp(-E); or tables of candidates' energies and log-probabilities."""


class Minimiser(ABC):
    """The interface of all minimisers: callable on an energy, a scene and a game for every mode.

    While gradients are recorded, a minimiser that provides a path returns controls that are differentiable by unrolling;
    others return constants. :mod:`~epo_lightning.solvers.backward` defines the derivative that is used for learning.

    Attributes:
        needs: properties that an energy must offer (:mod:`epo_lightning.game.energy`).
        provides: some of :data:`PATH`, :data:`STEPS`, :data:`STATIONARY`, :data:`SAMPLES` and :data:`TABLES`.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    provides: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Minimise the energy of every scene and mode, starting at ``parameters.initial_controls``.

        Raises:
            ValueError: scene and parameters do not fit together.
        """

    def for_test(self) -> Minimiser:
        """The minimiser to use outside training."""
        return self

    def starts(self, modes: int) -> int:
        """Number of initial strategies per agent for M modes."""
        return modes

    def for_modes(self, modes: int) -> Minimiser:
        """The minimiser for M joint modes."""
        return self

    def games(self, modes: int) -> int:
        """Number of games for M modes: one per mode, or one for all of them."""
        return modes


class Stepwise(Minimiser):
    """A minimiser with S differentiable steps that can be continued: it provides PATH and STEPS."""

    steps: int

    @abstractmethod
    def run(
        self, energy: Energy, scene: Scene, parameters: GameParameters, steps: int, memory: Any = None
    ) -> tuple[Solution, Any]:
        """Take a number of steps; returns the solution, and the memory to continue with.

        Args:
            memory: the memory that an earlier call returned; None at the start.
        """

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Take all S steps; see :meth:`Minimiser.__call__`."""
        return self.run(energy, scene, parameters, self.steps)[0]

    def with_steps(self, steps: int) -> Stepwise:
        """This minimiser with another number of steps."""
        return dataclasses.replace(self, steps=steps)  # type: ignore[type-var]  # minimisers are dataclasses
