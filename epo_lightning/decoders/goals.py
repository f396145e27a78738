"""Goal decoding: where agents are heading."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from epo_lightning.decoders.mlp import MLP
from epo_lightning.scene import Scene

NO_CANDIDATE = -1e9
"""Logit of what is no candidate: a softmax makes it an exact zero, and stays finite where there is nothing else."""


def given_goals(scene: Scene) -> Float[Tensor, "B N 2"]:
    """The one goal that a scene gives for each agent, zero for absent agents (RPI: "the goal is given and not predicted").

    Raises:
        ValueError: the scene gives no goal, or several candidates of which one would have to be chosen.
    """
    if scene.goal_candidates is None:
        raise ValueError("this forecaster is told the agents' goals, but scene.goal_candidates is None")
    if scene.goal_candidates.shape[2] != 1:
        raise ValueError(
            f"this forecaster takes one given goal per agent, but scene.goal_candidates holds "
            f"{scene.goal_candidates.shape[2]}: give it shape [B, N, 1, 2]"
        )
    return scene.goal_candidates[:, :, 0].where(scene.agent_mask[..., None], 0.0)


class GoalDecoder(nn.Module):
    """phi_goal: how likely an agent is to head for each of its candidates, shared by all agents (after TNT).

    The agent's feature is concatenated to each candidate's position relative to the agent (Appendix C.1, "Goal Decoder").

    Args:
        width: size of the agent features.
        scale: metres that an input of one stands for.
    """

    def __init__(self, width: int, scale: float = 1.0) -> None:
        super().__init__()
        self.width, self.scale = width, scale
        self.mlp = MLP(width + 2, 64, 1, norm="batch", bias=False)

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B N G"]:
        """Logits of the candidates, ``NO_CANDIDATE`` where there is none.

        Raises:
            ValueError: the scene has no candidates.
        """
        candidates, exists = goal_candidates(scene)
        way = (candidates - scene.current[:, :, None, :2])[exists] / self.scale
        # The first layer of the concatenation, without writing the feature down once for every candidate.
        first = self.mlp.hidden[0]
        assert isinstance(first, nn.Linear)
        of_agent, of_way = first.weight.split([self.width, 2], 1)
        agent = F.linear(z, of_agent, first.bias).flatten(0, 1)
        whose = exists.flatten(0, 1).nonzero()[:, 0]
        logits = self.mlp.after_first(agent[whose] + F.linear(way, of_way))
        return logits.new_full(exists.shape, NO_CANDIDATE).masked_scatter(exists, logits)


def goal_candidates(scene: Scene) -> tuple[Float[Tensor, "B N G 2"], Bool[Tensor, "B N G"]]:
    """Where agents may be heading for, and which of these candidates exist; absent agents have none.

    Raises:
        ValueError: the scene has no candidates.
    """
    if scene.goal_candidates is None or scene.goal_mask is None:
        raise ValueError(
            "this forecaster chooses among goal candidates, but scene.goal_candidates [B, N, G, 2] is None"
        )
    return scene.goal_candidates, scene.goal_mask & scene.agent_mask[..., None]


def most_likely(logits: Float[Tensor, "B N G"], modes: int) -> Int[Tensor, "B M N"]:
    """The M most likely candidates of every agent, in that order; who has fewer begins anew with the first."""
    order = logits.argsort(dim=-1, descending=True, stable=True)
    count = (logits > NO_CANDIDATE).sum(-1, keepdim=True).clamp_min(1)
    rank = torch.arange(modes, device=logits.device) % count
    return order.gather(-1, rank).transpose(1, 2)


def choose(scene: Scene, chosen: Int[Tensor, "B M N"]) -> tuple[Float[Tensor, "B M N 2"], Int[Tensor, "B M N"] | None]:
    """Positions of the chosen candidates and the reference lines they lie on; zero for agents without any."""
    candidates, exists = goal_candidates(scene)
    agent = torch.arange(chosen.shape[2], device=chosen.device)
    index = torch.arange(len(chosen), device=chosen.device)[:, None, None], agent, chosen
    goals = torch.where(exists[index][..., None], candidates[index], 0.0)
    if scene.goal_reference is None:
        return goals, None
    return goals, torch.where(exists[index], scene.goal_reference[index], 0)
