"""Training objectives (Appendix C.4). Every loss is the mean over scenes of what it says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Relaxation:
    """A share of the imitation loss that goes to the mean over modes instead of the closest one, fading out.

    The paper's loss trains only the closest mode, so a mode that starts out far from the data in some scenes is never
    taught there: it stays dead. A small share early on draws every mode to where the data are, and then lets go.

    Attributes:
        share: of the mean, at the first step; 0 is the paper's loss.
        steps: optimisation steps after which it has faded, linearly, to zero.
    """

    share: float = 0.0
    steps: int = 1000

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1 or self.steps < 1:
            raise ValueError(f"relaxation must be in [0, 1] over 1 step or more, not {self.share} over {self.steps}")

    def at(self, step: int) -> float:
        """The share at an optimisation step."""
        return self.share * max(0.0, 1.0 - step / self.steps)


def distances(
    positions: Float[Tensor, "B M N K 2"],
    future: Float[Tensor, "B N K 4"],
    mask: Bool[Tensor, "B N K"],
    power: float = 1.0,
) -> Float[Tensor, "B M N"]:
    """Mean Euclidean distance [m] of each agent's futures to the observed one, over observed steps; 0 without any.

    A ``power`` raises every step's distance to it; TGL takes 1.05.
    """
    observed = mask[:, None]
    truth = torch.where(mask[..., None], future[..., :2], 0.0)[:, None]
    error = torch.linalg.vector_norm(torch.where(observed[..., None], positions - truth, 0.0), dim=-1)
    if power != 1.0:
        error = error**power
    return error.sum(-1) / observed.sum(-1).clamp_min(1)


def _mean_over_agents(values: Tensor, mask: Bool[Tensor, "B N K"]) -> Tensor:
    present = mask.any(-1)
    present = present[:, None].expand_as(values) if values.dim() == 3 else present
    return torch.where(present, values, 0.0).sum(-1) / present.sum(-1).clamp_min(1)


def scene_imitation(
    distance: Float[Tensor, "B M N"], mask: Bool[Tensor, "B N K"], relaxation: float = 0.0
) -> tuple[Float[Tensor, ""], Int[Tensor, " B"]]:
    """L_imit, the minSADE: distance of the joint future closest to the observed one, and which that is."""
    joint = _mean_over_agents(distance, mask)
    closest, mode = joint.min(1)
    return torch.lerp(closest, joint.mean(1), relaxation).mean(), mode


def scene_probability(
    probabilities: Float[Tensor, "B M"], mode: Int[Tensor, " B"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, ""]:
    """L_prob: cross entropy between the joint futures' probabilities and the closest one; 0 where nothing was observed."""
    entropy = -log(probabilities).gather(1, mode[:, None])[:, 0]
    return torch.where(mask.flatten(1).any(1), entropy, 0.0).mean()


def goal(
    probabilities: Float[Tensor, "B N G"],
    candidates: Float[Tensor, "B N G 2"],
    exists: Bool[Tensor, "B N G"],
    final: Float[Tensor, "B N 2"],
    observed: Bool[Tensor, "B N"],
) -> Float[Tensor, ""]:
    """L_goal: cross entropy between each agent's goal probabilities and the candidate closest to where it ended up.

    Averaged over the agents that have a candidate and whose last step was ``observed``.
    """
    counts = observed & exists.any(-1)
    way = torch.where((exists & counts[..., None])[..., None], candidates - final[:, :, None], torch.inf)
    closest = way.square().sum(-1).argmin(-1)
    cost = -log(probabilities).gather(-1, closest[..., None])
    return _mean_over_agents(cost[..., 0], counts[..., None]).mean()


def marginal_imitation(
    distance: Float[Tensor, "B M N"], mask: Bool[Tensor, "B N K"], relaxation: float = 0.0
) -> tuple[Float[Tensor, ""], Int[Tensor, "B N"]]:
    """The minADE: each agent's distance to its own closest future, averaged, and which future that is."""
    closest, mode = distance.min(1)
    return _mean_over_agents(torch.lerp(closest, distance.mean(1), relaxation), mask).mean(), mode


def marginal_probability(
    probabilities: Float[Tensor, "B M N"], mode: Int[Tensor, "B N"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, ""]:
    """Cross entropy between each agent's probabilities and its own closest future, averaged over agents."""
    return _mean_over_agents(-log(probabilities).gather(1, mode[:, None])[:, 0], mask).mean()


def log(probabilities: Tensor) -> Tensor:
    """The logarithm, finite also where a probability is too small for its precision."""
    return probabilities.clamp_min(torch.finfo(probabilities.dtype).tiny).log()


def joint_density(log_density: Float[Tensor, " B"], mask: Bool[Tensor, "B N K"]) -> Float[Tensor, ""]:
    """-log p of what was observed of every scene; 0 where that is nothing."""
    return torch.where(mask.flatten(1).any(1), surprise(log_density), 0.0).mean()


def marginal_density(
    log_density: Float[Tensor, "B M N"], mode: Int[Tensor, "B N"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, ""]:
    """As :func:`marginal_probability`, but of logarithms: the least likely future is still learned from."""
    return _mean_over_agents(surprise(log_density.gather(1, mode[:, None])[:, 0]), mask).mean()


def surprise(log_density: Tensor) -> Tensor:
    """-log p; what cannot happen, or has no probability, costs what the smallest number would, and teaches nothing."""
    least = torch.finfo(log_density.dtype).tiny
    return -torch.where(log_density.isfinite(), log_density, math.log(least))
