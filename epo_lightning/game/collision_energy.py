"""DSDNet's energy: a network's cost of every trajectory, and a constant cost of every collision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.checks import check_choice, check_number, check_whole
from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import disc, length_of, row_extent, row_overlap, rows_may_overlap
from epo_lightning.game.dynamics import Dynamics
from epo_lightning.game.limits import Bound
from epo_lightning.game.network_energy import NetworkEnergy
from epo_lightning.game.networks import MOTION, Layers, motion, squared_distances
from epo_lightning.game.pairs import pairs
from epo_lightning.registry import register
from epo_lightning.scene import SHAPES, SPEED, Scene

_AT_ONCE = 100_000
"""Number of pairs of rows of circles that are compared together, which bounds the memory."""


@register("energy", "collision")
class CollisionEnergy(NetworkEnergy):
    """E_i = v . layers([z_i, waypoints of i]), E_ij = gamma if i and j collide at any step, else 0 (Zeng et al., ECCV 2020).

    At a few waypoints, evenly spread over the horizon, the network takes x, y, cos, sin of the heading, and the distance
    travelled, in the agent's own frame at t0. The cost of a collision has no useful gradient, so this energy offers values
    alone: it is for minimisers that choose among candidates.

    Differences from the original: the agents' features come from the backbone instead of a detector's regions of interest
    and a map sampled at the waypoints; shapes are those of the task, discs or rows of circles
    (:mod:`~epo_lightning.game.circles`), instead of boxes, from which rows of circles differ by decimetres; a pair is
    counted once, not in both orders; the detection loss and the max-margin planning loss have no counterpart; gamma is
    not published.

    Args:
        dynamics, width, horizon, scale, own, pair, bounds, pair_stride: see
            :class:`~epo_lightning.game.network_energy.NetworkEnergy`.
        shape: ``disc``, of the agent's length as diameter, or ``box``, rows of circles.
        gamma: cost of a collision.
        waypoints: number of waypoints.
        hidden: size of the hidden features.

    Raises:
        ConfigError: an unknown shape, a gamma that is not positive and finite, or no waypoint or hidden feature.
    """

    offers = frozenset()
    term, pair_term = "trajectory", "collision"

    def __init__(
        self,
        dynamics: Dynamics,
        width: int,
        horizon: int,
        scale: float,
        shape: str,
        own: Sequence[str] = (),
        pair: Sequence[str] = (),
        bounds: Mapping[str, Bound] | None = None,
        pair_stride: int = 1,
        gamma: float = 10.0,
        waypoints: int = 5,
        hidden: int = 64,
    ) -> None:
        super().__init__(dynamics, width, horizon, scale, own, pair, bounds, pair_stride)
        check_whole("energy.hidden", hidden)
        check_choice("shape", shape, SHAPES, of="agents")
        check_number("energy.gamma", gamma)
        check_whole("energy.waypoints", waypoints)
        self.shape, self.gamma = shape, gamma
        count = min(waypoints, horizon)
        self.waypoints = [(number + 1) * horizon // count - 1 for number in range(count)]
        self.layers = Layers((width, MOTION * count), hidden)
        self.own_value = nn.Linear(hidden, 1, bias=False)

    @property
    def needs(self) -> set[str]:
        """Inputs of every network energy, and the agents' sizes."""
        return super().needs | {"size"}

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Check as :meth:`~epo_lightning.game.network_energy.NetworkEnergy.validate`, and that sizes are given."""
        super().validate(scene, parameters, controls)
        self.size(scene)

    def network_own(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> Float[Tensor, "B C N"]:
        initial = self.current_states(scene)
        seen = motion(states, initial, self.scale)
        before = torch.cat((torch.zeros_like(seen[..., :1, :2]), seen[..., :2]), -2)
        way = length_of(before.diff(dim=-2)).cumsum(-1)
        seen = torch.cat((seen[..., : SPEED + 1], way[..., None]), -1)[..., self.waypoints, :]
        return self.own_value(self.layers(self.context(scene, parameters), seen.flatten(-2)))[..., 0]

    def network_pair(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> Float[Tensor, "B C P"]:
        sizes = [self.size(scene)[:, None, members] for members in pairs(scene.agent_mask.shape[1], first.device)]
        collide = self.collide(first, second, *sizes)
        return self.gamma * collide.to(first.dtype)

    def network_tables(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> tuple[Float[Tensor, "B C N"], Float[Tensor, "B P C C"]]:
        members = pairs(states.shape[2], states.device)
        left, right = (states[:, :, agents].transpose(1, 2) for agents in members)
        sizes = [self.size(scene)[:, agents, None, None] for agents in members]
        collide = self.collide(left[:, :, :, None], right[:, :, None], *sizes)
        return self.network_own(scene, parameters, states), self.gamma * collide.to(states.dtype)

    @torch.no_grad()
    def collide(
        self,
        first: Float[Tensor, "*#batch K 4"],
        second: Float[Tensor, "*#batch K 4"],
        first_size: Float[Tensor, "*#batch 2"],
        second_size: Float[Tensor, "*#batch 2"],
    ) -> Bool[Tensor, "*batch"]:
        """Whether two agents overlap at any step; touching is no overlap."""
        if self.shape == "disc":
            reach = (disc(first_size) + disc(second_size)).square()
            return reduce(torch.logical_or, (squared < reach for squared in squared_distances(first, second)))
        return _rows_collide(first, second, first_size, second_size)


def _rows_collide(
    first: Float[Tensor, "*#batch K 4"],
    second: Float[Tensor, "*#batch K 4"],
    first_size: Float[Tensor, "*#batch 2"],
    second_size: Float[Tensor, "*#batch 2"],
) -> Bool[Tensor, "*batch"]:
    """Whether two rows of circles overlap at any step.

    Rows are compared only where the discs around them overlap, neither is beside the other, and no collision was found at
    an earlier step.
    """
    shape = torch.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    reach = (row_extent(first_size) + row_extent(second_size)).expand(shape)
    # Slightly more than the sum, so that no rounding error hides a collision.
    squared_reach = (1.0001 * reach).square()
    hit = torch.zeros(shape, dtype=torch.bool, device=first.device)
    for k, squared in enumerate(squared_distances(first, second)):
        both = [values.expand(*shape, -1) for values in (first[..., k, :], second[..., k, :], first_size, second_size)]
        close = ((squared < squared_reach) & ~hit).nonzero()
        for some in close.split(_AT_ONCE):
            index = some.unbind(-1)
            states = [values[index] for values in both]
            near = rows_may_overlap(*states)
            overlap = row_overlap(*(values[near, None] for values in states))
            hit[tuple(entry[near] for entry in index)] = overlap[:, 0] > 0
    return hit
