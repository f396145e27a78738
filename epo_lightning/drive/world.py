"""Worlds: episodes in which one agent is planned and the others act by themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene

EGO = 0
"""Index of the planned agent in the scenes and outcomes of a world."""
SEEDS = 1_000_000
"""Added to the seeds of episodes, so that no data set has their random numbers."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of B episodes, from the first planned moment on, until the longest one is over.

    Agents of an episode that is over keep their last states, and are masked.

    Attributes:
        states: states of all agents, in one frame for the whole episode.
        agent_mask: agents that exist at each of these times, none of them after the end of the episode.
        size: length and width of every agent [m].
        progress: how far the planned agent has come [m].
        measures: further measures of the episodes, by name; those in ``rates`` are 0 or 1.
        rates: names of the further measures that are shares of the episodes.
        lines: lines of the road, for films of one episode.
    """

    states: Float[Tensor, "B N T+1 4"]
    agent_mask: Bool[Tensor, "B N T+1"]
    size: Float[Tensor, "B N 2"]
    progress: Float[Tensor, "B T+1"]
    measures: Mapping[str, Float[Tensor, " B"]]
    rates: frozenset[str] = frozenset()
    lines: tuple[Float[Tensor, "_ 2"], ...] = ()


@dataclass(frozen=True)
class Search:
    """Settings of the search for minima of known costs.

    Attributes:
        steps: number of steps of the layer, for energies with the features ``accref`` and ``turnrref``; None to descend
            until no step lowers the costs.
        accelerations: accelerations [m/s^2] of the planned agent, until it stands, at which the layer starts as well as at
            the last plan. A descent from a plan that drives through another agent may stay there.
    """

    steps: int | None = None
    accelerations: tuple[float, ...] = ()


class World(Protocol):
    """The interface of worlds: episodes, of which some are begun together and moved by steps of ``dt``.

    The same arguments make the same episodes, and an episode may be begun any number of times. Episodes do not influence
    each other, and those that are over are left out of scenes and games. The planned agent has index :data:`EGO`.

    Attributes:
        dt: length of a step [s].
        agents: number of agents, the first ones of a scene, of which forecasters know; planners that are told the costs
            see all agents of a scene.
        energy: the energy of :meth:`game`.
        shape: shape of the agents' bodies in tests of contact, ``disc`` or ``box``.
        arrived: progress [m] from which an agent that stands has arrived.
        patience: time [s] from which standing before that is a deadlock.
        together: largest number of consecutive episodes that can be begun together.
        search: how planners search minima of the costs of :meth:`game`.
    """

    dt: float
    agents: int
    energy: FeatureEnergy
    shape: str
    arrived: float
    patience: float
    together: int
    search: Search

    def __len__(self) -> int:
        """The number of episodes."""
        ...

    def reset(self, episodes: Sequence[int]) -> None:
        """Begin some episodes."""
        ...

    @property
    def going(self) -> Int[Tensor, " b"]:
        """Indices, among the begun episodes, of those that are not over."""
        ...

    def observe(self) -> Scene:
        """The scenes [b, ...] that a planner may know: histories up to now, goals and sizes, without any future."""
        ...

    def game(self, scene: Scene) -> GameParameters:
        """The games [b, 1, ...] in which the planned agent's own costs are known, over the time that is planned, with
        controls of zero as initial strategies. ``reference_controls`` are those of agents that keep going, if not zero."""
        ...

    def advance(self, controls: Float[Tensor, "b 2"] | None) -> None:
        """Apply controls of the planned agent (acceleration [m/s^2], turn rate [rad/s]) for one step; all others act.

        None lets the world's own driver drive the planned agent.

        Raises:
            ConfigError: None in a world without a driver of its own.
        """
        ...

    def outcome(self) -> Outcome:
        """Outcome of the begun episodes."""
        ...

    def close(self) -> None:
        """End whatever simulates the world."""
        ...
