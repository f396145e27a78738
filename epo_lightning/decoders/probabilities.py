"""Scene probability decoding: the probability of each joint future."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP
from epo_lightning.scene import HEADING, rotated


class SceneProbabilities(nn.Module):
    """phi_prob: logits of the M joint futures from all agents' features and all futures (Section 4.4).

    The paper concatenates the features and trajectories of all agents and applies a perceptron of two layers. Here the first
    layer, which is the product of two linear maps, has the same block for every agent. Its result is a sum over agents, so
    any number and order of agents and any padding work. Inputs are future positions relative to the agent's current
    position, without a gradient.

    The sum comes before the first nonlinearity, so of the motions the logits see only the sum of all displacements: "both
    agents pass on the left" and "both pass on the right" have the same probability. :class:`PairwiseProbabilities` tells
    them apart.

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
        current: Float[Tensor, "B N 4"],
        mask: Bool[Tensor, "B N"],
    ) -> Float[Tensor, "B M"]:
        """Logits of the joint futures; their softmax over the modes are the probabilities."""
        travelled = (positions.detach() - current[:, None, :, None, :2]).transpose(1, 2).flatten(2)
        agents = self.agent(torch.cat((z, travelled / self.scale), -1))
        return self.scene(torch.where(mask[..., None], agents, 0.0).sum(1))


class PairwiseProbabilities(nn.Module):
    """phi_prob with the relative motion of every two agents of a mode, one network for all pairs and all modes.

    Every agent sees its own future, and the positions of every other agent relative to it, both in its own frame (forward
    and left of its current heading). With own features a_i, features b_ij of the pairs and both averaged over the agents,

        s_m = mean_i (a_i + mean_j b_ij),    logit_m = f(s_m, mean_m s_m).

    The logits do not depend on the order of agents, on padding, or on the position and rotation of the scene (except through
    z), and are reordered with the modes. A mirrored mode has another logit: an agent on the left is not one on the right.
    No gradient flows to the futures.

    Args:
        width: size of the agent features.
        modes: number M of joint modes; it does not change the network.
        horizon: number K of future steps.
        scale: unit [m] of positions at the network's inputs.
    """

    def __init__(self, width: int, modes: int, horizon: int, scale: float = 1.0) -> None:
        super().__init__()
        if modes < 1:
            raise ValueError(f"modes must be 1 or more, not {modes}")
        self.scale = scale
        self.own = MLP(width + 2 * horizon, 64, 64, layers=2)
        # The linear layer of a pair, in three parts: the first two are computed per agent, which is N times cheaper.
        self.subject = nn.Linear(64, 64)
        self.other = nn.Linear(64, 64, bias=False)
        self.relative = nn.Linear(2 * horizon, 64, bias=False)
        self.norm = nn.LayerNorm(64)
        self.mode = MLP(2 * 64, 64, 1, layers=2, bias=False)  # the softmax over modes cancels a bias

    def forward(
        self,
        z: Float[Tensor, "B N D"],
        positions: Float[Tensor, "B M N K 2"],
        current: Float[Tensor, "B N 4"],
        mask: Bool[Tensor, "B N"],
    ) -> Float[Tensor, "B M"]:
        """Logits of the joint futures; their softmax over the modes are the probabilities."""
        modes, agents = positions.shape[1:3]
        z = torch.where(mask[..., None], z, 0.0)
        current = torch.where(mask[..., None], current, 0.0)
        positions = torch.where(mask[:, None, :, None, None], positions.detach(), 0.0)
        heading = current[:, None, :, None, HEADING]
        travelled = rotated(positions - current[:, None, :, None, :2], -heading) / self.scale
        own = self.own(torch.cat((z[:, None].expand(-1, modes, -1, -1), travelled.flatten(-2)), -1))  # B M N 64

        relative = rotated(positions[:, :, None] - positions[:, :, :, None], -heading[:, :, :, None]) / self.scale
        pair = self.subject(own)[:, :, :, None] + self.other(own)[:, :, None] + self.relative(relative.flatten(-2))
        pair = self.norm(pair).relu()  # B M N N 64
        others = mask[:, None] & ~torch.eye(agents, dtype=torch.bool, device=mask.device)  # B N N
        seen = _mean(pair, others[:, None])

        joint = _mean(own + seen, mask[:, None])
        return self.mode(torch.cat((joint, joint.mean(1, keepdim=True).expand_as(joint)), -1))[..., 0]


def _mean(features: Float[Tensor, "*batch N D"], mask: Bool[Tensor, "*some N"]) -> Float[Tensor, "*batch D"]:
    """Mean over the agents where ``mask`` is True; zero without any."""
    total = torch.where(mask[..., None], features, 0.0).sum(-2)
    return total / mask.sum(-1, keepdim=True).clamp_min(1)


PROBABILITIES: dict[str, type[SceneProbabilities] | type[PairwiseProbabilities]] = {
    "linear": SceneProbabilities,
    "pairwise": PairwiseProbabilities,
}
"""Decoders of mode probabilities by their name in the configuration; ``linear`` is the paper's."""
