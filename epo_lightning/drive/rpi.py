"""The robot-pedestrian game as a world: the robot is planned, and the pedestrian plays the true game or ignores the robot.

Every episode is a main game of its own (:mod:`epo_lightning.data.rpi.game`), with a weight w and a placement of the
pedestrian that no training set has. For the first 1.8 s, the history that forecasters need, both agents follow their parts
of a mode of the main game. Then the robot is planned until the game ends after 10 s. The pedestrian

- ``plays``: every 0.1 s it solves the rest of the true game anew from the present states and the rest of its last solution,
  and follows its part of it. Every 0.5 s it also starts from a robot that goes on straight, and takes the cheaper one;
- ``ignores``: it follows the solution of its own costs alone, from the start on, whatever the robot does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from epo_lightning.checks import check_choice, check_whole
from epo_lightning.data.rpi.game import AGENTS, Array, GameConstants, MainGame, generator, main_game
from epo_lightning.data.rpi.kernels import costs, rollout, step
from epo_lightning.data.rpi.modes import cheapest
from epo_lightning.data.rpi.scenes import DISC_DIAMETER
from epo_lightning.data.rpi.solve import PotentialSettings, solve, solve_potential
from epo_lightning.data.rpi.subgames import HISTORY, by_agent, main_starts
from epo_lightning.drive.world import EGO, SEEDS, Outcome, Search
from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

PEDESTRIANS = ("plays", "ignores")
TOGETHER = 50
"""Largest number of episodes begun together. Fewer take longer per episode; with more, progress is reported less often."""
RECONSIDERED = 5
"""Steps after which a pedestrian that plays looks for a better solution than that near its plan."""
_SETTINGS = PotentialSettings()
_BOTH = np.ones(AGENTS)
ENERGY = FeatureEnergy(
    own=("goal", "heading", "vel", "acc", "turnr", "velb", "accb", "turnrb"),
    pair=("clearance",),
    margins={"clearance": GameConstants().radius - DISC_DIAMETER},
    bounds={
        "vel": (GameConstants().speed_min, GameConstants().speed_max),
        "acc": (-GameConstants().acceleration_limit, GameConstants().acceleration_limit),
        "turnr": (-GameConstants().turn_limit, GameConstants().turn_limit),
    },
)
"""The class of the true games, as an energy of the layer."""


def true_game(weight: Tensor, goals: Tensor, headings: Tensor, steps: int) -> GameParameters:
    """The true games with the weights of their pair terms, as games of :data:`ENERGY` in float64.

    Args:
        weight: w of every game [B].
        goals: goal positions [B, N, 2] in m.
        headings: headings [B, N] in rad wanted at the goals.
        steps: number of steps until the games end.
    """
    constants = GameConstants()
    squared = {
        **dict.fromkeys(("goal", "heading"), constants.terminal),
        **dict.fromkeys(("acc", "turnr"), constants.effort),
        "vel": constants.slowness,
        **dict.fromkeys(("accb", "turnrb", "velb"), 2 * constants.bound),
    }
    batch = len(weight)
    return GameParameters(
        own_weights={name: goals.new_full((batch, 1, AGENTS), value**0.5).double() for name, value in squared.items()},
        pair_weights={"clearance": (2 * weight.double()).sqrt()[:, None, None]},
        initial_controls=torch.zeros(batch, 1, AGENTS, steps, 2, dtype=torch.double),
        goals=goals.double()[:, None],
        goal_headings=headings.double()[:, None],
    )


class RPIWorld:
    """Episodes of the robot-pedestrian game. An episode does not depend on those that are begun together with it.

    Args:
        episodes: number of episodes.
        seed: seed of their games; the same seed gives the same episodes.
        pedestrian: ``plays`` or ``ignores``.

    Raises:
        ConfigError: a value out of its range.
    """

    agents = AGENTS
    shape = "disc"
    energy = ENERGY
    arrived = 5.0
    patience = 2.0
    search = Search()

    def __init__(self, episodes: int, seed: int = 0, pedestrian: str = "plays") -> None:
        check_whole("episodes", episodes)
        check_choice("pedestrian", pedestrian, PEDESTRIANS)
        self.constants, self.pedestrian = GameConstants(), pedestrian
        self._c, self.dt = self.constants.array(), self.constants.dt
        self._games = [main_game(SEEDS + seed, index, 0, 1, self.constants) for index in range(episodes)]
        self._seed = seed
        self._begun: dict[int, tuple[Array, Array]] = {}
        self.together = min(TOGETHER, episodes)
        self.reset(range(self.together))

    def __len__(self) -> int:
        return len(self._games)

    def reset(self, episodes: Sequence[int]) -> None:
        self.games = [self._games[episode] for episode in episodes]
        self.weight = torch.tensor([game.weight for game in self.games], dtype=torch.double)
        self._goals = torch.tensor(np.stack([game.goals for game in self.games]))
        begun = [self._start(episode) for episode in episodes]
        self._x, self._u = (np.stack(values) for values in zip(*begun, strict=True))
        self.now = HISTORY

    def _start(self, episode: int) -> tuple[Array, Array]:
        """States [K+1, 8] and controls [K, 4] of the main game's mode that is begun; the pedestrian's future is its plan.

        One of the two modes is drawn. A pedestrian that ignores the robot follows its own solution from the start. The
        games are solved when their episodes are begun for the first time.
        """
        if episode not in self._begun:
            self._begun[episode] = self._solved(self._games[episode])
        return self._begun[episode]

    def _solved(self, game: MainGame) -> tuple[Array, Array]:
        random = generator(SEEDS + self._seed, game.game, 0, 1)
        main = solve(game.start, main_starts(random, self.constants.steps), self._c, game.goals, game.weight)
        modes = cheapest(main, self.constants)
        index = modes[sorted(modes)[random.integers(len(modes))]]
        u = main.controls[index].copy()
        if self.pedestrian == "ignores":
            alone = np.zeros_like(u)
            _, alone, _, _ = solve_potential(game.start, alone, self._c, game.goals, 0.0, _BOTH, _SETTINGS)
            u[:, 2:] = alone[:, 2:]
        return rollout(game.start, u, self._c[0]), u

    @property
    def going(self) -> Tensor:
        return torch.arange(len(self.games) if self.now < self.constants.steps else 0)

    def observe(self) -> Scene:
        history = torch.tensor(by_agent(self._x[:, self.now - HISTORY : self.now + 1]))
        return Scene(
            history=history,
            dt=self.constants.dt,
            goal_candidates=self._goals[:, :, None, :2],
            goal_headings=self._goals[:, :, None, 2],
            size=history.new_full((len(history), AGENTS, 2), DISC_DIAMETER),
            id=torch.arange(len(history)),
            game_steps=torch.full((len(history),), self.constants.steps - self.now),
        )

    def game(self, scene: Scene) -> GameParameters:
        assert scene.id is not None
        goals = self._goals[scene.id]
        steps = max(2, self.constants.steps - self.now)  # an energy takes two steps or more; `game_steps` ends the game
        return true_game(self.weight[scene.id], goals[..., :2], goals[..., 2], steps)

    def advance(self, controls: Tensor | None) -> None:
        if controls is None:
            raise ConfigError("world=rpi has no driver of its own: the robot needs a planner")
        for b, (game, control) in enumerate(zip(self.games, controls.double().numpy(), strict=True)):
            x, u = self._x[b, self.now], self._u[b]
            if self.pedestrian == "plays":
                u[self.now :] = self._solution(x, u[self.now :], game)
            u[self.now, :2] = control
            step(x, u[self.now], self._c[0], self._x[b, self.now + 1])
        self.now += 1

    def _solution(self, x: Array, plan: Array, game: MainGame) -> Array:
        """Solution [K, 4] of the rest of the game from the plan; at times, the cheaper one of this and a second solution."""
        starts = [plan]
        if (self.now - HISTORY) % RECONSIDERED == 0:
            straight = plan.copy()
            straight[:, :2] = 0.0
            starts.append(straight)
        found: list[tuple[float, Array]] = []
        for start in starts:
            states, controls, _, _ = solve_potential(x, start, self._c, game.goals, game.weight, _BOTH, _SETTINGS)
            found.append((sum(costs(states, controls, self._c, game.goals, game.weight)), controls))
        return min(found, key=lambda pair: pair[0])[1]

    def close(self) -> None:
        """Does nothing: the game is simulated here."""

    def outcome(self) -> Outcome:
        """States, the distance by which the robot is nearer to its goal than at its start, and its ``cost`` in the true game
        since it was planned, with the proximity cost counted in full."""
        states = torch.tensor(by_agent(self._x[:, HISTORY : self.now + 1]))
        batch, agents, steps = states.shape[:3]
        costs_of_robot = []
        for x, u, game in zip(self._x, self._u, self.games, strict=True):
            robot, _, pair = costs(x[HISTORY : self.now + 1], u[HISTORY : self.now], self._c, game.goals, game.weight)
            costs_of_robot.append(robot + pair)
        left = (states[:, EGO, :, :2] - self._goals[:, EGO, None, :2]).norm(dim=-1)
        return Outcome(
            states=states,
            agent_mask=torch.ones(batch, agents, steps, dtype=torch.bool),
            size=states.new_full((batch, agents, 2), DISC_DIAMETER),
            progress=2 * self.constants.circle - left,
            measures={"cost": torch.tensor(costs_of_robot, dtype=torch.double)},
        )
