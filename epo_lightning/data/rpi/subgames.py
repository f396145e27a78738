"""Records of a main game with one placement of the pedestrian.

The main game is solved, each of its modes is executed, and every 0.1 s the game from the current state on (a sub-game) is
solved. The sub-game at step k has the remaining K - k steps of the main game. Every sub-game gives one record: the history
until k, and the modes of the future.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from epo_lightning.data.rpi.game import AGENTS, FUTURE, HISTORY, Array, GameConstants, MainGame, generator
from epo_lightning.data.rpi.kernels import costs, passage, potential_gradient
from epo_lightning.data.rpi.modes import admissible, cheapest
from epo_lightning.data.rpi.solve import PotentialSettings, solve, solve_potential

MAIN_STARTS = 12
"""Start strategies of a main game."""
RANDOM_STARTS = 14
"""Random start strategies of a sub-game."""
MODES = 2

Records = dict[str, NDArray]


def main_starts(random: np.random.Generator, steps: int) -> Array:
    """Start strategies [12, K, 4] of a main game: half a cosine of gentle acceleration and turning (Peters, 2020)."""
    shape = np.cos(np.pi * np.arange(steps) / steps)[:, None]
    starts = np.empty((MAIN_STARTS, steps, 2 * AGENTS))
    starts[..., 0::2] = shape * 0.05 * random.uniform(1.5, 2.5, (MAIN_STARTS, 1, AGENTS))
    starts[..., 1::2] = -shape * np.radians(random.uniform(-15.0, 15.0, (MAIN_STARTS, 1, AGENTS)))
    return starts


def random_starts(random: np.random.Generator, steps: int) -> Array:
    """Start strategies [14, K, 4] of a sub-game: a cosine, a fast decay or a bump of random size for each control."""
    time = np.arange(steps) / steps
    shapes = np.stack([np.cos(np.pi * time), np.exp(-5.0 * time), np.sin(np.pi * time) ** 2])
    chosen = shapes[np.arange(RANDOM_STARTS) % len(shapes)][:, :, None]
    starts = np.empty((RANDOM_STARTS, steps, 2 * AGENTS))
    starts[..., 0::2] = chosen * random.normal(0.0, 0.6, (RANDOM_STARTS, 1, AGENTS))
    starts[..., 1::2] = chosen * random.normal(0.0, 0.5, (RANDOM_STARTS, 1, AGENTS))
    return starts


def by_agent(rows: Array) -> Array:
    """Rows split by agent: from [..., T, agents * width] to [..., agents, T, width]."""
    return np.moveaxis(rows.reshape(*rows.shape[:-1], AGENTS, -1), -2, -3)


def best_response_gain(
    start: Array, u: Array, constants: Array, game: MainGame, agent_costs: Array, noise: Array
) -> float:
    """Largest relative decrease of an agent's cost by a best response, that is, by changing its own strategy alone.

    The search for the best response starts from the agent's strategy plus ``noise`` [K, 4]; the other strategy is fixed.
    """
    best = 0.0
    settings = PotentialSettings()
    for i in range(AGENTS):
        moves = np.zeros(AGENTS)
        moves[i] = 1.0
        perturbed = u + noise * np.repeat(moves, 2)
        x, response, _, _ = solve_potential(start, perturbed, constants, game.goals, game.weight, moves, settings)
        best = max(best, (agent_costs[i] - _agent_cost(x, response, constants, game, i)) / agent_costs[i])
    return best


def _agent_cost(x: Array, u: Array, constants: Array, game: MainGame, agent: int) -> float:
    *own, pair = costs(x, u, constants, game.goals, game.weight)
    return own[agent] + pair


def play(seed: int, game: MainGame, constants: GameConstants, solver: str) -> tuple[Records, dict[str, int]]:
    """Records of a main game: its modes are executed and their sub-games solved.

    Returns:
        the records, stacked by field, and counts of solved and dropped games.
    """
    c = constants.array()
    random = generator(seed, game.game, game.placement, 1)
    main = solve(game.start, main_starts(random, constants.steps), c, game.goals, game.weight, solver)
    modes = cheapest(main, constants)
    counts = {
        "main_starts": len(main.converged),
        "main_converged": int(main.converged.sum()),
        "main_kept": int(admissible(main, constants).sum()),
        "main_games": 1,
        "main_both": int(len(modes) == MODES),
        "sub_starts": 0,
        "sub_converged": 0,
        "sub_kept": 0,
        "sub_games": 0,
        "sub_dropped": 0,
    }
    rows: list[dict[str, Any]] = []
    for side, index in modes.items():
        x, u = main.states[index], main.controls[index]
        last = min(int(passage(x)[1]), constants.steps - FUTURE)
        other = main.controls[modes[-side]] if -side in modes else u
        for k in range(HISTORY, last + 1):
            steps = constants.steps - k
            starts = np.concatenate([u[None, k:], other[None, -steps:], random_starts(random, steps)])
            found = solve(x[k], starts, c, game.goals, game.weight, solver)
            chosen = cheapest(found, constants)
            counts["sub_games"] += 1
            counts["sub_starts"] += len(starts)
            counts["sub_converged"] += int(found.converged.sum())
            counts["sub_kept"] += int(admissible(found, constants).sum())
            noise = random.normal(0.0, 0.1, (steps, 2 * AGENTS))
            if side not in chosen:
                counts["sub_dropped"] += 1
                continue
            picks = [chosen[side]] + ([chosen[-side]] if -side in chosen else [])
            row: dict[str, Any] = {
                "history": by_agent(x[k - HISTORY : k + 1]),
                "goals": game.goals[:, :2],
                "states": np.zeros((MODES, AGENTS, FUTURE, 4)),
                "controls": np.zeros((MODES, AGENTS, FUTURE, 2)),
                "cost": np.zeros(MODES),
                "agent_cost": np.zeros((MODES, AGENTS)),
                "gradient": np.zeros(MODES),
                "gain": np.zeros(MODES),
                "distance": np.zeros(MODES),
                "modes": len(picks),
                "converged": found.converged.sum(),
                "weight": game.weight,
                "phi": game.phi,
                "game": game.game,
                "placement": game.placement,
                "executed": side,
                "step": k,
            }
            for m, pick in enumerate(picks):
                row["states"][m] = by_agent(found.states[pick, 1 : FUTURE + 1])
                row["controls"][m] = by_agent(found.controls[pick, :FUTURE])
                row["cost"][m] = found.potential[pick]
                row["agent_cost"][m] = found.agent_costs[pick]
                row["distance"][m] = found.distance[pick]
                strategy = found.controls[pick]
                row["gradient"][m] = np.abs(
                    potential_gradient(found.states[pick], strategy, c, game.goals, game.weight)
                ).max()
                row["gain"][m] = best_response_gain(x[k], strategy, c, game, found.agent_costs[pick], noise)
            rows.append(row)
    if not rows:
        return {}, counts
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}, counts
