"""Choice of the pairs of agents that interact, from their present states: within a distance, the nearest ones, or groups.

The distance of a pair is the smallest gap between the agents' discs (radius: half the length) within a time T if both keep
their velocities,

    c_ij = min_{0 <= t <= T} |p_i - p_j + t (v_i - v_j)| - r_i - r_j,

which is negative if the discs would overlap. It is known before anything is decoded, unlike the distance of forecasts, and
it finds a vehicle that approaches from far away, unlike the present distance. A choice is symmetric, because pair terms are.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.circles import disc
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.scene import Scene, velocities


def closest_approach(scene: Scene, ahead: float) -> Float[Tensor, "B P"]:
    """Smallest gap [m] between the discs of two agents that keep their velocities; infinite for pairs with an absent agent.

    Args:
        scene: present states [B, N, 4], and sizes, without which agents are points.
        ahead: time T [s] that is looked ahead; 0 for the present gap.
    """
    exists = pair_mask(scene)
    first, second = pairs(scene.agent_mask.shape[1], exists.device)
    current = scene.current_or_zero
    velocity = velocities(current)
    offset = current[:, first, :2] - current[:, second, :2]
    closing = velocity[:, first] - velocity[:, second]
    # Agents with equal velocities are closest now: the numerator is then zero.
    slowest = torch.finfo(closing.dtype).tiny
    time = (-(offset * closing).sum(-1) / closing.square().sum(-1).clamp_min(slowest)).clamp(0.0, ahead)
    gap = (offset + time[..., None] * closing).norm(dim=-1)
    if scene.size is not None:
        radius = disc(torch.where(scene.agent_mask[..., None], scene.size, 0.0))
        gap = gap - radius[:, first] - radius[:, second]
    return torch.where(exists & gap.isfinite(), gap, torch.inf)


def within(distance: Float[Tensor, "B P"], radius: float) -> Bool[Tensor, "B P"]:
    """Mask of the pairs that come as close as ``radius`` [m]."""
    return distance <= radius


def nearest(distance: Float[Tensor, "B P"], agents: int, count: int) -> Bool[Tensor, "B P"]:
    """Mask of the pairs of which one agent is among the ``count`` nearest ones of the other.

    An agent that many others have among their nearest ones is in more than ``count`` pairs, but there are never more than
    N ``count`` pairs. Pairs at an infinite distance are never chosen.
    """
    first, second = pairs(agents, distance.device)
    table = distance.new_full((len(distance), agents, agents), torch.inf)
    table[:, first, second] = table[:, second, first] = distance
    # A stable sort, so that the choice among equal distances does not depend on absent agents behind.
    order = table.sort(dim=-1, stable=True).indices[..., :count]
    chosen = torch.zeros_like(table, dtype=torch.bool).scatter_(-1, order, True)
    return (chosen[:, first, second] | chosen[:, second, first]) & (distance < torch.inf)


def grouped(chosen: Bool[Tensor, "B P"], distance: Float[Tensor, "B P"], agents: int, most: int) -> Bool[Tensor, "B P"]:
    """The chosen pairs without those that would join more than ``most`` agents to one group.

    A group is a set of agents that chosen pairs connect: the solver factorises the matrix of a group as a whole, at a cost
    that grows with the cube of its agents. Pairs are taken in ascending order of their distance (single linkage); a pair
    that would make a group too large is left out.
    """
    keep = torch.zeros(chosen.shape, dtype=torch.bool)
    order = torch.where(chosen, distance, torch.inf).sort(dim=-1, stable=True).indices.cpu()
    for row, (ranked, count) in enumerate(zip(order, chosen.sum(-1).tolist(), strict=True)):
        taken, _ = _joined(ranked[:count].tolist(), agents, most)
        keep[row, taken] = True
    return keep.to(chosen.device)


def group_sizes(chosen: Bool[Tensor, "B P"], agents: int) -> list[list[int]]:
    """Numbers of agents of all groups of every scene, agents alone among them."""
    return [
        [len(group) for group in _joined(row.nonzero()[:, 0].tolist(), agents, agents)[1] if group]
        for row in chosen.cpu()
    ]


def _joined(ranked: Sequence[int], agents: int, most: int) -> tuple[list[int], list[list[int]]]:
    """The pairs that connect at most ``most`` agents to a group, taken one after the other, and the groups."""
    first, second = (index.tolist() for index in pairs(agents))
    group, members = list(range(agents)), [[agent] for agent in range(agents)]
    taken = []
    for pair in ranked:
        one, other = group[first[pair]], group[second[pair]]
        if one != other:
            if len(members[one]) + len(members[other]) > most:
                continue
            for agent in members[other]:
                group[agent] = one
            members[one], members[other] = members[one] + members[other], []
        taken.append(pair)
    return taken, members
