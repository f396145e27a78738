"""Noise of RPI's recorded futures: how far they depend on the random start strategies of the solver that made them.

    python -m benchmarks.label_noise

Every main game is solved at a random placement, and one sub-game of each of its executed modes is solved twice, with other
random starts. *Two draws* is the mean distance between the futures that would be recorded in both cases. If the noise is
Gaussian, the mean error of the best possible forecast is this distance divided by the root of two. *Recorded minus played*
is the distance of the recorded executed future from what the agents then do in the main game. Modes that only one draw finds
have no distance; such alternatives are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.command_line import parser_of
from benchmarks.measure import positive
from epo_lightning.data.rpi.game import Array, GameConstants, generator, main_game
from epo_lightning.data.rpi.kernels import passage
from epo_lightning.data.rpi.modes import cheapest
from epo_lightning.data.rpi.solve import SETTINGS, solve
from epo_lightning.data.rpi.subgames import FUTURE, HISTORY, by_agent, main_starts, random_starts

PLACEMENTS = 39
"""Placements of a main game, as in the paper's set."""


@dataclass(frozen=True)
class Noise:
    """Mean distances [m] of positions over the future of sub-games, and iterations of the solver.

    Attributes:
        executed, alternative: distances between the futures of two draws, one entry per sub-game that has the mode.
        played: distances of the recorded executed future from what the agents then do.
        iterations: mean number of iterations of every sub-game.
        single: whether only one draw found the alternative, one entry per sub-game in which a draw found it.
    """

    executed: list[float]
    alternative: list[float]
    played: list[float]
    iterations: list[float]
    single: list[bool]


def measure(solver: str, games: int, seed: int) -> Noise:
    """The noise of one solver of ``data.solver`` over the first main games of a seed."""
    constants, random = GameConstants(), generator(seed, 99)
    noise = Noise([], [], [], [], [])
    for number in range(games):
        placement = int(random.integers(PLACEMENTS))
        game = main_game(seed, number, placement, PLACEMENTS, constants, recipe=1)  # as the table in docs/rpi.md
        starts = main_starts(generator(seed, number, placement, 1), constants.steps)
        main = solve(game.start, starts, constants.array(), game.goals, game.weight, solver)
        modes = cheapest(main, constants)
        for side, index in modes.items():
            states, controls = main.states[index], main.controls[index]
            last = min(int(passage(states)[1]), constants.steps - FUTURE)
            if last < HISTORY:
                continue
            k = int(random.integers(HISTORY, last + 1))
            plans = [controls[k:], main.controls[modes.get(-side, index)][k:]]
            draws: list[dict[int, Array]] = []
            for draw in range(2):
                drawn = random_starts(generator(seed, number, placement, 2 + draw), constants.steps - k)
                begun = np.concatenate([np.stack(plans), drawn])
                found = solve(states[k], begun, constants.array(), game.goals, game.weight, solver)
                draws.append({mode: _positions(found.states[i]) for mode, i in cheapest(found, constants).items()})
                noise.iterations.append(float(found.iterations.mean()))
            one, other = draws
            for mode, distances in ((side, noise.executed), (-side, noise.alternative)):
                if mode in one and mode in other:
                    distances.append(_distance(one[mode], other[mode]))
            if -side in one or -side in other:
                noise.single.append((-side in one) != (-side in other))
            if side in one:
                noise.played.append(_distance(one[side], _positions(states[k:])))
    return noise


def _positions(states: Array) -> Array:
    """Positions [2, K, 2] of both agents over the future, from joint states whose first one is the current state."""
    return by_agent(states[1 : FUTURE + 1])[..., :2]


def _distance(one: Array, other: Array) -> float:
    return float(np.linalg.norm(one - other, axis=-1).mean())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = parser_of("label_noise", __doc__)
    parser.add_argument("--games", type=positive, default=40, help="number of main games")
    parser.add_argument("--seed", type=int, default=0, help="seed of the games")
    given = parser.parse_args(arguments)
    if given.seed < 0:
        parser.error(f"--seed is {given.seed}, expected 0 or more")
    print(f"{given.games} main games of seed {given.seed}; mean (largest) distance in m, number of sub-games")
    print(
        "| data.solver | iterations | two draws: executed | alternative | found by one only | recorded minus played |"
    )
    print("|:--|--:|--:|--:|--:|--:|")
    for solver in SETTINGS:
        noise = measure(solver, given.games, given.seed)
        executed, alternative, played = map(_cell, (noise.executed, noise.alternative, noise.played))
        single = f"{sum(noise.single)} of {len(noise.single)}"
        iterations = f"{np.mean(noise.iterations):.0f}"
        print(f"| {solver} | {iterations} | {executed} | {alternative} | {single} | {played} |", flush=True)


def _cell(values: Sequence[float]) -> str:
    return f"{np.mean(values):.4f} ({np.max(values):.4f}), {len(values)}" if values else "-"


if __name__ == "__main__":
    main()
