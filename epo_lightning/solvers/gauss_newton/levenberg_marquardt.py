"""The energy-based potential game layer (Section 4.3): S damped Gauss-Newton steps, differentiable.

One step solves (J^T J + lambda I) d = -J^T r and moves u to u + alpha d, as the paper and Theseus define it. All scenes and
modes are solved at once and none of them can disturb another: where a factorisation fails, that sample alone is tried again
with more damping, and where that fails too it keeps its last good iterate. Two backends compute a step
(:mod:`~epo_lightning.solvers.gauss_newton.compiled` and :mod:`~epo_lightning.solvers.gauss_newton.structured`); this module
decides what is done with the steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.game.energy import FEATURES, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, Scene, Solution, Status
from epo_lightning.solvers.base import PATH, STATIONARY, STEPS, Stepwise
from epo_lightning.solvers.gauss_newton import compiled, structured

Backend = Callable[[FeatureEnergy, Scene, GameParameters, int, float, Tensor, bool], Solution]
"""(energy, scene, parameters, steps, step size, damping [B, M] or [B, M, N], keep iterates) -> solution.

An agent whose damping is infinite stays exactly where it is, and the others move as if it were part of the scenery."""

LEAST_DAMPING, MOST_DAMPING = 1e-7, 1e7
"""Between which adaptive damping stays."""
BACKENDS = ("auto", "pytorch", "compiled")


@register("solver", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt(Stepwise):
    """S steps of damped Gauss-Newton from the initial strategies (Section 4.3, "Differentiable Optimization").

    What is learned through the solution is said by a :class:`~epo_lightning.solvers.backward.Backward`; called by itself,
    the solver unrolls.

    Example::

        solve = LevenbergMarquardt(steps=2, step_size=0.3, damping=10.0)
        solution = solve(energy, scene, parameters)
        solution.controls  # [B, M, N, K, 2], differentiable with respect to weights, goals and initial controls

    Attributes:
        steps: number S of steps.
        step_size: alpha, 0 < alpha <= 1.
        damping: lambda >= 0, added to the diagonal of J^T J.
        keep_iterates: whether the solution carries u_0 .. u_S.
        adaptive: whether every sample rejects steps that do not lower its energy and multiplies its damping by 10 then (at
            most 1e7), and accepts the others and divides it by 10 (at least 1e-7). Decisions are constants to the gradient.
        test_steps: the number of steps that forecasters take outside training; None for the same.
        backend: ``pytorch``; ``compiled``, the kernel for CPUs; or ``auto``, the kernel wherever it can serve.
    """

    needs = frozenset({FEATURES})
    provides = frozenset({PATH, STEPS, STATIONARY})

    steps: int = 2
    step_size: float = 0.3
    damping: float = 10.0
    keep_iterates: bool = False
    adaptive: bool = False
    test_steps: int | None = None
    backend: str = "auto"

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ConfigError(f"solver.steps must be 0 or more, not {self.steps}")
        if self.test_steps is not None and self.test_steps < 0:
            raise ConfigError(f"solver.test_steps must be 0 or more, not {self.test_steps}")
        if not 0 < self.step_size <= 1:
            raise ConfigError(f"solver.step_size must be in (0, 1], not {self.step_size}")
        if not 0 <= self.damping < float("inf"):
            raise ConfigError(f"solver.damping must be 0 or more, and finite, not {self.damping}")
        if self.backend not in BACKENDS:
            raise ConfigError(f"unknown solver.backend {self.backend!r}: {nearest(str(self.backend), BACKENDS)}")

    def for_test(self) -> Stepwise:
        """The solver to use outside training."""
        return self if self.test_steps is None else self.with_steps(self.test_steps)

    def run(
        self, energy: Energy, scene: Scene, parameters: GameParameters, steps: int, memory: Tensor | None = None
    ) -> tuple[Solution, Tensor]:
        """Take a number of steps; returns the solution and the damping with which one would go on.

        Raises:
            ValueError: scene and parameters do not fit together (the message names the tensor and its expected shape), or
                the backend asked for cannot solve this game.
        """
        if not isinstance(energy, FeatureEnergy):
            raise ValueError(f"the solver takes energies made of features, not {type(energy).__name__}")
        start = parameters.initial_controls
        energy.validate(scene, parameters, start)
        parameters = parameters.for_modes(start.shape[1])
        if start.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"initial_controls are of type {start.dtype}; the layer takes float32 and float64")
        if scene.history.dtype != start.dtype:
            scene = scene.to(start.dtype)
        damping = start.new_full(start.shape[:2], self.damping) if memory is None else memory
        if start.numel() == 0:
            return _nothing(start), damping
        solve = backend(self.backend, energy, scene, parameters)
        if not self.adaptive:
            return solve(energy, scene, parameters, steps, self.step_size, damping, self.keep_iterates), damping
        solution = solve(energy, scene, parameters, 0, self.step_size, damping, True)
        for _ in range(steps):
            here = dataclasses.replace(parameters, initial_controls=solution.controls)
            trial = solve(energy, scene, here, 1, self.step_size, damping, False)
            better = trial.energy < solution.energy
            damping = torch.where(
                better, (damping / 10.0).clamp_min(LEAST_DAMPING), (damping * 10.0).clamp_max(MOST_DAMPING)
            )
            solution = _chosen(better, trial, solution, self.keep_iterates)
        return solution if self.keep_iterates else dataclasses.replace(solution, iterates=None), damping


def backend(name: str, energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> Backend:
    """What computes the steps of a game.

    Raises:
        ValueError: the backend asked for cannot solve this game.
    """
    if name == "pytorch":
        return structured.solve
    obstacle = compiled.obstacle(energy, scene, parameters)
    if obstacle is None:
        return compiled.solve
    if name == "compiled":
        raise ValueError(f"solver.backend is 'compiled', but {obstacle}; 'auto' and 'pytorch' can solve this game")
    if parameters.initial_controls.device.type == "cpu":
        compiled.say_once(obstacle)
    return structured.solve


def _nothing(controls: Tensor) -> Solution:
    """The solution of no game at all: no scene, no mode or no agent."""
    none = controls.new_zeros(controls.shape[:2])
    states = controls.new_zeros(*controls.shape[:-1], 4)
    return Solution(controls, states, none, none, none, none.long(), None)


def _chosen(better: Tensor, trial: Solution, before: Solution, keep_iterates: bool) -> Solution:
    """The trial where it is better, and what was before elsewhere."""
    keep = better[..., None, None, None]
    controls = torch.where(keep, trial.controls, before.controls)
    accepted = torch.where(better, trial.status, Status.SOLVED)
    assert before.iterates is not None
    return Solution(
        controls=controls,
        states=torch.where(keep, trial.states, before.states),
        initial_energy=before.initial_energy,
        energy=torch.where(better, trial.energy, before.energy),
        gradient_norm=torch.where(better, trial.gradient_norm, before.gradient_norm),
        # A step without a factor is one more that is rejected; a sample whose energy is no number has no steps at all.
        status=torch.where(before.energy.isfinite(), before.status.maximum(accepted), Status.STOPPED),
        iterates=(*before.iterates, controls) if keep_iterates else before.iterates,
    )
