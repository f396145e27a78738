"""What is learned through the solution of a game: the derivative that a minimiser's result is given (Table 1, column 3).

- ``unrolled``, the paper's: the derivative of what was computed, all S steps of it, also by the initial strategies.
- ``truncated``: that of the last few steps, the iterate before them taken as given.
- ``implicit``: that of the minimum which the steps approach (implicit function theorem), whatever led there. It is right
  only where the solution is a minimum, so take many steps: a warning is given, once, where most of a batch are none. A
  sample whose Hessian is not positive definite is no minimum and gets a gradient of zero and the status STOPPED. A minimum
  does not move when all weights of a game are scaled together, so the gradient has no component along them, w . dL/dw = 0:
  their overall scale is not learned and drifts. Fix one weight, or normalise.
- ``detached``: none, for objectives that compare energies instead of solutions.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from epo_lightning.game.energy import GRADIENT, RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, Scene, Solution, Status
from epo_lightning.solvers.base import PATH, STATIONARY, STEPS, TABLES, Minimiser, Stepwise
from epo_lightning.solvers.gauss_newton import implicit
from epo_lightning.solvers.general import dense

HESSIANS = ("exact", "gauss_newton")


class Backward(ABC):
    """The interface: runs a minimiser and gives its solution a derivative.

    Attributes:
        needs: of what a minimiser may provide, any one is enough; nothing if empty.
        teaches: whether anything is learned through the solution.
        teaches_start: whether initial strategies are.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    teaches: ClassVar[bool] = True
    teaches_start: ClassVar[bool] = False

    @property
    def of_energy(self) -> frozenset[str]:
        """What an energy has to offer."""
        return frozenset()

    @abstractmethod
    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """The minimiser's solution, with a derivative."""


@register("backward", "unrolled")
@dataclass(frozen=True)
class Unrolled(Backward):
    """Differentiate every step (Section 4.3)."""

    needs = frozenset({PATH, TABLES})
    teaches_start = True

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        return minimiser(energy, scene, parameters)


@register("backward", "truncated")
@dataclass(frozen=True)
class Truncated(Backward):
    """Differentiate the last steps.

    Attributes:
        steps: how many.
    """

    needs = frozenset({STEPS})

    steps: int = 1

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ConfigError(f"backward.steps must be 1 or more, not {self.steps}")

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        if not isinstance(minimiser, Stepwise):
            raise ValueError(f"{type(minimiser).__name__} takes no steps that could be truncated")
        taught = min(self.steps, minimiser.steps)
        with torch.no_grad():
            first, memory = minimiser.run(energy, scene, parameters, minimiser.steps - taught)
        onward = dataclasses.replace(parameters, initial_controls=first.controls)
        last, _ = minimiser.run(energy, scene, onward, taught, memory)
        return dataclasses.replace(
            last,
            initial_energy=first.initial_energy,
            # Who could take no step at first and went on later was held up, not stopped.
            status=torch.maximum(first.status.clamp_max(Status.DAMPED), last.status),
            iterates=(*first.iterates, *last.iterates[1:]) if first.iterates and last.iterates else None,
        )


@register("backward", "implicit")
@dataclass(frozen=True)
class Implicit(Backward):
    """Differentiate the condition that holds at a minimum, grad E(u, p) = 0.

    Attributes:
        hessian: ``exact``, or ``gauss_newton`` to leave out second derivatives of residuals.
    """

    needs = frozenset({STATIONARY})

    hessian: str = "exact"

    def __post_init__(self) -> None:
        if self.hessian not in HESSIANS:
            raise ConfigError(f"unknown backward.hessian {self.hessian!r}: {nearest(str(self.hessian), HESSIANS)}")

    @property
    def of_energy(self) -> frozenset[str]:
        """Gauss-Newton matrices are made of residuals."""
        return frozenset({GRADIENT} if self.hessian == "exact" else {GRADIENT, RESIDUALS})

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        with torch.no_grad():
            solution = minimiser(energy, scene, parameters)
        if not torch.is_grad_enabled() or solution.controls.numel() == 0:
            return solution
        exact, games = self.hessian == "exact", parameters.for_modes(solution.controls.shape[1])
        if isinstance(energy, FeatureEnergy):
            controls, status = implicit.attach(energy, scene, games, solution.controls, exact)
        else:
            controls, status = dense.attach(energy, scene, games, solution.controls, exact)
        states = energy.dynamics.rollout(energy.initial(scene), controls, scene.dt)
        status = torch.maximum(solution.status, status)
        return dataclasses.replace(solution, controls=controls, states=states, status=status)


@register("backward", "detached")
@dataclass(frozen=True)
class Detached(Backward):
    """Learn nothing through the solution."""

    teaches = False

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        with torch.no_grad():
            return minimiser(energy, scene, parameters)
