"""The interface of minimisers (solvers): from an energy and initial strategies to joint strategies (Table 1, column 2).

Minimisers differ in what they need from the energy and in what their solution provides for learning. Both are declared, so
that combinations that cannot work are refused before anything runs
(:mod:`epo_lightning.forecasters.combination`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from torch import Tensor

from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.energy import Energy
from epo_lightning.scene import Scene

PATH, STEPS, STATIONARY, SAMPLES, TABLES = "path", "steps", "stationary", "samples", "tables"
"""Properties that a minimiser can provide. PATH: its steps can be differentiated. STEPS: they can be interrupted and
continued. STATIONARY: dE/du vanishes at its solution, or it attaches a derivative of its own. SAMPLES: the solution is a
sample of exp(-E). TABLES: the solution has energies and log-probabilities of candidates."""


class Minimiser(ABC):
    """The interface of all minimisers: callable on an energy, a scene and a game for every mode.

    While gradients are recorded, a minimiser that provides a path returns controls that are differentiable by unrolling;
    others return constants. :mod:`~epo_lightning.solvers.backward` defines the derivative that is used for learning.

    Attributes:
        needs_from_energy: properties that the energy must offer (:mod:`epo_lightning.game.energy`).
    """

    needs_from_energy: ClassVar[frozenset[str]] = frozenset()

    @property
    def provides(self) -> frozenset[str]:
        """Properties of the solution: :data:`PATH`, :data:`STEPS`, :data:`STATIONARY`, :data:`SAMPLES`, :data:`TABLES`."""
        return frozenset()

    @property
    def on_host(self) -> bool:
        """Whether games on a GPU are copied to the CPU and solved there."""
        return False

    @abstractmethod
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Minimise the energy of every scene and mode, starting at ``parameters.initial_controls``.

        Raises:
            ValueError: scene and parameters do not fit together.
        """

    def check(self, energy: Energy) -> None:  # noqa: B027 - most minimisers take every energy that offers what they need
        """Refuse an energy that offers what is needed, but not with these settings of both.

        Raises:
            ConfigError: the setting, and what it may be.
        """

    def attach(
        self, energy: Energy, scene: Scene, parameters: GameParameters, solution: Solution, exact: bool
    ) -> tuple[Tensor, Tensor] | None:
        """The controls of a solution with their implicit derivative, and a status, for solutions that are no minima of E.

        Args:
            energy, scene, parameters: the game.
            solution: the solution of the game.
            exact: whether second derivatives of residuals are part of the Hessian.

        Returns:
            None for minima of E, the usual case: then :mod:`~epo_lightning.solvers.backward` knows the derivative.
        """
        return None

    def for_test(self) -> Minimiser:
        """The minimiser to use outside training."""
        return self

    def descent(self) -> Minimiser:
        """A minimiser that, in each mode, descends from that mode's initial strategy to a minimum; most minimisers do so."""
        return self

    def near_minimum(self) -> Minimiser:
        """The minimiser to use from initial strategies that are near a minimum; it may take fewer steps."""
        return self

    def strategies(self, modes: int) -> int:
        """Number of initial strategies per agent for M modes."""
        return modes

    def for_modes(self, modes: int) -> Minimiser:
        """This minimiser, set up to return M joint modes; only minimisers that choose among candidates differ."""
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
        """Take a number of steps; returns the solution, and a memory with which another call continues.

        Args:
            memory: the memory that an earlier call returned (such as the adaptive damping); None at the start.
        """

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Take all S steps; see :meth:`Minimiser.__call__`."""
        return self.run(energy, scene, parameters, self.steps)[0]

    def with_steps(self, steps: int) -> Stepwise:
        """This minimiser with another number of steps."""
        return dataclasses.replace(self, steps=steps)  # type: ignore[type-var]  # minimisers are dataclasses
