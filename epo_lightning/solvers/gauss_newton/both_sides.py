"""Several equilibria of one game, found without a learned start: agents that give way to the other side.

A potential game of agents that meet has an equilibrium for each side on which they can pass, and a descent ends in the one
that lies downhill from its start. Let u be the solution from the first initial strategy, and v the strategies that the same
agents would choose if they did not interact. The interaction then changes v by u - v. The strategies

    v - gamma (u - v)

change them in the opposite direction, which leads to the other side if gamma is large enough: with gamma = 2 in 98 % of the
games of RPI that have an equilibrium there, with 2 and 2.5 in all of them (``python -m benchmarks.true_game``).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.checks import check_number
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, Scene, Solution
from epo_lightning.solvers.base import STATIONARY
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

DISTINCT = 0.1
"""Distance [m] from which on two solutions are different: that of some agent's positions at some step."""


@register("solver", "both_sides")
@dataclass(frozen=True)
class BothSides(LevenbergMarquardt):
    """Equilibria of one game: the one below the first initial strategy, and those below its reflections.

    The first mode is the solution u from the first initial strategy; the others are ignored. Each further mode is the
    solution of lowest energy, among those from the reflections, that differs from all modes before; without one, it is the
    solution of lowest energy. Like that of all Newton steps, the derivative is that of the minima (``backward=implicit``).

    Attributes:
        reflections: numbers gamma, one solution each.
    """

    provides = frozenset({STATIONARY})

    reflections: tuple[float, ...] = (2.0, 2.5)

    def __post_init__(self) -> None:
        super().__post_init__()
        for gamma in self.reflections:
            check_number("solver.reflections", gamma)

    def descent(self) -> LevenbergMarquardt:
        """The steps from each initial strategy to the minimum below it."""
        names = [field.name for field in dataclasses.fields(LevenbergMarquardt)]
        return LevenbergMarquardt(**{name: getattr(self, name) for name in names})

    def for_modes(self, modes: int) -> BothSides:
        """This minimiser, if it has enough reflections for M modes.

        Raises:
            ConfigError: there are too few.
        """
        if modes > 1 + len(self.reflections):
            raise ConfigError(
                f"solver.reflections has {len(self.reflections)} numbers, but forecaster.modes={modes} needs {modes - 1} or "
                "more: each gives one solution besides the first"
            )
        return self

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Minimise, reflect, minimise, and choose.

        Raises:
            ValueError: as :meth:`LevenbergMarquardt.run`.
        """
        modes = parameters.initial_controls.shape[1]
        game = dataclasses.replace(parameters.map(lambda tensor: tensor[:, :1]), context=parameters.context)
        if modes == 1 or not game.pair_weights:
            return super().__call__(energy, scene, parameters)
        alone = {name: torch.cat((weight, torch.zeros_like(weight)), 1) for name, weight in game.pair_weights.items()}
        start = game.initial_controls.expand(-1, 2, -1, -1, -1)
        pair = dataclasses.replace(game.for_modes(2), pair_weights=alone, initial_controls=start)
        found = super().__call__(energy, scene, pair)
        first, without = found.controls.chunk(2, 1)
        gamma = first.new_tensor(self.reflections)[:, None, None, None]
        reflected = dataclasses.replace(game, initial_controls=without - gamma * (first - without))
        others = super().__call__(energy, scene, reflected)
        return _chosen(_joined(found.map(lambda tensor: tensor[:, :1]), others), modes)


def _joined(first: Solution, second: Solution) -> Solution:
    """The modes of both solutions."""
    names = ("controls", "states", "initial_energy", "energy", "gradient_norm", "status")
    return Solution(**{name: torch.cat((getattr(first, name), getattr(second, name)), 1) for name in names})


def _chosen(found: Solution, modes: int) -> Solution:
    """The first solution, and then M - 1 of the others: the one of lowest energy that differs from all chosen before."""
    energy = found.energy.clone()
    taken = torch.zeros_like(energy, dtype=torch.bool)
    taken[:, 0] = True
    repeats = _same(found.states)
    chosen = [torch.zeros_like(energy[:, 0], dtype=torch.long)]
    for _ in range(modes - 1):
        repeated = (repeats & taken[:, None]).any(-1)
        # Repeated solutions come after all others, and chosen ones after these; NaN comes last of all.
        rank = torch.where(energy.isfinite(), repeated.to(energy) + 2 * taken.to(energy), 4.0)
        lowest = rank.amin(1, keepdim=True)
        best = torch.where(rank == lowest, energy.nan_to_num(torch.inf), torch.inf).argmin(1)
        chosen.append(best)
        taken = taken | torch.nn.functional.one_hot(best, energy.shape[1]).bool()
    rows = torch.arange(len(energy), device=energy.device)[:, None]
    index = torch.stack(chosen, 1)
    return found.map(lambda tensor: tensor[rows, index])


def _same(states: Tensor) -> Tensor:
    """Whether two solutions of a scene are the same, [B, C, C]."""
    position = states[..., :2]
    apart = (position[:, :, None] - position[:, None]).norm(dim=-1).flatten(3).amax(-1)
    return apart < DISTINCT
