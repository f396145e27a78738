"""What a minimiser is: it takes an energy and where to start, and returns joint strategies (the paper's Table 1, column 2).

Minimisers differ in what they need of an energy and in what they provide for learning. Both are declared, so that what
cannot work together is refused before anything runs (:mod:`epo_lightning.forecasters.combination`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from epo_lightning.game.energy import Energy
from epo_lightning.scene import GameParameters, Scene, Solution

PATH, STEPS, STATIONARY, SAMPLES, TABLES = "path", "steps", "stationary", "samples", "tables"
"""What a minimiser may provide: a path that can be differentiated; steps of which it can take some and go on; strategies
at which the gradient vanishes; draws from exp(-E); or energies of candidates, with their normalised log-probabilities."""


class Minimiser(ABC):
    """The interface of all minimisers: callable on an energy, a scene and a game for every mode.

    Called while gradients are recorded, a minimiser that provides a path returns controls that are differentiable by
    unrolling; others return constants. :mod:`~epo_lightning.solvers.backward` makes of that what is learned.

    Attributes:
        needs: what an energy has to offer (:mod:`epo_lightning.game.energy`).
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
        """How many initial strategies of every agent it takes for M modes."""
        return modes

    def for_modes(self, modes: int) -> Minimiser:
        """The minimiser for M joint modes."""
        return self

    def games(self, modes: int) -> int:
        """How many games it takes for M modes: one each, or one for all of them."""
        return modes


class Stepwise(Minimiser):
    """A minimiser that takes S differentiable steps, and can go on where it stopped: it provides PATH and STEPS."""

    steps: int

    @abstractmethod
    def run(
        self, energy: Energy, scene: Scene, parameters: GameParameters, steps: int, memory: Any = None
    ) -> tuple[Solution, Any]:
        """Take a number of steps; returns the solution, and the memory with which one would go on.

        Args:
            memory: what an earlier call returned; None at the start.
        """

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Take all S steps; see :meth:`Minimiser.__call__`."""
        return self.run(energy, scene, parameters, self.steps)[0]

    def with_steps(self, steps: int) -> Stepwise:
        """The same with another S."""
        return dataclasses.replace(self, steps=steps)  # type: ignore[type-var]  # minimisers are dataclasses
