"""Samples near p(u | o) = exp(-E(u; o)) / Z by noisy steps against the gradient: the synthesis of EBIOC (arXiv 1904.05453).

    u <- u - (delta^2 / 2) S^2 dE/du + delta S z,   z ~ N(0, I)

This is the unadjusted Langevin algorithm, preconditioned by S = diag(scale). As delta goes to zero, its samples are those of
exp(-E) for any S; a step that is clipped has no such limit. For a quadratic energy it converges if
delta^2 / 2 lambda_max(S H S) < 2, and along a direction of curvature lambda of S H S samples then are wider than exp(-E) by
the factor 1 / (1 - delta^2 lambda / 4) in variance. Steps that lead far above what noise explains are not taken
(:mod:`~epo_lightning.solvers.general.gradient_descent`).

All of this is about long chains. S short steps are a short-run chain, which begins at the decoder's strategies and reaches
exp(-E) along a direction of curvature lambda only as far as S delta^2 / 2 lambda is large: it keeps the share
(1 - delta^2 / 2 lambda)^S of the distance between start and minimum, and its variance has come up to about
1 - (1 - delta^2 / 2 lambda)^2S of the long chain's. With 16 steps, delta = 0.1 and lambda = 1 these are 92 % of the distance
and 15 % of the variance; lambda = 30 leaves 7 % and reaches 99 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution
from epo_lightning.solvers.base import SAMPLES, Minimiser
from epo_lightning.solvers.general.gradient_descent import GradientDescent, check_steps, descend


@register("solver", "langevin")
@dataclass(frozen=True)
class Langevin(Minimiser):
    """One sample of joint strategies per mode, S Langevin steps from its initial strategies.

    A short-run chain: where S delta^2 / 2 times the curvature of the energy is not large, a sample has not forgotten where
    it began, and is less spread than exp(-E). Along a curvature of 1, 16 steps with delta = 0.1 reach 15 % of its variance.

    Samples are constants: no derivative leads through them. Noise comes from PyTorch's global generator, in training alone;
    outside it (:meth:`for_test`) the same steps are taken without noise, so that forecasts are a function of the scene.

    Attributes:
        steps: number S of steps.
        delta: standard deviation of the noise; a step goes by delta^2 / 2.
        scale: S, of the channels acceleration [m/s^2] and turn rate [rad/s]; see
            :mod:`~epo_lightning.solvers.general.gradient_descent`.
    """

    needs = frozenset({GRADIENT})
    provides = frozenset({SAMPLES})

    steps: int = 16
    delta: float = 0.1
    scale: Sequence[float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check_steps(self.steps, self.scale)
        if not 0 < self.delta < float("inf"):
            raise ConfigError(f"solver.delta must be positive and finite, not {self.delta}")

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        with torch.no_grad():
            return descend(energy, scene, parameters, self.steps, 0.5 * self.delta**2, self.scale, self.delta)[0]

    def for_test(self) -> GradientDescent:
        """The steps without their noise."""
        return GradientDescent(self.steps, 0.5 * self.delta**2, self.scale)
