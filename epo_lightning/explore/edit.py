"""Changes of the game of one scene, as a page sends them, and their application."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch

from epo_lightning.forecast import GameParameters
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.scene import Scene, wrapped

FARTHEST = 1e4
"""Largest size of a coordinate, angle or speed: farther away, single precision has no digits left for the game."""
LARGEST = 1000.0
"""Largest factor of a weight. The energy squares weights, so larger ones have no use, and lose digits."""


@dataclass(frozen=True)
class Edit:
    """Changes of the game of one scene. Agents are numbered from zero.

    Attributes:
        scene: index of the scene.
        mode: joint mode whose energies and Nash gap are reported; None for the most likely one.
        factors: factor of the learned weight, for every agent and mode, by name of the feature.
        goals: goal [x, y] in m by agent, the same in all modes.
        states: current state [x, y, heading, speed] in m, rad and m/s by agent. The agent's history becomes a motion at
            constant velocity that ends there, and the network infers the game anew.
        absent: agents that are not there.
        pair_terms: whether agents interact.
    """

    scene: int = 0
    mode: int | None = None
    factors: Mapping[str, float] = field(default_factory=dict)
    goals: Mapping[str, Sequence[float]] = field(default_factory=dict)
    states: Mapping[str, Sequence[float]] = field(default_factory=dict)
    absent: Sequence[int] = ()
    pair_terms: bool = True

    def __post_init__(self) -> None:
        for name, factor in self.factors.items():
            if not 0 <= factor <= LARGEST:
                raise ConfigError(f"factors.{name} must be a number from 0 to {LARGEST:g}, not {factor!r}")
        for key, size, what in (("goals", 2, "[x, y] in m"), ("states", 4, "[x, y, heading, speed] in m, rad and m/s")):
            for agent, values in getattr(self, key).items():
                if not agent.isdecimal() or str(int(agent[:9])) != agent:
                    raise ConfigError(f"{key}.{agent} must have the number of an agent as its name, such as {key}.0")
                if len(values) != size or not all(abs(value) <= FARTHEST for value in values):
                    raise ConfigError(f"{key}.{agent} must be {what}, at most {FARTHEST:g} in size, not {list(values)}")

    def check(self, scene: Scene, modes: int, names: Sequence[str]) -> None:
        """Check that the changes fit a scene of one batch entry.

        Raises:
            ConfigError: an agent that the scene does not have, a mode or a feature that the game does not have, or no
                agent left.
        """
        present = scene.agent_mask[0].nonzero().flatten().tolist()
        for key in ("goals", "states", "absent"):
            for agent in map(int, getattr(self, key)):
                if agent not in present:
                    raise ConfigError(f"{key}: the scene has the agents {present}, not {agent}")
        if not {*present} - {*self.absent}:
            raise ConfigError("absent: at least one agent has to stay")
        if self.mode is not None and not 0 <= self.mode < modes:
            raise ConfigError(f"mode must be a number from 0 to {modes - 1}, not {self.mode}")
        for name in self.factors:
            if name not in names:
                raise ConfigError(f"factors: the game has no feature {name!r}: {nearest(name, names)}")

    def moved(self, scene: Scene) -> Scene:
        """The scene in which agents with a new state have driven there at constant velocity.

        The heading of a new state is an angle; those that the agent wants at its goals are the nearest ones to it.
        """
        if not self.states:
            return scene
        history, wanted = scene.history.clone(), scene.goal_headings
        wanted = None if wanted is None else wanted.clone()
        past = torch.arange(1 - history.shape[2], 1) * scene.dt
        for agent, values in self.states.items():
            x, y, heading, speed = values
            history[:, int(agent), :, 0] = x + past * speed * math.cos(heading)
            history[:, int(agent), :, 1] = y + past * speed * math.sin(heading)
            history[:, int(agent), :, 2] = heading
            history[:, int(agent), :, 3] = speed
            if wanted is not None:
                wanted[:, int(agent)] = heading + wrapped(wanted[:, int(agent)] - heading)
        mask = scene.history_mask.clone()
        mask[:, [int(agent) for agent in self.states]] = True
        return dataclasses.replace(scene, history=history, history_mask=mask, goal_headings=wanted)

    def without_absent(self, scene: Scene) -> Scene:
        """The scene without the agents that are not there."""
        mask = scene.agent_mask.clone()
        mask[:, list(self.absent)] = False
        return dataclasses.replace(scene, agent_mask=mask)

    def applied(self, parameters: GameParameters) -> GameParameters:
        """The game with other weights and goals."""
        own = {name: weight * self.factors.get(name, 1.0) for name, weight in parameters.own_weights.items()}
        factors = self.factors if self.pair_terms else dict.fromkeys(parameters.pair_weights, 0.0)
        pair = {name: weight * factors.get(name, 1.0) for name, weight in parameters.pair_weights.items()}
        goals = parameters.goals
        if goals is not None and self.goals:
            goals = goals.clone()
            for agent, position in self.goals.items():
                goals[:, :, int(agent)] = goals.new_tensor(position)
        return dataclasses.replace(parameters, own_weights=own, pair_weights=pair, goals=goals)
