"""Scene probability decoding: the probability of each joint future."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP


class SceneProbabilities(nn.Module):
    """phi_prob: logits of the M joint futures from all agents' features and all futures (Section 4.4).

    The paper concatenates the features and trajectories of all agents and applies a linear layer. Here that layer has the
    same block for every agent, so its result is a sum over agents and works for any number and order of agents and any
    padding. Inputs are future positions relative to the agent's current position, without a gradient.

    Args:
        width: size of the agent features.
        modes: number M of joint modes.
        horizon: number K of future steps.
        scale: unit [m] of positions at the network's inputs.
    """

    def __init__(self, width: int, modes: int, horizon: int, scale: float = 1.0) -> None:
        super().__init__()
        if modes < 1:
            raise ValueError(f"modes must be 1 or more, not {modes}")
        self.scale = scale
        self.agent = nn.Linear(width + modes * horizon * 2, 16 * modes)
        self.scene = MLP(16 * modes, 16 * modes, modes, layers=2, norm="batch")

    def forward(
        self,
        z: Float[Tensor, "B N D"],
        positions: Float[Tensor, "B M N K 2"],
        current: Float[Tensor, "B N 2"],
        mask: Bool[Tensor, "B N"],
    ) -> Float[Tensor, "B M"]:
        """Logits of the joint futures; their softmax over the modes are the probabilities."""
        travelled = (positions.detach() - current[:, None, :, None]).transpose(1, 2).flatten(2)
        agents = self.agent(torch.cat((z, travelled / self.scale), -1))
        return self.scene(torch.where(mask[..., None], agents, 0.0).sum(1))
