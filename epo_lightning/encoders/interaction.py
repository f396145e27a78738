"""Global interaction: attention of every agent to all agents and lanes."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


class Attention(nn.Module):
    """One layer of single-head attention over polyline features, with a residual connection (VectorNet, Section 3.3).

    Args:
        width: size of the features, in and out.
        dropout: dropout rate of the attention's output in training.
    """

    def __init__(self, width: int = 128, dropout: float = 0.0) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.value = nn.Linear(width, width)
        self.drop = nn.Dropout(dropout)
        self.scale = 1.0 / math.sqrt(width)

    def forward(
        self, features: Float[Tensor, "B N D"], sources: Float[Tensor, "B sources D"], mask: Bool[Tensor, "B sources"]
    ) -> Float[Tensor, "B N D"]:
        """Features after attention to the sources where ``mask`` is True; unchanged in scenes without any source."""
        scores = self.query(features) @ self.key(sources).mT * self.scale
        # A large negative number instead of -inf keeps the softmax finite in a scene without any source.
        gathered = scores.masked_fill(~mask[:, None, :], -1e9).softmax(-1) @ self.value(sources)
        return features + torch.where(mask.any(-1)[:, None, None], self.drop(gathered), 0.0)


class TwoStageAttention(nn.Module):
    """Attention of agents to the lanes, followed by attention to each other (Appendix E.1, "Global Interaction").

    Args:
        width: size of the features, in and out.
        map_input: whether the data has lanes; without them there is only the second stage.
        dropout: dropout rate of both stages.
    """

    def __init__(self, width: int = 128, map_input: bool = True, dropout: float = 0.0) -> None:
        super().__init__()
        self.to_lanes = Attention(width, dropout) if map_input else None
        self.to_agents = Attention(width, dropout)

    def forward(
        self,
        agents: Float[Tensor, "B N D"],
        present: Bool[Tensor, "B N"],
        lanes: Float[Tensor, "B L D"],
        drawn: Bool[Tensor, "B L"],
    ) -> Float[Tensor, "B N D"]:
        """Features of agents after both stages; ``present`` and ``drawn`` are the masks of agents and lanes."""
        if self.to_lanes is not None:
            agents = self.to_lanes(agents, lanes, drawn)
        return self.to_agents(agents, agents, present)
