"""Edges and groups: pairs of agents that may interact, and sets of agents whose matrices are factorised together."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import Scene


@dataclass(frozen=True)
class Edges:
    """A list of pairs of agents of all problems; agent i of problem b has the number b N + i, pair p the number b P + p.

    Attributes:
        first, second: numbers s N + i and s N + j of the agents.
        pair: number s P + p of the pair.
        problems, agents: numbers of problems and of their agents.
        every: whether these are all pairs, in order.
    """

    first: Int[Tensor, " E"]
    second: Int[Tensor, " E"]
    pair: Int[Tensor, " E"]
    problems: int
    agents: int
    every: bool

    @classmethod
    def all(cls, problems: int, agents: int, device: torch.device) -> Edges:
        """Every pair of every problem."""
        first, second = pairs(agents, device)
        start = agents * torch.arange(problems, device=device)[:, None]
        pair = torch.arange(problems * len(first), device=device)
        return cls((start + first).flatten(), (start + second).flatten(), pair, problems, agents, every=True)

    @classmethod
    def none(cls, problems: int, agents: int, device: torch.device) -> Edges:
        """No pair at all."""
        empty = torch.zeros(0, dtype=torch.long, device=device)
        return cls(empty, empty, empty, problems, agents, every=False)

    @classmethod
    def near(
        cls, energy: FeatureEnergy, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B M N K 4"]
    ) -> Edges:
        """The pairs that may interact: both agents are present, a pair weight is not zero, and the agents come close.

        They come close if the bounding boxes of their trajectories, widened by their extents and margins, overlap.
        """
        batch, modes, agents = states.shape[:3]
        weights = torch.stack([energy.pair_weight(scene, parameters, name) for name in energy.pair])
        matters = (weights != 0).any(0)
        first, second = pairs(agents, states.device)
        extent = energy.extent(scene)
        if extent is not None:
            position = energy.at_pair_steps(states[..., :2])
            if position.shape[3]:
                extent = extent[:, None, :, None]
                low, high = position.amin(3) - extent, position.amax(3) + extent
                margins = [energy.margin(scene, parameters, n) for n, one in energy.pair_features.items() if one.margin]
                if margins:
                    wider = torch.stack([margin.expand_as(matters) for margin in margins]).amax(0)[..., None]
                    one, other = low[:, :, first] - wider, low[:, :, second] - wider
                else:
                    one, other = low[:, :, first], low[:, :, second]
                matters &= ((one < high[:, :, second]) & (other < high[:, :, first])).all(-1)
        if matters.all():
            return cls.all(batch * modes, agents, states.device)
        pair = matters.flatten().nonzero()[:, 0]
        problem, within = pair // len(first), pair % len(first)
        start = agents * problem
        return cls(start + first[within], start + second[within], pair, batch * modes, agents, every=False)

    def of_pairs(self, values: Float[Tensor, " pairs *rest"]) -> Float[Tensor, " E *rest"]:
        """The values of these edges, from those of all pairs of all problems."""
        return values if self.every else values.index_select(0, self.pair)

    def ends(
        self, values: Float[Tensor, "problems N *rest"]
    ) -> tuple[Float[Tensor, " E *rest"], Float[Tensor, " E *rest"]]:
        """The values of the first and of the second agent of every edge."""
        flat = values.flatten(0, 1)
        return flat.index_select(0, self.first), flat.index_select(0, self.second)

    def difference(self, values: Float[Tensor, "problems N *rest"]) -> Float[Tensor, " E *rest"]:
        """The first agent's value minus the second's."""
        first, second = self.ends(values)
        return first.sub_(second)

    def spread_(self, onto: Float[Tensor, "problems N *rest"], first: Tensor, second: Tensor) -> None:
        """Add values of edges to their first and second agents, in place.

        On a CPU values are added edge by edge, so that sums do not depend on the rest of the batch. On other devices, if all
        pairs are edges, a product with the incidence matrix is used, which is deterministic, unlike parallel additions.
        """
        if onto.device.type == "cpu" or not self.every:
            onto.flatten(0, 1).index_add_(0, self.first, first).index_add_(0, self.second, second)
            return
        numbers = torch.arange(self.agents, device=onto.device)[:, None]
        for index, values in zip(pairs(self.agents, onto.device), (first, second), strict=True):
            incidence = (index == numbers).to(onto.dtype).expand(self.problems, -1, -1)
            onto.add_((incidence @ values.reshape(self.problems, incidence.shape[-1], -1)).view_as(onto))


@dataclass(frozen=True)
class Group:
    """C sets of m agents whose matrices are assembled together.

    Attributes:
        agents: numbers b N + i of the agents; None for all agents of all problems, in order.
        count, size: C and m.
        edges: indices of the edges within the sets; None for all edges.
        component, first, second: index of the set of each edge, and indices of both agents within the set.
    """

    agents: Int[Tensor, "C m"] | None
    count: int
    size: int
    edges: Int[Tensor, " e"] | None
    component: Int[Tensor, " e"]
    first: Int[Tensor, " e"]
    second: Int[Tensor, " e"]

    @classmethod
    def whole(cls, edges: Edges) -> Group:
        """Every problem as one set."""
        problem = edges.first // max(edges.agents, 1)
        start = problem * edges.agents
        return cls(None, edges.problems, edges.agents, None, problem, edges.first - start, edges.second - start)

    def subset(self, chosen: Int[Tensor, " D"]) -> Group:
        """The group of some of these sets."""
        agents = self.agents
        if agents is None:
            agents = torch.arange(self.count * self.size, device=chosen.device).view(self.count, self.size)
        place = torch.full((self.count,), -1, device=chosen.device)
        place[chosen] = torch.arange(len(chosen), device=chosen.device)
        kept = (place[self.component] >= 0).nonzero()[:, 0]
        return Group(
            agents[chosen],
            len(chosen),
            self.size,
            kept if self.edges is None else self.edges[kept],
            place[self.component[kept]],
            self.first[kept],
            self.second[kept],
        )

    def of_edges(self, values: Float[Tensor, " E *rest"]) -> Float[Tensor, " e *rest"]:
        """The values of this group's edges."""
        return values if self.edges is None else values.index_select(0, self.edges)

    def coupled(
        self, own: Float[Tensor, "C 3 K m"], shared: Float[Tensor, "E 3 K"] | None
    ) -> Float[Tensor, "C 3 m K m"]:
        """Stiffness between all agents: ``own`` on the diagonal, and minus ``shared`` between the agents of an edge."""
        full = own.new_zeros(self.count, 3, self.size, own.shape[2], self.size)
        full.diagonal(dim1=2, dim2=4).copy_(own)
        if shared is not None:
            shared = -self.of_edges(shared)
            full[self.component, :, self.first, :, self.second] = shared
            full[self.component, :, self.second, :, self.first] = shared
        return full
