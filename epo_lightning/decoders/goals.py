"""Goal decoding: the goal position of every agent in every mode, given by the data or chosen among candidates."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from epo_lightning.decoders.mlp import MLP
from epo_lightning.host import readable
from epo_lightning.scene import Scene

NO_CANDIDATE = -1e9
"""Logit of absent candidates, whose probability is exactly zero. (-inf would give NaN for agents without candidates.)"""


@dataclass(frozen=True)
class Goals:
    """Goals of all agents in every mode.

    Attributes:
        exist: agents that have a goal.
        positions: goal positions [m], zero for agents without a goal; None if the energy needs no goals.
        reference: index of the reference line on which each goal lies; None for scenes without reference lines.
        logits: logits of the candidates, ``NO_CANDIDATE`` for absent ones; None where goals are not chosen.
        chosen: index of the candidate chosen in each mode; None where goals are not chosen.
        headings: headings [rad] wanted at the goals, zero for agents without a goal; None for scenes without goal headings.
    """

    exist: Bool[Tensor, "B N"]
    positions: Float[Tensor, "B M N 2"] | None = None
    reference: Int[Tensor, "B M N"] | None = None
    logits: Float[Tensor, "B N G"] | None = None
    chosen: Int[Tensor, "B M N"] | None = None
    headings: Float[Tensor, "B M N"] | None = None

    @property
    def probabilities(self) -> Float[Tensor, "B N G"] | None:
        """Probabilities of the candidates, zero for absent ones; None where goals are not chosen."""
        return None if self.logits is None else self.logits.softmax(-1).where(self.logits > NO_CANDIDATE, 0.0)

    @property
    def log_probability(self) -> Float[Tensor, "B _"]:
        """Log-probability [B, M] of every mode's joint choice of goals, without a gradient; [B, 1] zeros for given goals.

        It has no gradient because goal logits are trained by the agents' observed final positions (L_goal) alone.
        """
        if self.logits is None or self.chosen is None:
            return torch.zeros(len(self.exist), 1, device=self.exist.device)
        choices = self.logits.detach().log_softmax(-1).gather(-1, self.chosen.transpose(1, 2))
        return torch.where(self.exist[..., None], choices, 0.0).sum(1)


def given_goals(scene: Scene) -> Float[Tensor, "B N 2"]:
    """The single given goal of each agent, zero for agents without a goal. (In the paper's RPI experiments goals are given.)

    Raises:
        ValueError: the scene gives no goal, or several candidates per agent.
    """
    if scene.goal_candidates is None:
        raise ValueError("this forecaster reads given goals, but scene.goal_candidates [B, N, 1, 2] is None")
    if scene.goal_candidates.shape[2] != 1:
        raise ValueError(
            f"this forecaster takes one given goal per agent, shape [B, N, 1, 2], but scene.goal_candidates has "
            f"{scene.goal_candidates.shape[2]} per agent"
        )
    return scene.goal_candidates[:, :, 0].where(_exist(scene)[:, :, :1], 0.0)


class NoGoals(nn.Module):
    """Stand-in for a goal decoder where the energy asks for no goals."""

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Goals:
        """Goals without positions, for no agent."""
        return Goals(torch.zeros_like(scene.agent_mask))


class GivenGoals(nn.Module):
    """The goals that the data gives, the same in every mode; nothing is learned.

    Args:
        variants: number of choices of goals: one for each mode, or a single one.
    """

    def __init__(self, variants: int) -> None:
        super().__init__()
        self.variants = variants

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Goals:
        """The given goals.

        Raises:
            ValueError: the scene gives no goal, or several candidates per agent.
        """
        positions = given_goals(scene)[:, None].expand(-1, self.variants, -1, -1)
        exist, headings = _exist(scene)[:, :, 0], None
        if scene.goal_headings is not None:
            headings = scene.goal_headings[:, :, 0].where(exist, 0.0)[:, None].expand(-1, self.variants, -1)
        return Goals(exist, positions, headings=headings)


class GoalDecoder(nn.Module):
    """phi_goal: probability of each of an agent's goal candidates, one network for all agents (after TNT).

    The agent's feature is concatenated to each candidate's position relative to the agent (Appendix E.1, "Goal Decoder").
    Mode m takes every agent's m-th most likely candidate.

    Args:
        width: size of the agent features.
        scale: unit [m] of positions at the network's inputs.
        variants: number of choices of goals: one for each mode, or a single one.
    """

    def __init__(self, width: int, scale: float = 1.0, variants: int = 1) -> None:
        super().__init__()
        self.width, self.scale, self.variants = width, scale, variants
        self.mlp = MLP(width + 2, 64, 1, norm="batch", bias=False)

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Goals:
        """The M most likely goals of every agent, with the logits of all candidates.

        Raises:
            ValueError: the scene has no candidates.
        """
        logits = self.logits(z, scene)
        chosen = most_likely(logits, self.variants)
        return Goals(_exist(scene).any(-1), *choose(scene, chosen), logits, chosen, chosen_headings(scene, chosen))

    def logits(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B N G"]:
        """Logits of the candidates, ``NO_CANDIDATE`` for absent ones.

        Raises:
            ValueError: the scene has no candidates.
        """
        candidates, exists = goal_candidates(scene)
        way = (candidates - scene.current[:, :, None, :2]) / self.scale
        # The first layer of the concatenation, without a copy of the agent's feature for every candidate.
        first = self.mlp.hidden[0]
        assert isinstance(first, nn.Linear)
        of_agent, of_way = first.weight.split([self.width, 2], 1)
        agent = F.linear(z, of_agent, first.bias)
        if readable(exists):  # only the candidates that exist, which is fewer rows
            owner = exists.flatten(0, 1).nonzero()[:, 0]
            logits = self.mlp.after_first(agent.flatten(0, 1)[owner] + F.linear(way[exists], of_way))
            return logits.new_full(exists.shape, NO_CANDIDATE).masked_scatter(exists, logits)
        way = torch.where(exists[..., None], way, 0.0)
        logits = self.mlp.after_first(agent[:, :, None] + F.linear(way, of_way), exists)[..., 0]
        return torch.where(exists, logits, NO_CANDIDATE)


def goal_candidates(scene: Scene) -> tuple[Float[Tensor, "B N G 2"], Bool[Tensor, "B N G"]]:
    """Goal candidates of all agents, and the mask of those that exist; absent agents have none.

    Raises:
        ValueError: the scene has no candidates.
    """
    if scene.goal_candidates is None:
        raise ValueError(
            "this forecaster chooses among goal candidates, but scene.goal_candidates [B, N, G, 2] is None"
        )
    return scene.goal_candidates, _exist(scene)


def _exist(scene: Scene) -> Bool[Tensor, "B N G"]:
    """Goal candidates that exist, of agents that exist."""
    assert scene.goal_mask is not None
    return scene.goal_mask & scene.agent_mask[..., None]


def most_likely(logits: Float[Tensor, "B N G"], modes: int) -> Int[Tensor, "B M N"]:
    """Indices of the M most likely candidates of every agent, most likely first; if there are fewer, they are repeated."""
    order = logits.argsort(dim=-1, descending=True, stable=True)
    count = (logits > NO_CANDIDATE).sum(-1, keepdim=True).clamp_min(1)
    rank = torch.arange(modes, device=logits.device) % count
    return order.gather(-1, rank).transpose(1, 2)


def choose(scene: Scene, chosen: Int[Tensor, "B M N"]) -> tuple[Float[Tensor, "B M N 2"], Int[Tensor, "B M N"] | None]:
    """Positions of the chosen candidates and the reference lines on which they lie; zero for agents without candidates."""
    candidates, exists = goal_candidates(scene)
    agent = torch.arange(chosen.shape[2], device=chosen.device)
    index = torch.arange(chosen.shape[0], device=chosen.device)[:, None, None], agent, chosen
    goals = torch.where(exists[index][..., None], candidates[index], 0.0)
    if scene.goal_reference is None:
        return goals, None
    return goals, torch.where(exists[index], scene.goal_reference[index], 0)


def chosen_headings(scene: Scene, chosen: Int[Tensor, "B M N"]) -> Float[Tensor, "B M N"] | None:
    """Headings [rad] of the chosen candidates, zero for agents without candidates; None for scenes without goal headings."""
    if scene.goal_headings is None:
        return None
    take = chosen.transpose(1, 2)
    return scene.goal_headings.where(_exist(scene), 0.0).gather(-1, take).transpose(1, 2)
