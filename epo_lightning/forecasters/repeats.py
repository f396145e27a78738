"""Modes that repeat an earlier one: they are one outcome, and have one probability."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from epo_lightning.decoders.orders import repeated
from epo_lightning.forecast import Solution, same_motion


def without_repeated_choices(logits: Float[Tensor, "B M"], choices: Shaped[Tensor, "B M D"]) -> Float[Tensor, "B M"]:
    """Logits of choices, -inf for a choice that repeats an earlier one: the logit of the earlier one is that of both."""
    return torch.where(repeated(choices), -torch.inf, logits)


def earliest_same(states: Float[Tensor, "B M N K _"], agent_mask: Bool[Tensor, "B N"]) -> Int[Tensor, "B M"]:
    """Index of the earliest mode with the same motion (:func:`~epo_lightning.forecast.same_motion`), perhaps its own.

    Motions in a chain, each the same as the next one, are one outcome, in whatever order the modes are.
    """
    modes = states.shape[1]
    present = torch.where(agent_mask[:, None, :, None, None], states, 0.0)
    itself = torch.eye(modes, dtype=torch.bool, device=states.device)
    same = same_motion(present) | itself
    for _ in range((modes - 2).bit_length()):  # boolean matrix products; each doubles the length of the chains
        same = (same[..., None] & same[:, None]).any(2)
    return same.to(torch.uint8).argmax(-1)


def repeats_joined(
    solution: Solution, logits: Float[Tensor, "B M"], horizon: int, agent_mask: Bool[Tensor, "B N"]
) -> tuple[Solution, Float[Tensor, "B M"]]:
    """The solution and the logits of modes of which some have the same motion, and are one outcome.

    All of them get the strategies with the smallest gradient among them: where a solver stops after a few steps, these are
    the nearest to the equilibrium. The earliest mode has the probability of all, and the others a probability of zero.
    Because the motions are equal, a score which takes the closest mode takes the earliest one.

    Args:
        solution: strategies of one game.
        logits: one logit per mode.
        horizon: number of steps of the forecast, in which motions are compared.
        agent_mask: agents that exist.
    """
    earliest = earliest_same(solution.states[..., :horizon, :], agent_mask)
    nearest = smallest_of_same(solution.gradient_norm, earliest)
    scenes = torch.arange(logits.shape[0], device=logits.device)[:, None]  # `len` would be a constant in an export
    return solution.map(lambda tensor: tensor[scenes, nearest]), with_repeats_added(logits, earliest)


def smallest_of_same(norm: Float[Tensor, "B M"], earliest: Int[Tensor, "B M"]) -> Int[Tensor, "B M"]:
    """Index of the mode with the smallest norm among those that share their earliest mode (:func:`earliest_same`).

    It is the first of them if no norm is finite, as for an energy without a gradient.
    """
    same = earliest[..., None] == earliest[:, None]
    comparable = torch.where(norm.isfinite(), norm, torch.finfo(norm.dtype).max)  # argmin takes NaN as the least
    return torch.where(same, comparable[:, None], torch.inf).argmin(-1)


def with_repeats_added(logits: Float[Tensor, "B M"], earliest: Int[Tensor, "B M"]) -> Float[Tensor, "B M"]:
    """Logits of modes after their repetitions were added: those of a repeated outcome are summed as probabilities.

    Args:
        logits: one logit per mode, repetitions included, as a network decodes them.
        earliest: index of the earliest mode with the same motion (:func:`earliest_same`).

    Returns:
        The logit of the sum for the earliest mode, and -inf for the modes that repeat it.
    """
    index = torch.arange(logits.shape[1], device=logits.device)
    # Repetitions keep themselves in their own sum, so that no sum is empty, which would have no derivative.
    belongs = (earliest[..., None] == index) | (index[:, None] == index)
    total = torch.where(belongs, logits[..., None], -torch.inf).logsumexp(1)
    return torch.where(earliest == index, total, -torch.inf)
