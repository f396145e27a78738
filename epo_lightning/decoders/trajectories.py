"""Trajectory decoding: futures of each agent independently of the others, for the marginal baselines."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP


class Trajectories(nn.Module):
    """M futures of an agent and their probabilities from the agent's feature z_i, one network for all agents.

    Args:
        width: size of the agent features.
        modes: number M of modes of each agent.
        horizon: number K of future steps.
        scale: metres at a network output of one.
    """

    def __init__(self, width: int, modes: int, horizon: int, scale: float = 1.0) -> None:
        super().__init__()
        if modes < 1:
            raise ValueError(f"modes must be 1 or more, not {modes}")
        self.modes, self.horizon, self.scale = modes, horizon, scale
        self.positions = MLP(width, 64, modes * horizon * 2, norm="layer")
        self.logits = MLP(width, 64, modes, norm="layer")

    def forward(
        self, z: Float[Tensor, "B N D"], current: Float[Tensor, "B N 2"]
    ) -> tuple[Float[Tensor, "B M N K 2"], Float[Tensor, "B M N"], Float[Tensor, "B M N"]]:
        """Positions [m], and probabilities and logits of each agent's own modes."""
        travelled = (self.scale * self.positions(z)).unflatten(-1, (self.modes, self.horizon, 2)).transpose(1, 2)
        logits = self.logits(z)
        return current[:, None, :, None] + travelled, logits.softmax(-1).transpose(1, 2), logits.transpose(1, 2)
