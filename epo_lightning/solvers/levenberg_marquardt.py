"""The energy-based potential game layer (Section 4.3): S damped Gauss-Newton steps, differentiable by unrolling.

One step solves (J^T J + lambda I) d = -J^T r and moves u to u + alpha d, as the paper and Theseus define it. All scenes and
modes are solved at once and none of them can disturb another: where a factorisation fails, that sample alone is tried again
with more damping, and where that fails too it keeps its last good iterate.

Differentiation does not tape the factorisation. For a cotangent v of u + alpha d, one more solve with the same factor gives
mu = (J^T J + lambda I)^-1 alpha v, and every gradient is that of the scalar

    phi(u, p) = -<J mu, r + J d>     with mu and d held constant,

to which v itself is added for u.
"""

from __future__ import annotations

from dataclasses import dataclass

from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution
from epo_lightning.solvers import structured


@register("solver", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt:
    """S steps of damped Gauss-Newton from the initial strategies, unrolled (Section 4.3, "Differentiable Optimization").

    Example::

        solve = LevenbergMarquardt(steps=2, step_size=0.3, damping=10.0)
        solution = solve(energy, scene, parameters)
        solution.controls  # [B, M, N, K, 2], differentiable with respect to weights, goals and initial controls

    Attributes:
        steps: number S of steps.
        step_size: alpha, 0 < alpha <= 1.
        damping: lambda >= 0, added to the diagonal of J^T J.
        keep_iterates: whether the solution carries u_0 .. u_S.
    """

    steps: int = 2
    step_size: float = 0.3
    damping: float = 10.0
    keep_iterates: bool = False

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ConfigError(f"solver.steps must be 0 or more, not {self.steps}")
        if not 0 < self.step_size <= 1:
            raise ConfigError(f"solver.step_size must be in (0, 1], not {self.step_size}")
        if not self.damping >= 0:
            raise ConfigError(f"solver.damping must be 0 or more, not {self.damping}")

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Minimise the energy of every scene and mode, starting at ``parameters.initial_controls``.

        Raises:
            ValueError: scene and parameters do not fit together; the message names the tensor and its expected shape.
        """
        energy.validate(scene, parameters, parameters.initial_controls)
        damping = parameters.initial_controls.new_full(parameters.initial_controls.shape[:2], self.damping)
        return structured.solve(energy, scene, parameters, self.steps, self.step_size, damping, self.keep_iterates)
