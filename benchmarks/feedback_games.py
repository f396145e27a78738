"""Costs of feedback equilibria, and the errors of solutions and derivatives, on the games that made RPI.

    epo generate data=rpi data.placements=8 data.solver=feedback_converged
    python -m benchmarks.feedback_games data=rpi data.placements=8 data.solver=feedback_converged

The games have their true weights, and 0.3 times these, which make the iteration slower; overrides are those of `epo train`.
Solutions are compared with exact ones, which have a tolerance of 1e-9 and up to 400 LQ games, and derivatives with those of
60 steps of GMRES. The loss is the SADE of the mode that is closest to the executed future; its derivative is by all weights
and goals.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from unittest import mock

import torch
from torch import Tensor

from benchmarks.true_game import TrueGames, command_line, parts
from epo_lightning.data.rpi.subgames import FUTURE
from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.feedback import iteration
from epo_lightning.solvers.feedback.anderson import Anderson
from epo_lightning.solvers.feedback.lq_game import LQGame, Policy
from epo_lightning.solvers.feedback.solver import Feedback

STEPS = (1, 2, 4, 8)
"""Numbers of steps of GMRES."""
SCALES = (1.0, 0.3)
"""Factors of all weights."""


class Plain(Anderson):
    """The plain iteration: no point is remembered."""

    def remember(self, *_: Tensor) -> None:
        """Forget the points at once."""


@contextmanager
def counted() -> Iterator[list[int]]:
    """A list that gets the number of LQ games of every iteration."""
    numbers: list[int] = []
    solve_lq = LQGame.equilibrium

    def equilibrium(local: LQGame) -> Policy:
        numbers.append(len(local.A))
        return solve_lq(local)

    with mock.patch.object(LQGame, "equilibrium", equilibrium):
        yield numbers


@dataclass(frozen=True)
class Games:
    """Games of records, with their energy."""

    energy: FeatureEnergy
    records: TrueGames
    parameters: GameParameters


def gradient(solver: Feedback, games: Games, usable: Tensor) -> Tensor:
    """The derivative of every game's loss by its weights and goals, side by side; zero where a game is not usable."""
    leaves = games.parameters.map(lambda tensor: tensor.detach().clone().requires_grad_())
    states = Implicit()(solver, games.energy, games.records.scene, leaves).states[..., :FUTURE, :2]
    closest = (states - games.records.states[:, None, 0, ..., :2]).norm(dim=-1).mean((2, 3)).amin(1)
    (closest * usable).sum().backward()
    wanted = (*leaves.own_weights.values(), *leaves.pair_weights.values(), leaves.goals)
    return torch.cat([leaf.grad.flatten(1) for leaf in wanted if leaf is not None and leaf.grad is not None], -1)


def quantiles(values: Tensor) -> str:
    """The median, the 90 % quantile and the largest value."""
    return ", ".join(f"{value:.1e}" for value in (values.median(), values.quantile(0.9), values.max()))


@torch.no_grad()
def solve(title: str, solver: Feedback, games: Games, exact: Solution | None = None) -> Solution:
    """Solve all games and print a line."""
    start = time.process_time()
    with counted() as numbers:
        found = solver(games.energy, games.records.scene, games.parameters)
    spent = 1e3 * (time.process_time() - start) / len(found.status)
    solved = found.status == Status.SOLVED
    line = (
        f"{title:28} solved {int(solved.sum())} of {solved.numel()}  {sum(numbers) / solved.numel():5.1f} LQ games each"
    )
    if exact is not None:
        far = (found.states - exact.states)[..., :FUTURE, :].abs().amax((2, 3, 4))
        line += f"  {spent:5.1f} ms of CPU per record  error {quantiles(far[solved & (exact.status == Status.SOLVED)])}"
    print(line)
    return found


def measure(split: str, count: int, overrides: Sequence[str]) -> None:
    """Print the cost and the errors of solutions and of derivatives."""
    data, solver, energy, _ = parts([*overrides, "solver=feedback"])
    assert isinstance(solver, Feedback)
    assert isinstance(energy, FeatureEnergy)
    records = TrueGames.draw(data, split, count)
    print(f"{count} records of {data.folder.name}, {split}; errors: median, 90 % quantile, largest")
    true = records.game()
    for scale in SCALES:
        own = {name: scale * weight for name, weight in true.own_weights.items()}
        pair = {name: scale * weight for name, weight in true.pair_weights.items()}
        print(f"{scale:g} times the true weights")
        compare(solver, Games(energy, records, dataclasses.replace(true, own_weights=own, pair_weights=pair)))


def compare(solver: Feedback, games: Games) -> None:
    """Print the lines of some games."""
    exactly = dataclasses.replace(solver, tolerance=1e-9, iterations=400, terms=60)
    exact = solve("exact", exactly, games)
    solve("with acceleration", solver, games, exact)
    with mock.patch.object(iteration, "Anderson", Plain):
        solve("without", solver, games, exact)
        solve("without, twice as many", dataclasses.replace(solver, iterations=2 * solver.iterations), games, exact)
    usable = (exact.status == Status.SOLVED).all(1)
    wanted = gradient(exactly, games, usable)
    for steps in STEPS:
        found = gradient(dataclasses.replace(exactly, terms=steps), games, usable)
        error = (found - wanted).norm(dim=-1) / wanted.norm(dim=-1)
        print(f"derivative, GMRES with {steps} steps: relative error {quantiles(error[usable])}")


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    command_line("feedback_games", __doc__.splitlines()[0], measure, argv)


if __name__ == "__main__":
    main()
