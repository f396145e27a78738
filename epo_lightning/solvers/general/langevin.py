"""Approximate samples of p(u | o) = exp(-E(u; o)) / Z by noisy gradient steps ("synthesis" in EBIOC, arXiv 1904.05453).

    u <- u - (delta^2 / 2) S^2 dE/du + delta S z,   z ~ N(0, I)

This is the unadjusted Langevin algorithm, preconditioned by S = diag(scale). As delta goes to zero, its samples converge to
exp(-E) for any S (clipped steps would not). For a quadratic energy it converges if delta^2 / 2 lambda_max(S H S) < 2, and
along a direction of eigenvalue lambda of S H S the variance of the samples is larger than that of exp(-E) by the factor
1 / (1 - delta^2 lambda / 4). Steps that raise the energy far beyond the noise are rejected
(:mod:`~epo_lightning.solvers.general.gradient_descent`).

This holds for long chains. S steps are a short-run chain, which begins at the decoder's strategies and reaches exp(-E) along
a direction of eigenvalue lambda only if S delta^2 / 2 lambda is large: the fraction (1 - delta^2 / 2 lambda)^S of the
distance between start and minimum remains, and the variance is about 1 - (1 - delta^2 / 2 lambda)^2S of the long chain's.
With 16 steps, delta = 0.1 and lambda = 1 these are 92 % of the distance and 15 % of the variance; with lambda = 30, 7 % and
99 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from epo_lightning.checks import check_number
from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import SAMPLES, Minimiser
from epo_lightning.solvers.general.gradient_descent import GradientDescent, check_steps, descend


@register("solver", "langevin")
@dataclass(frozen=True)
class Langevin(Minimiser):
    """One sample of joint strategies per mode, S Langevin steps from its initial strategies.

    This is a short-run chain: unless S delta^2 / 2 times the second derivative of the energy is large, a sample depends on
    its start, and varies less than exp(-E). For a second derivative of 1, 16 steps with delta = 0.1 reach 15 % of its
    variance.

    Samples are constants to automatic differentiation. Noise comes from PyTorch's global generator, in training alone;
    outside it (:meth:`for_test`) the same steps are taken without noise, so that forecasts are a function of the scene.

    Attributes:
        steps: number S of steps.
        delta: standard deviation of the noise; the step size is delta^2 / 2.
        scale: diagonal of S for acceleration [m/s^2] and turn rate [rad/s]; see
            :mod:`~epo_lightning.solvers.general.gradient_descent`.
    """

    needs_from_energy = frozenset({GRADIENT})
    provides = frozenset({SAMPLES})

    steps: int = 16
    delta: float = 0.1
    scale: Sequence[float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_steps(self.steps, self.scale)
        check_number("solver.delta", self.delta)

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        with torch.no_grad():
            return descend(energy, scene, parameters, self.steps, 0.5 * self.delta**2, self.scale, self.delta)[0]

    def for_test(self) -> GradientDescent:
        """The same steps without noise."""
        return GradientDescent(self.steps, 0.5 * self.delta**2, self.scale)
