"""Gradient descent, for any energy that has a gradient.

    u <- u - eta S^2 dE/du

S = diag(scale) is a preconditioner per channel: this is gradient descent in u / S. Near a minimum with the Hessian H the
steps converge if eta lambda_max(S H S) < 2 and diverge otherwise, so the largest eigenvalue limits eta, and convergence
along an eigenvector of eigenvalue lambda takes about 1 / (eta lambda) steps. On highways a turn rate moves positions about
v times as much as an acceleration of the same number (v is the speed); a scale like [1, 0.03] makes their second
derivatives about equal. A step that is too long raises the energy or makes it infinite or NaN: it is rejected, and the
sample's next steps are half as long. This matters because weights are inferred: a game with large weights would diverge,
and learning from diverged controls would make the weights larger still.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.checks import check_number, check_whole, is_number
from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.game.selection import evaluated
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import PATH, STATIONARY, STEPS, Stepwise
from epo_lightning.solvers.general import descent
from epo_lightning.solvers.general.dense import gradient


@dataclass(frozen=True)
class Progress:
    """The memory of the steps so far, with which the next ones continue.

    Attributes:
        length: factor on the step size for a sample's next step.
        lowest: lowest energy so far.
        taken: whether the sample has accepted any step.
    """

    length: Float[Tensor, "B M"]
    lowest: Float[Tensor, "B M"]
    taken: Bool[Tensor, "B M"]


@register("solver", "gradient_descent")
@dataclass(frozen=True)
class GradientDescent(Stepwise):
    """S differentiable gradient steps: EBIOC's "optimisation variant" of its synthesis (arXiv 1904.05453).

    A step that would raise a sample's energy is rejected, and the next ones are half as long: the status is DAMPED, or
    STOPPED where no step was accepted.

    Example::

        solve = GradientDescent(steps=16, step_size=0.005, scale=[1.0, 0.03])
        solution = solve(energy, scene, parameters)

    Attributes:
        steps: number S of steps.
        step_size: eta.
        scale: diagonal of S for acceleration [m/s^2] and turn rate [rad/s].
    """

    needs_from_energy = frozenset({GRADIENT})
    provides = frozenset({PATH, STEPS, STATIONARY})

    steps: int = 16
    step_size: float = 0.005
    scale: Sequence[float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_steps(self.steps, self.scale)
        check_number("solver.step_size", self.step_size)

    def run(
        self, energy: Energy, scene: Scene, parameters: GameParameters, steps: int, memory: Progress | None = None
    ) -> tuple[Solution, Progress]:
        """Take a number of steps; returns the solution, and the progress to continue with.

        Raises:
            ValueError: scene and parameters do not fit together.
        """
        return descend(energy, scene, parameters, steps, self.step_size, self.scale, progress=memory)


def check_steps(steps: Any, scale: Any) -> None:
    """Check a number of steps and a scale.

    Raises:
        ConfigError: steps are no whole number, 0 or more, or the scale is not two positive, finite numbers.
    """
    check_whole("solver.steps", steps, least=0)
    channels = list(scale) if isinstance(scale, Sequence) and not isinstance(scale, str) else []
    if len(channels) != 2 or not all(is_number(channel) and 0 < channel < math.inf for channel in channels):
        raise ConfigError(f"solver.scale takes two positive numbers, for accelerations and turn rates, not {scale!r}")


def descend(
    energy: Energy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    scale: Sequence[float],
    noise: float = 0.0,
    progress: Progress | None = None,
) -> tuple[Solution, Progress]:
    """Take steps u <- u - eta S^2 dE/du + noise S z from the initial strategies, with z ~ N(0, I).

    Differentiable if gradients are recorded; acceptance of steps has no gradient. Absent agents' controls are zero. With
    noise, the energy of n controls is about n / 2 above its minimum, so steps up to ten times that amount above the lowest
    energy so far are accepted.

    Args:
        energy, scene, parameters: the game.
        steps, step_size, scale, noise: number of steps, eta, the diagonal of S, and the noise's standard deviation.
        progress: progress of the steps that led to the initial strategies; None at the start. Steps in two parts give the
            same result as in one, and the status covers both.

    Returns:
        the solution, and the progress to continue with.

    Raises:
        ValueError: scene and parameters do not fit together.
    """
    start = parameters.initial_controls
    energy.validate(scene, parameters, start)
    if scene.history.dtype != start.dtype:
        scene = scene.to(start.dtype)
    present = scene.agent_mask[:, None, :, None, None]
    controls = torch.where(present, start, 0.0)
    channels = start.new_tensor(list(scale))
    every_sample = torch.ones(start.shape[:2], dtype=torch.bool, device=start.device)
    energies, slope, finite = _evaluate(energy, scene, parameters, controls, every_sample)
    initial_energy = energies
    if progress is None:
        progress = Progress(torch.ones_like(energies), energies, torch.zeros_like(finite))
    length, lowest, taken = progress.length, progress.lowest, progress.taken
    slack = 5.0 * (10.0 + scene.agent_mask.sum(1)[:, None] * start.shape[-2:].numel()) if noise else 0.0
    for step in range(steps):
        reach = descent.wide(length)
        moved = controls - step_size * reach * channels.square() * slope
        if noise:
            moved = moved + noise * reach.sqrt() * channels * torch.where(present, torch.randn_like(start), 0.0)
        # No further step uses the last gradient, so it needs no autograd graph.
        with torch.set_grad_enabled(torch.is_grad_enabled() and step < steps - 1):
            value, ahead, finite_there = _evaluate(energy, scene, parameters, moved, finite)
        good = finite_there & (value <= lowest + slack)
        keep = descent.wide(good)
        controls, slope = torch.where(keep, moved, controls), torch.where(keep, ahead, slope)
        energies, length = torch.where(good, value, energies), torch.where(good, length, 0.5 * length)
        lowest = torch.minimum(lowest, energies)
        taken = taken | good
    shortened = torch.where(length < 1.0, Status.DAMPED, Status.COMPLETED)
    status = torch.where(finite & (taken | (steps == 0)), shortened, Status.STOPPED)
    solution = descent.solution(energy, scene, controls, (initial_energy, energies), slope.detach(), status)
    return solution, Progress(length, lowest, taken)


def _evaluate(
    energy: Energy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    going: Bool[Tensor, "B M"],
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B M N K 2"], Bool[Tensor, "B M"]]:
    """The energy, its gradient, and a mask of the samples in ``going`` where both are finite."""
    value, slope = gradient(energy, scene, parameters, controls)
    going = going & descent.both_finite(value, slope)
    if torch.is_grad_enabled() and not going.all():

        def again(*game: Any) -> tuple[Tensor, Tensor]:
            return gradient(energy, *game)

        _, slope = evaluated(again, scene, parameters, controls, going)
    return value.detach(), slope, going
