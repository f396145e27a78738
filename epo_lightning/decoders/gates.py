"""Gates: the choice of the pairs of agents that interact, in front of the game.

A pair that a gate leaves out has a weight of zero: neither a network nor the solver computes anything for it. Without a
gate, all pairs are in the game, and the solver leaves out those that do not touch.

A gate with few neighbours does not make a solution fast by itself: its time grows with the cube of the agents that chosen
pairs connect, and a chain of neighbours may connect a whole scene. ``group`` limits these groups
(:func:`~epo_lightning.game.neighbours.grouped`); time then grows linearly with the number of agents.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.checks import check_number, check_whole
from epo_lightning.game.neighbours import closest_approach, grouped, nearest, within
from epo_lightning.game.pairs import pairs
from epo_lightning.registry import register
from epo_lightning.scene import Scene

UNTRAINED = 0.01
"""Factor of the usual initial weights of keys. Zero would hold the queries' gradient at zero as well."""


class Gated(NamedTuple):
    """The pairs that interact.

    Attributes:
        chosen: mask of the pairs that are in the game.
        factor: factor of the weights of all pair features; None for 1.
    """

    chosen: Bool[Tensor, "B P"]
    factor: Float[Tensor, "B P"] | None = None


class Gate(nn.Module):
    """The interface of gates.

    Args:
        group: largest number of agents that are solved together; None for any number.
        ahead: time [s] within which agents that keep their velocities are looked for: the horizon of the forecast.
    """

    def __init__(self, group: int | None, ahead: float) -> None:
        super().__init__()
        if group is not None:
            check_whole("gate.group", group, least=2)
        self.group, self.ahead = group, ahead

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Gated:
        """The pairs of a scene that interact; agents' features ``z`` are what a learned gate decides by."""
        with torch.no_grad():
            distance = closest_approach(scene, self.ahead)
        return self.choose(distance, z)

    @abstractmethod
    def choose(self, distance: Float[Tensor, "B P"], z: Float[Tensor, "B N D"]) -> Gated:
        """The pairs that interact, from their distances of closest approach [m] (infinite if an agent is absent)."""

    def limited(self, chosen: Bool[Tensor, "B P"], distance: Float[Tensor, "B P"], agents: int) -> Bool[Tensor, "B P"]:
        """The chosen pairs without those that would make a group too large; those with a small distance stay."""
        return chosen if self.group is None else grouped(chosen, distance, agents, self.group)


@register("gate", "radius")
class RadiusGate(Gate):
    """Pairs whose discs come closer than a distance.

    Args:
        radius: largest gap [m] between the discs at the closest approach.
        group: largest number of agents that are solved together; None for any number.
        ahead: time [s] ahead within which the closest approach is looked for; 0 for the present distance.
    """

    def __init__(self, radius: float = 10.0, group: int | None = None, ahead: float = 0.0) -> None:
        super().__init__(group, ahead)
        check_number("gate.radius", radius, zero=True)
        self.radius = radius

    def choose(self, distance: Float[Tensor, "B P"], z: Float[Tensor, "B N D"]) -> Gated:
        return Gated(self.limited(within(distance, self.radius), distance, z.shape[1]))


@register("gate", "nearest")
class NearestGate(Gate):
    """Pairs of which one agent is among the k nearest ones of the other, at the closest approach.

    Args:
        neighbours: k.
        group: largest number of agents that are solved together; None for any number.
        ahead: time [s] ahead within which the closest approach is looked for; 0 for the present distance.
    """

    def __init__(self, neighbours: int = 4, group: int | None = None, ahead: float = 0.0) -> None:
        super().__init__(group, ahead)
        check_whole("gate.neighbours", neighbours, least=1)
        self.neighbours = neighbours

    def choose(self, distance: Float[Tensor, "B P"], z: Float[Tensor, "B N D"]) -> Gated:
        agents = z.shape[1]
        return Gated(self.limited(nearest(distance, agents, self.neighbours), distance, agents))


@register("gate", "attention")
class AttentionGate(Gate):
    """Pairs that matter most to one of their agents, by a learned score; the score also scales their weights.

    With the closest approach c_ij and the symmetric attention

        s_ij = (q_i . k_j + q_j . k_i) / (2 sqrt(D)),    q = Q z, k = K z,

    an agent keeps the k others with the largest s_ij - c_ij / scale, and the weights of a pair are multiplied by
    2 sigmoid(s_ij). K starts near zero, so that an untrained gate is nearly a :class:`NearestGate`. The choice has no
    gradient; the factor teaches the scores.

    Args:
        neighbours: k.
        size: D, the size of queries and keys.
        group: largest number of agents that are solved together; None for any number.
        ahead: time [s] ahead within which the closest approach is looked for; 0 for the present distance.
        width: size of the agent features.
        scale: distance [m] that counts as much as one unit of the score.
    """

    def __init__(
        self,
        neighbours: int = 4,
        size: int = 32,
        group: int | None = None,
        ahead: float = 0.0,
        width: int = 128,
        scale: float = 1.0,
    ) -> None:
        super().__init__(group, ahead)
        check_whole("gate.neighbours", neighbours, least=1)
        check_whole("gate.size", size, least=1)
        check_number("gate.scale", scale)
        self.neighbours, self.scale = neighbours, scale
        self.query, self.key = nn.Linear(width, size, bias=False), nn.Linear(width, size, bias=False)
        with torch.no_grad():
            self.key.weight.mul_(UNTRAINED)

    def choose(self, distance: Float[Tensor, "B P"], z: Float[Tensor, "B N D"]) -> Gated:
        agents = z.shape[1]
        query, key = self.query(z), self.key(z)
        product = query @ key.mT / math.sqrt(query.shape[-1])
        first, second = pairs(agents, z.device)
        score = 0.5 * (product[:, first, second] + product[:, second, first])
        score = torch.where(distance < torch.inf, score, 0.0)  # features of absent agents have no meaning
        ranking = distance / self.scale - score.detach()
        chosen = self.limited(nearest(ranking, agents, self.neighbours), ranking, agents)
        return Gated(chosen, 2.0 * score.sigmoid())
