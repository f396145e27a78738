"""Derivatives of solutions: how gradients are backpropagated through the solution of a game (Table 1, column 3:
unrolling, UN, and the implicit function theorem, IFT).

- ``unrolled`` (the paper's): through all S steps of the computation, also to the initial strategies.
- ``truncated``: through the last few steps; the iterate at which they start is held constant.
- ``implicit``: the derivative of the minimum that the steps approach (implicit function theorem), independent of the path.
  It is correct only if the solution is a minimum, so use many steps. A problem (scene and mode) whose Hessian is not
  positive definite is not at a minimum: its gradient is zero and its status STOPPED. If most of the solutions of a batch are
  not minima, a warning is given once. Scaling all weights of a game by the same factor does not move the minimum, so
  w . dL/dw = 0: the overall scale of the weights is not learned and drifts. Fix one weight, or normalise the weights.
- ``detached``: no derivative, for objectives that compare energies instead of solutions.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from epo_lightning.checks import check_choice, check_whole
from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.energy import GRADIENT, RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import PATH, STATIONARY, STEPS, TABLES, Minimiser, Stepwise
from epo_lightning.solvers.gauss_newton import implicit
from epo_lightning.solvers.general import dense

HESSIANS = ("exact", "gauss_newton")


class Backward(ABC):
    """The interface of derivatives: runs a minimiser and attaches a derivative to its solution.

    Attributes:
        needs_from_solver: properties of which the minimiser must provide at least one; empty if nothing is needed.
        teaches: whether gradients flow through the solution.
        teaches_start: whether gradients flow to the initial strategies.
    """

    needs_from_solver: ClassVar[frozenset[str]] = frozenset()
    teaches: ClassVar[bool] = True
    teaches_start: ClassVar[bool] = False

    @property
    def needs_from_energy(self) -> frozenset[str]:
        """Properties that the energy must offer."""
        return frozenset()

    @abstractmethod
    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """The minimiser's solution, with this derivative."""


@register("backward", "unrolled")
@dataclass(frozen=True)
class Unrolled(Backward):
    """Differentiate every step (Section 4.3)."""

    needs_from_solver = frozenset({PATH, TABLES})
    teaches_start = True

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        return minimiser(energy, scene, parameters)


@register("backward", "truncated")
@dataclass(frozen=True)
class Truncated(Backward):
    """Differentiate the last steps.

    Attributes:
        steps: number of differentiated steps.
    """

    needs_from_solver = frozenset({STEPS})

    steps: int = 1

    def __post_init__(self) -> None:
        check_whole("backward.steps", self.steps)

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        if not isinstance(minimiser, Stepwise):
            raise ValueError(
                f"backward=truncated needs a solver with steps that can be continued, not {type(minimiser).__name__}"
            )
        taught = min(self.steps, minimiser.steps)
        with torch.no_grad():
            first, memory = minimiser.run(energy, scene, parameters, minimiser.steps - taught)
        onward = dataclasses.replace(parameters, initial_controls=first.controls)
        last, _ = minimiser.run(energy, scene, onward, taught, memory)
        return first.continued_by(last)


@register("backward", "implicit")
@dataclass(frozen=True)
class Implicit(Backward):
    """Differentiate the condition that holds at a minimum, grad E(u, p) = 0.

    Attributes:
        hessian: ``exact``, or ``gauss_newton`` to leave out second derivatives of residuals.
    """

    needs_from_solver = frozenset({STATIONARY})

    hessian: str = "exact"

    def __post_init__(self) -> None:
        check_choice("backward.hessian", self.hessian, HESSIANS)

    @property
    def needs_from_energy(self) -> frozenset[str]:
        """A gradient, and residuals for a Gauss-Newton matrix."""
        return frozenset({GRADIENT} if self.hessian == "exact" else {GRADIENT, RESIDUALS})

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        with torch.no_grad():
            solution = minimiser(energy, scene, parameters)
        if not torch.is_grad_enabled() or solution.controls.numel() == 0:
            return solution
        exact, games = self.hessian == "exact", parameters.for_every_mode(solution.controls.shape[1])
        if (own := minimiser.attach(energy, scene, games, solution, exact)) is not None:
            controls, status = own
        elif isinstance(energy, FeatureEnergy):
            backend = getattr(minimiser, "backend", "auto")  # a setting of those that take Gauss-Newton steps
            controls, status = implicit.attach(energy, scene, games, solution.controls, exact, backend)
        else:
            controls, status = dense.attach(energy, scene, games, solution.controls, exact)
        states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
        status = torch.maximum(solution.status, status)
        return dataclasses.replace(solution, controls=controls, states=states, status=status)


@register("backward", "detached")
@dataclass(frozen=True)
class Detached(Backward):
    """Hold the solution constant: no gradient flows through it."""

    teaches = False

    def __call__(self, minimiser: Minimiser, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        with torch.no_grad():
            return minimiser(energy, scene, parameters)
