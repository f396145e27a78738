"""Worlds: batches of episodes in which one agent is planned and the others act by themselves."""

from __future__ import annotations

from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import GameParameters, Scene

EGO = 0
"""Index of the planned agent in the scenes of a world."""


class World(Protocol):
    """The interface of worlds: a batch of B episodes, moved together by steps of ``scene.dt``.

    The planned agent has index :data:`EGO`.

    Attributes:
        energy: the energy of :meth:`game`.
        shape: shape of the agents' bodies in tests of contact, ``disc`` or ``box``.
        arrived: progress [m] from which an agent that stands has arrived.
    """

    energy: FeatureEnergy
    shape: str
    arrived: float

    @property
    def finished(self) -> bool:
        """Whether the episodes are over."""
        ...

    def observe(self) -> Scene:
        """The scenes that a planner may know: histories up to now, goals and sizes, without any future."""
        ...

    def game(self, scene: Scene) -> GameParameters:
        """The games [B, 1, ...] in which the planned agent's own costs are known, over the rest of the episode, with
        controls of zero as initial strategies."""
        ...

    def advance(self, controls: Float[Tensor, "B 2"]) -> None:
        """Apply controls of the planned agent (acceleration [m/s^2], turn rate [rad/s]) for one step; all others act."""
        ...

    def progress(self, states: Float[Tensor, "B T 4"]) -> Float[Tensor, "B T"]:
        """How far the planned agent has come [m] in each of its states."""
        ...

    def measures(self) -> dict[str, Float[Tensor, " B"]]:
        """Further measures of the episodes so far, by name."""
        ...
