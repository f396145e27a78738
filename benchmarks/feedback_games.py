"""Costs of feedback equilibria, and the errors of solutions and derivatives, on the games that made RPI.

    epo generate data=rpi data.placements=8 data.solver=feedback_converged
    python -m benchmarks.feedback_games data=rpi data.placements=8 data.solver=feedback_converged

The games have their true weights, and 0.3 times these, which make the iteration slower; overrides are those of `epo train`.
Solutions are compared with exact ones, which have a tolerance of 1e-9 and up to 400 LQ games, and derivatives with those of
60 steps of GMRES. The loss is the SADE of the mode that is closest to the executed future; its derivative is by all weights
and goals. Times of the iteration alone are those from the same open-loop equilibria to a tolerance of a millimetre, in the
compiled kernel, in PyTorch, and by the generator of RPI (compiled by Numba, one game at a time), which is the peer.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from unittest import mock

import numpy as np
import torch
from torch import Tensor

from benchmarks.measure import cpu_milliseconds
from benchmarks.true_game import TrueGames, command_line, parts
from epo_lightning.data.rpi import solve as generator
from epo_lightning.data.rpi.game import GameConstants
from epo_lightning.data.rpi.subgames import FUTURE
from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.feedback import iteration, kernel
from epo_lightning.solvers.feedback.anderson import Anderson
from epo_lightning.solvers.feedback.iteration import FeedbackGame
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
    """Solve all games and print a line. LQ games are counted in PyTorch."""
    scene = games.records.scene
    with counted() as numbers:
        found, spent = cpu_milliseconds(lambda: solver(games.energy, scene, games.parameters), len(scene.history))
    solved = found.status == Status.COMPLETED
    line = f"{title:28} solved {int(solved.sum())} of {solved.numel()}"
    if numbers:
        line += f"  {sum(numbers) / solved.numel():5.1f} LQ games each"
    if exact is not None:
        far = (found.states - exact.states)[..., :FUTURE, :].abs().amax((2, 3, 4))
        line += (
            f"  {spent:5.1f} ms of CPU per record  error {quantiles(far[solved & (exact.status == Status.COMPLETED)])}"
        )
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
    race(solver, Games(energy, records, true))
    for scale in SCALES:
        own = {name: scale * weight for name, weight in true.own_weights.items()}
        pair = {name: scale * weight for name, weight in true.pair_weights.items()}
        print(f"{scale:g} times the true weights")
        compare(solver, Games(energy, records, dataclasses.replace(true, own_weights=own, pair_weights=pair)))


@torch.no_grad()
def race(solver: Feedback, games: Games) -> None:
    """Print the times of the iteration from one open-loop equilibrium per record."""
    scene, one = games.records.scene, games.parameters.map(lambda tensor: tensor[:, :1])
    start = solver.open_loop()(games.energy, scene, one).controls
    game = FeedbackGame(games.energy, scene, one, solver.regularisation)

    def line(title: str, run: Callable[[], Tensor]) -> float:
        count = len(run())  # compiles, and fills caches
        solved, spent = cpu_milliseconds(run, count)
        print(f"{title:28} solved {int(solved.sum())} of {count}  {spent:7.3f} ms of CPU per game")
        return spent

    def ours(iterate: Callable[..., tuple[Tensor, Tensor]]) -> Tensor:
        return iterate(game, start, solver.iterations, solver.tolerance)[1].flatten() == Status.COMPLETED

    peer = line("iteration by the generator", lambda: generated(games, start))
    for title, module in (("compiled iteration", kernel), ("iteration in PyTorch", iteration)):
        spent = line(title, lambda module=module: ours(module.iterate))
        print(f"{'':28} {peer / spent:.1f} times as fast as the generator")


def generated(games: Games, start: Tensor) -> Tensor:
    """Whether the generator solves the game of each record, over the steps of that game."""
    scene, settings = games.records.scene, generator.SETTINGS["feedback_converged"]
    assert scene.game_steps is not None
    assert games.parameters.goals is not None
    assert games.parameters.goal_headings is not None
    goals = torch.cat((games.parameters.goals[:, 0], games.parameters.goal_headings[:, 0, :, None]), -1).numpy()
    agents, weights = scene.current.flatten(1).numpy(), games.records.weight.numpy()
    constants, solved = GameConstants().array(), []
    for row, steps in enumerate(scene.game_steps.tolist()):
        u = np.ascontiguousarray(start[row, 0, :, :steps].transpose(0, 1).flatten(1).numpy())
        given = (agents[row], u, constants, goals[row], weights[row], settings)
        solved.append(generator.solve_feedback(*given)[2])
    return torch.tensor(solved)


def compare(solver: Feedback, games: Games) -> None:
    """Print the lines of some games."""
    exactly = dataclasses.replace(solver, tolerance=1e-9, iterations=400, terms=60)
    exact = solve("exact", exactly, games)
    solve("compiled", solver, games, exact)
    plain = dataclasses.replace(solver, backend="pytorch")
    solve("in PyTorch", plain, games, exact)
    with mock.patch.object(iteration, "Anderson", Plain):
        solve("without acceleration", plain, games, exact)
        solve("without, twice as many", dataclasses.replace(plain, iterations=2 * solver.iterations), games, exact)
    usable = (exact.status == Status.COMPLETED).all(1)
    wanted = gradient(exactly, games, usable)
    for steps in STEPS:
        found = gradient(dataclasses.replace(exactly, terms=steps), games, usable)
        error = (found - wanted).norm(dim=-1) / wanted.norm(dim=-1)
        print(f"derivative, GMRES with {steps} steps: relative error {quantiles(error[usable])}")


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    command_line("feedback_games", __doc__, measure, argv)


if __name__ == "__main__":
    main()
