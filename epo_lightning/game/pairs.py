"""Pairs of agents i < j. Every tensor of pairs [.., P] has this order: (0, 1), (0, 2), .., (0, N-1), (1, 2), .."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.scene import Scene


def pairs(agents: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """First and second agents i < j of all P = N (N - 1) / 2 pairs."""
    first, second = torch.triu_indices(agents, agents, 1, device=device)
    return first, second


def of_pairs(values: Float[Tensor, "B N D"]) -> Float[Tensor, "B P 2 D"]:
    """The values of the first and the second agent of every pair."""
    agents = torch.stack(pairs(values.shape[1], values.device), 1)
    # The derivative of values[:, agents] would sort the index, which takes a dozen kernels on a GPU.
    return values.index_select(1, agents.flatten()).unflatten(1, agents.shape)


def pair_mask(scene: Scene) -> Bool[Tensor, "B P"]:
    """The pairs of which both agents are present."""
    first, second = pairs(scene.agent_mask.shape[1], scene.agent_mask.device)
    return scene.agent_mask[:, first] & scene.agent_mask[:, second]
