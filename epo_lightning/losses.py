"""Terms of training objectives (Appendix E.4). Every loss is a mean over scenes.

Cross entropies take log-probabilities (:attr:`~epo_lightning.forecast.JointForecast.log_probabilities`), so that their
gradient by the logits is softmax - one-hot even if the probability underflows.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from epo_lightning.schedules import is_positive


def soft_minimum(distance: Float[Tensor, "B M ..."], temperature: float | Tensor) -> Float[Tensor, "B ..."]:
    """The soft minimum over dimension 1 at a positive temperature (:class:`~epo_lightning.schedules.Annealing`).

    Modes at an infinite distance do not count.
    """
    count = distance.isfinite().sum(1).clamp_min(1).to(distance.dtype)
    return -temperature * ((-_rounded(distance, temperature) / temperature).logsumexp(1) - count.log())


def _rounded(distance: Tensor, temperature: float | Tensor) -> Tensor:
    """h(d) = sqrt(d^2 + T^2) - T, without the cancellation for small d; infinite for an infinite d, without a gradient."""
    known = distance.isfinite()
    ratio = torch.where(known, distance, 0.0) / temperature
    # With s = sqrt(r^2 + 1), h = T r^2 / (s + 1); hypot and the order of factors do not overflow for a large d.
    stretched = torch.hypot(ratio, torch.ones_like(ratio))
    return torch.where(known, distance * (ratio / (stretched + 1.0)), distance)


def distances(
    positions: Float[Tensor, "B M N K 2"],
    future: Float[Tensor, "B N K 4"],
    mask: Bool[Tensor, "B N K"],
    power: float = 1.0,
) -> Float[Tensor, "B M N"]:
    """Mean Euclidean distance [m] of each agent's futures from the observed one, over observed steps; 0 without any.

    With a ``power`` above 1, a step's distance is the mean over both coordinates of their absolute errors to that power, as
    in TGL, which uses 1.05. The squared norm of a trajectory, which Appendix E.4 prints, is 2 K times the distance of
    power 2.

    The power decides whether modes can stay untaught. If one mode is the closest to two observed futures of the same
    history, the sum of its Euclidean distances from both is the same all along the way between them, so it may stay at one
    of them. With a power above 1, the sum is smallest half way, where another mode is soon closer to one of both.

    Raises:
        ValueError: forecast and observation differ in the number of scenes, agents or steps.
    """
    batch, _, agents, steps, _ = positions.shape
    if future.shape[:3] != (batch, agents, steps) or mask.shape != future.shape[:3]:
        raise ValueError(
            f"the forecast has shape {list(positions.shape)} [B, M, N, K, 2], but the observed future "
            f"{list(future.shape)} [B, N, K, 4] and its mask {list(mask.shape)}: the horizon K of data and model must agree"
        )
    observed = mask[:, None]
    offset = torch.where(observed[..., None], positions - future[:, None, ..., :2], 0.0)
    error = torch.linalg.vector_norm(offset, dim=-1) if power == 1.0 else (offset.abs() ** power).mean(-1)
    return error.sum(-1) / observed.sum(-1).clamp_min(1)


def _mean_over_agents(values: Tensor, mask: Bool[Tensor, "B N K"]) -> Tensor:
    present = mask.any(-1)
    present = present[:, None].expand_as(values) if values.dim() == 3 else present
    return torch.where(present, values, 0.0).sum(-1) / present.sum(-1).clamp_min(1)


def _relaxed(
    closest: Float[Tensor, " B *agents"], distance: Float[Tensor, "B M *agents"], relaxation: float | Tensor
) -> Float[Tensor, " B *agents"]:
    """The distance of the closest mode, mixed with a share of the mean over all modes.

    Without relaxation, modes at an infinite distance do not count.
    """
    return torch.lerp(closest, distance.mean(1), relaxation) if is_positive(relaxation) else closest


def scene_imitation(
    distance: Float[Tensor, "B M N"],
    mask: Bool[Tensor, "B N K"],
    relaxation: float | Tensor = 0.0,
    temperature: float | Tensor = 0.0,
) -> tuple[Float[Tensor, ""], Int[Tensor, " B"]]:
    """L_imit, the minSADE: distance of the joint future closest to the observed one, and the index of that mode.

    Args:
        distance: distance [m] of every mode and agent (:func:`distances`).
        mask: observed steps.
        relaxation: share of the mean over modes (:class:`~epo_lightning.schedules.Relaxation`).
        temperature: temperature [m] of the soft minimum (:class:`~epo_lightning.schedules.Annealing`); 0 for the minimum.
    """
    joint = _mean_over_agents(distance, mask)
    closest, mode = joint.min(1)
    if is_positive(temperature):
        closest = soft_minimum(joint, temperature)
    return _relaxed(closest, joint, relaxation).mean(), mode


def mode_shares(
    distance: Float[Tensor, "B M N"], mask: Bool[Tensor, "B N K"], temperature: float | Tensor
) -> Float[Tensor, "B M"]:
    """Share of every mode in an annealed loss at a positive temperature (:class:`.Annealing`), without a gradient."""
    return (-_rounded(_mean_over_agents(distance.detach(), mask), temperature) / temperature).softmax(1)


def scene_probability(
    log_probabilities: Float[Tensor, "B M"], mode: Int[Tensor, " B"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, ""]:
    """L_prob: cross entropy between the joint futures' probabilities and the closest one; 0 where nothing was observed."""
    entropy = _cross_entropy(log_probabilities, mode)
    return torch.where(mask.flatten(1).any(1), entropy, 0.0).mean()


def goal(
    log_probabilities: Float[Tensor, "B N G"],
    candidates: Float[Tensor, "B N G 2"],
    exists: Bool[Tensor, "B N G"],
    final: Float[Tensor, "B N 2"],
    observed: Bool[Tensor, "B N"],
) -> Float[Tensor, ""]:
    """L_goal: cross entropy between each agent's goal probabilities and the candidate closest to its ``final`` position.

    Averaged over the agents that have a candidate and whose last step was ``observed``.
    """
    taught = observed & exists.any(-1)
    way = torch.where((exists & taught[..., None])[..., None], candidates - final[:, :, None], torch.inf)
    closest = way.square().sum(-1).argmin(-1)
    cost = _cross_entropy(log_probabilities.mT, closest)
    return _mean_over_agents(cost, taught[..., None]).mean()


def marginal_imitation(
    distance: Float[Tensor, "B M N"],
    mask: Bool[Tensor, "B N K"],
    relaxation: float | Tensor = 0.0,
    temperature: float | Tensor = 0.0,
) -> tuple[Float[Tensor, ""], Int[Tensor, "B N"]]:
    """The minADE: mean over agents of the distance of their own closest futures, and the indices of these modes.

    Arguments as of :func:`scene_imitation`.
    """
    closest, mode = distance.min(1)
    if is_positive(temperature):
        closest = soft_minimum(distance, temperature)
    return _mean_over_agents(_relaxed(closest, distance, relaxation), mask).mean(), mode


def marginal_probability(
    log_probabilities: Float[Tensor, "B M N"], mode: Int[Tensor, "B N"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, ""]:
    """Cross entropy between each agent's probabilities and its own closest future, averaged over agents."""
    return _mean_over_agents(_cross_entropy(log_probabilities, mode), mask).mean()


def _cross_entropy(
    log_probabilities: Float[Tensor, "B choices *agents"], chosen: Int[Tensor, " B *agents"]
) -> Float[Tensor, " B *agents"]:
    """-log p of the chosen ones.

    A mode with p = 0 (a repeated one) costs -log of the smallest positive number, without a gradient.
    """
    cost = F.nll_loss(log_probabilities, chosen, reduction="none")
    return torch.where(cost == torch.inf, -math.log(torch.finfo(cost.dtype).tiny), cost)


def joint_density(log_density: Float[Tensor, " B"], mask: Bool[Tensor, "B N K"]) -> Float[Tensor, ""]:
    """Negative log density of every scene's observation; 0 for scenes without any."""
    return torch.where(mask.flatten(1).any(1), surprise(log_density), 0.0).mean()


def marginal_density(
    log_density: Float[Tensor, "B M N"], mode: Int[Tensor, "B N"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, ""]:
    """Negative log density of each agent's own closest future, averaged over agents."""
    return _mean_over_agents(surprise(log_density.gather(1, mode[:, None])[:, 0]), mask).mean()


def surprise(log_density: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """-log p. If log p is infinite or NaN, -log of the smallest positive number, without a gradient."""
    least = torch.finfo(log_density.dtype).tiny
    return -torch.where(log_density.isfinite(), log_density, math.log(least))
