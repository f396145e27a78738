"""How far the best of M predictions stays from what happened (Section 5, Metrics).

With e[m,i,k] the distance [m] between the predicted and the observed position of agent i at step k, and mean_k the mean
over the observed steps of an agent:

========  ==================================  ==================================================
minADE    mean_i min_m mean_k e[m,i,k]        every agent chooses its own mode (marginal)
minFDE    mean_i min_m e[m,i,K]
minSADE   min_m mean_i mean_k e[m,i,k]        one mode for all agents of the scene (joint)
minSFDE   min_m mean_i e[m,i,K]
========  ==================================  ==================================================

Each metric takes its own best mode: the minSFDE need not belong to the mode of the minSADE.

Agents without any observed step, and for the final displacements those whose last step was not observed, are left out
of the mean over agents. A scene without any agent left is NaN. A prediction that is not finite where something was
observed is infinitely far from it, so that a broken forecast cannot pass for an unobserved scene.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def min_ade(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Mean over agents of the average displacement of each agent's own best mode [m].

    Args:
        states: predictions, x and y [m] first; further entries of a state are not looked at.
        future: what happened, likewise.
        mask: True where an agent was observed.
    """
    return _marginal(*_average_errors(states, future, mask))


def min_fde(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Mean over agents of the displacement at step K of each agent's own best mode [m]; as :func:`min_ade`."""
    return _marginal(*_final_errors(states, future, mask))


def min_sade(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Average displacement of all agents in the best joint mode [m]; arguments as of :func:`min_ade`."""
    return _joint(*_average_errors(states, future, mask))


def min_sade_of_likely(
    states: Float[Tensor, "B M N K X"],
    probabilities: Float[Tensor, "B M"],
    future: Float[Tensor, "B N K _"],
    mask: Bool[Tensor, "B N K"],
) -> Float[Tensor, "B M"]:
    """The minSADE among the k most likely joint modes, k = 1 .. M [m]; of equally likely ones the first count."""
    error, counted = _average_errors(states, future, mask)
    order = probabilities.argsort(dim=1, descending=True, stable=True)
    joint = (error.sum(-1) / counted.sum(-1, keepdim=True)).gather(1, order)
    return joint.cummin(1).values


def min_sfde(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Displacement at step K of all agents in the best joint mode [m]; arguments as of :func:`min_ade`."""
    return _joint(*_final_errors(states, future, mask))


def _distances(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, "B M N K"]:
    """e[m,i,k], zero where nothing was observed (also if a number behind the mask is not one)."""
    offset = states[..., :2] - future[:, None, ..., :2]
    error = torch.linalg.vector_norm(offset, dim=-1)
    error = error.nan_to_num(nan=torch.inf, posinf=torch.inf)
    return torch.where(mask[:, None], error, 0.0)


def _average_errors(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> tuple[Float[Tensor, "B M N"], Bool[Tensor, "B N"]]:
    """Mean over the observed steps, and which agents have any."""
    steps = mask.sum(-1)
    return _distances(states, future, mask).sum(-1) / steps[:, None].clamp_min(1), steps > 0


def _final_errors(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> tuple[Float[Tensor, "B M N"], Bool[Tensor, "B N"]]:
    """Error at the last step, and which agents were observed there."""
    last = mask[..., -1:]
    return _distances(states[..., -1:, :], future[..., -1:, :], last)[..., 0], last[..., 0]


def _marginal(error: Float[Tensor, "B M N"], counted: Bool[Tensor, "B N"]) -> Float[Tensor, " B"]:
    """mean_i min_m; errors of agents that are not counted are zero already, 0 / 0 is the NaN of an empty scene."""
    return error.amin(1).sum(-1) / counted.sum(-1)


def _joint(error: Float[Tensor, "B M N"], counted: Bool[Tensor, "B N"]) -> Float[Tensor, " B"]:
    """min_m mean_i."""
    return error.sum(-1).amin(-1) / counted.sum(-1)
