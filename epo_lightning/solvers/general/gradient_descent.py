"""Steps against the gradient: for energies of which no more is known than that.

    u <- u - eta S^2 dE/du

S = diag(scale) says how far controls of either channel move for the same force; it is gradient descent in u / S. Near a
minimum with the Hessian H the steps contract if eta lambda_max(S H S) < 2 and run away beyond that, so the stiffest
direction limits eta and the softest ones take 1 / (eta lambda) steps. On highways a turn rate moves positions by the speed
more than an acceleration does, and a scale like [1, 0.03] makes both about as stiff. A step that is too long is seen,
because the energy rises or ceases to be a number: it is not taken, and the sample's next ones are half as long. Weights are
inferred, and a game with stiff ones would run away otherwise; learning from where it ran to would make it stiffer still.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.game.selection import evaluated
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution, Status
from epo_lightning.solvers.base import PATH, STATIONARY, STEPS, Stepwise
from epo_lightning.solvers.general.dense import gradient


@dataclass(frozen=True)
class Progress:
    """What the steps so far leave behind for the next ones.

    Attributes:
        length: share of the step size that a sample's next step has.
        lowest: energy that it has come down to.
        taken: whether it has taken any step.
    """

    length: Float[Tensor, "B M"]
    lowest: Float[Tensor, "B M"]
    taken: Bool[Tensor, "B M"]


@register("solver", "gradient_descent")
@dataclass(frozen=True)
class GradientDescent(Stepwise):
    """S steps against the gradient, differentiable: EBIOC's "optimisation variant" of its synthesis (arXiv 1904.05453).

    A step that would raise a sample's energy is not taken, and the next ones are half as long: its status is DAMPED, or
    STOPPED where no step could be taken at all.

    Example::

        solve = GradientDescent(steps=16, step_size=0.005, scale=[1.0, 0.03])
        solution = solve(energy, scene, parameters)

    Attributes:
        steps: number S of steps.
        step_size: eta.
        scale: of the channels acceleration [m/s^2] and turn rate [rad/s].
    """

    needs = frozenset({GRADIENT})
    provides = frozenset({PATH, STEPS, STATIONARY})

    steps: int = 16
    step_size: float = 0.005
    scale: Sequence[float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_steps(self.steps, self.scale)
        if not 0 < self.step_size < float("inf"):
            raise ConfigError(f"solver.step_size must be positive and finite, not {self.step_size}")

    def with_steps(self, steps: int) -> GradientDescent:
        """The same with another S."""
        return dataclasses.replace(self, steps=steps)

    def run(
        self, energy: Energy, scene: Scene, parameters: GameParameters, steps: int, memory: Progress | None = None
    ) -> tuple[Solution, Progress]:
        """Take a number of steps; how long the next ones are is remembered.

        Raises:
            ValueError: scene and parameters do not fit together.
        """
        return descend(energy, scene, parameters, steps, self.step_size, self.scale, progress=memory)


def check_steps(steps: int, scale: Sequence[float]) -> None:
    """Refuse a number of steps or a scale that cannot be.

    Raises:
        ConfigError: as said.
    """
    if steps < 0:
        raise ConfigError(f"solver.steps must be 0 or more, not {steps}")
    if isinstance(scale, str) or len(scale) != 2 or not all(0 < channel < float("inf") for channel in scale):
        raise ConfigError(f"solver.scale takes two positive numbers, of accelerations and turn rates, not {scale}")


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

    Differentiable if gradients are recorded, which steps are taken being constant. Absent agents' controls are zero. Noise
    keeps an energy of n controls n / 2 above its lowest value: what lies ten times as far above was too long a step.

    Args:
        energy, scene, parameters: the game.
        steps, step_size, scale, noise: S, eta, the diagonal of S, and how much noise.
        progress: that of the steps which led to the initial strategies; None at the start. Steps in two parts are then
            the same as in one, and the status is that of both.

    Returns:
        the solution, and the progress with which one would go on.

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
    everyone = torch.ones(start.shape[:2], dtype=torch.bool, device=start.device)
    energies, slope, sound = _look(energy, scene, parameters, controls, everyone)
    initial_energy = energies
    if progress is None:
        progress = Progress(torch.ones_like(energies), energies, torch.zeros_like(sound))
    length, lowest, taken = progress.length, progress.lowest, progress.taken
    slack = 5.0 * (10.0 + scene.agent_mask.sum(1)[:, None] * start.shape[-2:].numel()) if noise else 0.0
    for step in range(steps):
        reach = length[..., None, None, None]
        moved = controls - step_size * reach * channels.square() * slope
        if noise:
            moved = moved + noise * reach.sqrt() * channels * torch.where(present, torch.randn_like(start), 0.0)
        # Nothing comes after the last gradient that would have to be differentiated.
        with torch.set_grad_enabled(torch.is_grad_enabled() and step < steps - 1):
            value, ahead, finite = _look(energy, scene, parameters, moved, sound)
        good = finite & (value <= lowest + slack)
        keep = good[..., None, None, None]
        controls, slope = torch.where(keep, moved, controls), torch.where(keep, ahead, slope)
        energies, length = torch.where(good, value, energies), torch.where(good, length, 0.5 * length)
        lowest = torch.minimum(lowest, energies)
        taken = taken | good
    shortened = torch.where(length < 1.0, Status.DAMPED, Status.SOLVED)
    solution = Solution(
        controls=controls,
        states=energy.dynamics.rollout(energy.initial(scene), controls, scene.dt),
        initial_energy=initial_energy,
        energy=energies,
        gradient_norm=slope.detach().flatten(2).norm(dim=-1),
        status=torch.where(sound & (taken | (steps == 0)), shortened, Status.STOPPED),
    )
    return solution, Progress(length, lowest, taken)


def _look(
    energy: Energy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    going: Bool[Tensor, "B M"],
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B M N K 2"], Bool[Tensor, "B M"]]:
    """The energy, its gradient, and which samples go on: both are numbers."""
    value, slope = gradient(energy, scene, parameters, controls)
    going = going & value.isfinite() & slope.flatten(2).isfinite().all(-1)
    if torch.is_grad_enabled() and not going.all():

        def again(*game: Any) -> tuple[Tensor, Tensor]:
            return gradient(energy, *game)

        _, slope = evaluated(again, scene, parameters, controls, going)
    return value.detach(), slope, going
