"""The energy-based potential game layer (Section 4.3): S damped Gauss-Newton steps, differentiable.

One step solves (J^T J + lambda I) d = -J^T r and moves u to u + alpha d, as Theseus does, which the paper uses. All scenes
and modes are solved at once and independently of each other. If a matrix cannot be factorised, its problem (one scene and
mode) keeps its last good iterate; on a CPU, the factorisation is first repeated with more damping. One of the
:mod:`~epo_lightning.solvers.gauss_newton.backends` computes the steps. With adaptive damping,
:mod:`~epo_lightning.solvers.gauss_newton.adaptive` or the backend's kernel accepts or rejects them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.checks import check_choice, check_number, check_whole, is_number
from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.energy import FEATURES, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import PATH, STATIONARY, STEPS, Stepwise
from epo_lightning.solvers.gauss_newton import adaptive
from epo_lightning.solvers.gauss_newton.backends import choice
from epo_lightning.solvers.general import descent

LARGEST_DAMPING = 1e30
_FIRST_STEPS, _NEWTON_STEPS = 5, 15
"""Numbers of Gauss-Newton and of Newton steps that lead to a minimum. Newton steps converge only from a start near it."""
_LARGEST_NEWTON_DAMPING = 1e-2
"""Largest first damping near a minimum: with more of it, the first Newton steps are short."""


@register("solver", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt(Stepwise):
    """S steps of damped Gauss-Newton from the initial strategies (Section 4.3, "Differentiable Optimization").

    A :class:`~epo_lightning.solvers.backward.Backward` chooses the derivative of the solution. Without one, the solution is
    differentiated by unrolling.

    Example::

        solve = LevenbergMarquardt(steps=2, step_size=0.3, damping=10.0)
        solution = solve(energy, scene, parameters)
        solution.controls  # [B, M, N, K, 2], differentiable with respect to weights, goals and initial controls

    Attributes:
        steps: number S of steps.
        step_size: alpha, 0 < alpha <= 1.
        damping: lambda >= 0, added to the diagonal of J^T J.
        keep_iterates: whether the solution carries u_0 .. u_S.
        adaptive: whether the damping of every problem is adapted: a step that lowers the energy is accepted, and the damping
            is divided by 10 (down to 1e-7); any other step is rejected, and the damping is multiplied by 10 (up to 1e7).
            These decisions have no gradient.
        test_steps: number of steps outside training; None for the same number.
        newton_steps: number of adaptive Newton steps, with the exact Hessian, after the S Gauss-Newton steps. Near a minimum
            they converge quadratically, and Gauss-Newton steps linearly. They have no derivative of their own: use
            ``backward=implicit`` or ``detached``.
        backend: ``pytorch``; ``compiled``, the kernel for CPUs; ``host``, the same kernel, also for tensors on a GPU, which
            are copied; ``warp``, fused kernels on a GPU; or ``auto``, the choice of :func:`.choice.choose`.
    """

    needs_from_energy = frozenset({FEATURES})

    steps: int = 2
    step_size: float = 0.3
    damping: float = 10.0
    keep_iterates: bool = False
    adaptive: bool = False
    test_steps: int | None = None
    newton_steps: int = 0
    backend: str = "auto"

    def __post_init__(self) -> None:
        check_whole("solver.steps", self.steps, least=0)
        if self.test_steps is not None:
            check_whole("solver.test_steps", self.test_steps, least=0)
        check_whole("solver.newton_steps", self.newton_steps, least=0)
        if self.newton_steps and not self.adaptive:
            raise ConfigError("solver.newton_steps needs solver.adaptive=true: a Newton step may go uphill")
        if not is_number(self.step_size) or not 0 < self.step_size <= 1:
            raise ConfigError(f"solver.step_size must be a number in (0, 1], not {self.step_size!r}")
        check_number("solver.damping", self.damping, zero=True)
        if self.damping > LARGEST_DAMPING:
            raise ConfigError(
                f"solver.damping must be {LARGEST_DAMPING:g} or less, not {self.damping:g}: its products leave the range of "
                "single precision"
            )
        check_choice("solver.backend", self.backend, choice.NAMES)
        if self.backend == "warp" and self.newton_steps:
            raise ConfigError(
                "solver.backend=warp has no Newton steps: set solver.newton_steps=0, or choose solver.backend=auto, "
                "compiled, host (on a GPU) or pytorch"
            )

    @property
    def provides(self) -> frozenset[str]:
        """A path and steps without Newton steps, and the derivative of a minimum in any case."""
        return frozenset({STATIONARY} if self.newton_steps else {PATH, STEPS, STATIONARY})

    @property
    def on_host(self) -> bool:
        """Whether the backend solves games on a GPU on the host."""
        return choice.on_host(self.backend, fixed=not self.adaptive)

    def for_test(self) -> Stepwise:
        """The solver to use outside training."""
        return self if self.test_steps is None else self.with_steps(self.test_steps)

    def descent(self) -> LevenbergMarquardt:
        """The solver with Newton steps at the end, because Gauss-Newton steps may need hundreds to arrive at the minimum.

        Solvers that are not adaptive, and those of a backend without Newton steps, stay as they are."""
        if self.newton_steps or not self.adaptive or self.backend == "warp":
            return self
        return dataclasses.replace(self, steps=min(self.steps, _FIRST_STEPS), newton_steps=_NEWTON_STEPS)

    def near_minimum(self) -> LevenbergMarquardt:
        """The solver without its Gauss-Newton steps, if it has Newton steps, which converge quadratically near a minimum."""
        if not self.newton_steps:
            return self
        return dataclasses.replace(self, steps=0, damping=min(self.damping, _LARGEST_NEWTON_DAMPING))

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """S steps, and then the Newton steps.

        Raises:
            ValueError: as :meth:`run`, or a gradient is needed through Newton steps.
        """
        if not self.newton_steps:
            return self.run(energy, scene, parameters, self.steps)[0]
        if torch.is_grad_enabled():
            raise ValueError("solver.newton_steps have no derivative: use backward=implicit or detached")
        if not self.steps:
            return self.run(energy, scene, parameters, self.newton_steps, exact=True)[0]
        first, damping = self.run(energy, scene, parameters, self.steps)
        onward = dataclasses.replace(parameters, initial_controls=first.controls)
        last, _ = self.run(energy, scene, onward, self.newton_steps, damping, exact=True)
        return first.continued_by(last)

    def run(
        self,
        energy: Energy,
        scene: Scene,
        parameters: GameParameters,
        steps: int,
        memory: Tensor | None = None,
        exact: bool = False,
    ) -> tuple[Solution, Tensor]:
        """Take a number of steps, with the Hessian if ``exact``; returns the solution and the damping to continue with.

        Args:
            memory: the damping [B, M] or [B, M, N] with which an earlier call ended; None at the start. Agents with infinite
                damping keep their controls.

        Raises:
            TypeError: arguments of other types, or in another order.
            ValueError: scene and parameters do not fit together (the message names the tensor and its expected shape), or
                the chosen backend cannot solve this game.
        """
        game = (energy, scene, parameters)
        if not all(map(isinstance, game, (Energy, Scene, GameParameters))):
            given = ", ".join(type(argument).__name__ for argument in game)
            raise TypeError(f"a solver takes an energy, a Scene and GameParameters, in this order, not {given}")
        if not isinstance(energy, FeatureEnergy):
            raise ValueError(
                f"solver=levenberg_marquardt takes energy=features, not {type(energy).__name__}; choose a general solver"
            )
        start = parameters.initial_controls
        energy.validate(scene, parameters, start)
        parameters = parameters.for_every_mode(start.shape[1])
        if start.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"initial_controls are of type {start.dtype}; the layer takes float32 and float64")
        if scene.history.dtype != start.dtype:
            scene = scene.to(start.dtype)
        damping = start.new_full(start.shape[:2], self.damping) if memory is None else memory
        if start.numel() == 0:
            return descent.nothing(start), damping
        fixed = not self.adaptive and not exact
        backend, size = choice.choose(self.backend, energy, scene, parameters, fixed), self.step_size
        if not self.adaptive:
            return backend.solve(energy, scene, parameters, steps, size, damping, self.keep_iterates, exact), damping
        kernel = choice.with_kernel(backend)
        if kernel is not None and not torch.is_grad_enabled() and not self.keep_iterates:
            return kernel.descend(energy, scene, parameters, steps, size, damping, exact)
        return adaptive.descend_by_calls(
            backend.solve, energy, scene, parameters, steps, size, damping, exact, self.keep_iterates
        )
