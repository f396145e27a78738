"""Pairs of agents i < j. Every tensor of pairs [.., P] has this order: (0, 1), (0, 2), .., (0, N-1), (1, 2), .."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from epo_lightning.scene import Scene


def pairs(agents: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """First and second agents i < j of all P = N (N - 1) / 2 pairs."""
    first, second = torch.triu_indices(agents, agents, 1, device=device)
    return first, second


def pair_mask(scene: Scene) -> Bool[Tensor, "B P"]:
    """The pairs of which both agents are present."""
    first, second = pairs(scene.agent_mask.shape[1], scene.agent_mask.device)
    return scene.agent_mask[:, first] & scene.agent_mask[:, second]
