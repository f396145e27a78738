"""Several equilibria of one game, found without a learned start: agents that give way to the other side.

A potential game of agents that meet has an equilibrium for each side on which they can pass, and a descent ends in the one
that lies downhill from its start. Let u be the solution from the first initial strategy, and v the strategies that the same
agents would choose if they did not interact. The interaction then changes v by u - v. The strategies

    v - gamma (u - v)

change them in the opposite direction, which leads to the other side if gamma is large enough. Of 5599 games of RPI with an
equilibrium there, gamma = 2 finds it in 96 %, and gamma = 2 and gamma = 4 together in 99 %.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from epo_lightning.checks import check_number
from epo_lightning.forecast import GameParameters, Solution, same_motion
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt


@register("solver", "both_sides")
@dataclass(frozen=True)
class BothSides(Minimiser):
    """Equilibria of one game: the one below the initial strategy, and those below its reflections.

    The first mode is the solution from the initial strategy. Each further mode is the solution of lowest energy, among
    those from the reflections, that differs from all modes before; without one, it is the solution of lowest energy. All of
    them are computed by adaptive steps (:class:`~.levenberg_marquardt.LevenbergMarquardt`).

    Attributes:
        steps: number of Gauss-Newton steps.
        newton_steps: number of steps with the Hessian that follow.
        damping: lambda of the first step. With too little of it, a reflection may jump back across the other agent.
        reflections: numbers gamma, one solution each.
        backend: that of :class:`~.levenberg_marquardt.LevenbergMarquardt`.
        modes: number M of modes; :meth:`for_modes` sets it.
    """

    needs_from_energy = LevenbergMarquardt.needs_from_energy
    provides = frozenset({STATIONARY})

    steps: int = 5
    newton_steps: int = 10
    damping: float = 10.0
    reflections: Sequence[float] = (2.0, 4.0)
    backend: str = "auto"
    modes: int = 2

    def __post_init__(self) -> None:
        self.open_loop()  # checks its settings
        for gamma in self.reflections:
            check_number("solver.reflections", gamma)

    @property
    def on_host(self) -> bool:
        """Whether the steps of games on a GPU are taken on the host."""
        return self.open_loop().on_host

    def open_loop(self) -> LevenbergMarquardt:
        """The steps from each initial strategy to the minimum below it, an open-loop equilibrium."""
        return LevenbergMarquardt(
            steps=self.steps,
            step_size=1.0,
            damping=self.damping,
            adaptive=True,
            newton_steps=self.newton_steps,
            backend=self.backend,
        )

    def descent(self) -> Minimiser:
        """The steps from each initial strategy to the equilibrium of its side."""
        return self.open_loop()

    def strategies(self, modes: int) -> int:
        """One initial strategy per agent; the solver finds those of the other modes itself."""
        return 1

    def games(self, modes: int) -> int:
        """One game, whose equilibria are the modes."""
        return 1

    def for_modes(self, modes: int) -> BothSides:
        """This minimiser, set up to return M joint modes.

        Raises:
            ConfigError: there are too few reflections.
        """
        if modes > 1 + len(self.reflections):
            raise ConfigError(
                f"solver.reflections has {len(self.reflections)} numbers, but forecaster.modes={modes} needs {modes - 1} or "
                "more: each gives one solution besides the first"
            )
        return dataclasses.replace(self, modes=modes)

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Minimise, reflect, minimise, and choose.

        Raises:
            ValueError: as :meth:`LevenbergMarquardt.run`.
        """
        descend = self.open_loop()
        game = dataclasses.replace(parameters.map(lambda tensor: tensor[:, :1]), context=parameters.context)
        # The game with and without its interaction, solved at once as two modes.
        weights = {name: torch.cat((weight, torch.zeros_like(weight)), 1) for name, weight in game.pair_weights.items()}
        start = game.initial_controls.expand(-1, 2, -1, -1, -1)
        found = descend(
            energy, scene, dataclasses.replace(game.for_every_mode(2), pair_weights=weights, initial_controls=start)
        )
        first, alone = found.controls.chunk(2, 1)
        gamma = first.new_tensor(self.reflections)[:, None, None, None]
        others = descend(energy, scene, dataclasses.replace(game, initial_controls=alone - gamma * (first - alone)))
        solution = _chosen(Solution.concatenated([found.map(lambda tensor: tensor[:, :1]), others], 1), self.modes)
        initial = found.initial_energy[:, :1].expand_as(solution.energy)
        return dataclasses.replace(solution, initial_energy=initial)


def _chosen(found: Solution, modes: int) -> Solution:
    """The first solution, and then M - 1 of the others: the one of lowest energy that differs from all chosen before."""
    energy = found.energy
    taken = torch.zeros_like(energy, dtype=torch.bool)
    taken[:, 0] = True
    repeats = same_motion(found.states)
    chosen = [torch.zeros_like(energy[:, 0], dtype=torch.long)]
    for _ in range(modes - 1):
        repeated = (repeats & taken[:, None]).any(-1)
        # Repeated solutions come after all others, solutions that are not finite after these, and chosen ones last.
        rank = torch.where(energy.isfinite(), repeated.to(energy), 2.0).masked_fill(taken, 3.0)
        first = rank == rank.amin(1, keepdim=True)
        largest = torch.finfo(energy.dtype).max
        best = energy.nan_to_num(largest).masked_fill(~first, math.inf).argmin(1)
        chosen.append(best)
        taken = taken | F.one_hot(best, energy.shape[1]).bool()
    rows = torch.arange(len(energy), device=energy.device)[:, None]
    index = torch.stack(chosen, 1)
    return found.map(lambda tensor: tensor[rows, index])
