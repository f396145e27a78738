"""Global interaction: every agent looks at every other one."""

from __future__ import annotations

import math

from jaxtyping import Bool, Float
from torch import Tensor, nn


class Attention(nn.Module):
    """One layer of single-head attention over polyline features, with a residual connection (VectorNet, Section 3.3).

    Args:
        width: size of the features, in and out.
    """

    def __init__(self, width: int = 128) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.value = nn.Linear(width, width)
        self.scale = 1.0 / math.sqrt(width)

    def forward(self, features: Float[Tensor, "B N D"], mask: Bool[Tensor, "B N"]) -> Float[Tensor, "B N D"]:
        """Features after each has gathered from those that ``mask`` says exist."""
        scores = self.query(features) @ self.key(features).mT * self.scale
        # A large negative number instead of -inf keeps a scene without any agent finite.
        scores = scores.masked_fill(~mask[:, None, :], -1e9)
        return features + scores.softmax(-1) @ self.value(features)
