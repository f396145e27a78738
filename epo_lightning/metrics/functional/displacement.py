"""Displacements of the best of M predictions from the observed future (Section 5, Metrics).

With e[m,i,k] the distance [m] between the predicted and the observed position of agent i at step k, and mean_k the mean
over the observed steps of an agent:

========  ==================================  ==================================================
minADE    mean_i min_m mean_k e[m,i,k]        each agent's own best mode (marginal)
minFDE    mean_i min_m e[m,i,K]
minSADE   min_m mean_i mean_k e[m,i,k]        one mode for all agents of the scene (joint)
minSFDE   min_m mean_i e[m,i,K]
========  ==================================  ==================================================

The best mode is chosen for each metric separately: minSFDE and minSADE may be those of different modes. With the probability
p of the mode of the minSADE (the first one if several are equally close), brier-minSADE is minSADE + (1 - p)^2: it adds the
probability's squared error to the displacement, as the brier-minFDE of Argoverse does.

Agents without any observed step are left out of the mean over agents; final displacements also leave out agents whose last
step was not observed. If no agent is left, the value of the scene is NaN. A prediction that is not finite at an observed
step has an infinite displacement, so that a broken forecast is not mistaken for a scene without observations.

Example: two agents stand at the origin; mode 0 is right about the first one, mode 1 nearly right about the second one.

    >>> import torch
    >>> from epo_lightning.metrics.functional import min_ade, min_sade
    >>> errors = torch.tensor([[0.0, 9.0], [5.0, 1.0]])  # [M, N]
    >>> states = torch.stack((errors, torch.zeros(2, 2)), -1)[None, :, :, None]  # [B, M, N, K, 2]
    >>> future, mask = torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1, dtype=torch.bool)
    >>> min_ade(states, future, mask)  # (0 + 1) / 2
    tensor([0.5000])
    >>> min_sade(states, future, mask)  # (5 + 1) / 2
    tensor([3.])
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

RADIUS = 0.25
"""Distance [m] within which a joint mode is near the future (:func:`missed`)."""


def min_ade(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Mean over agents of the average displacement of each agent's own best mode [m].

    Args:
        states: predictions, x and y [m] first; further entries of a state are not read.
        future: observed states, likewise.
        mask: True where an agent was observed.

    Raises:
        ValueError: shapes that do not agree.
    """
    return Errors.average(states, future, mask).marginal()


def min_fde(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Mean over agents of the displacement at step K of each agent's own best mode [m]; as :func:`min_ade`."""
    return Errors.final(states, future, mask).marginal()


def min_sade(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Average displacement of all agents in the best joint mode [m]; arguments as of :func:`min_ade`."""
    return Errors.average(states, future, mask).joint()


def min_sfde(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, " B"]:
    """Displacement at step K of all agents in the best joint mode [m]; arguments as of :func:`min_ade`."""
    return Errors.final(states, future, mask).joint()


def min_sade_of_likely(
    states: Float[Tensor, "B M N K X"],
    probabilities: Float[Tensor, "B M"],
    future: Float[Tensor, "B N K _"],
    mask: Bool[Tensor, "B N K"],
) -> Float[Tensor, "B M"]:
    """The minSADE among the k most likely joint modes, k = 1 .. M [m]; equally likely modes keep their order."""
    return Errors.average(states, future, mask).joint_of_likely(probabilities)


def closest_mode(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Int[Tensor, " B"]:
    """Index of the joint mode of the minSADE, the first one if several are equally close; 0 for a scene without a value."""
    return Errors.average(states, future, mask).closest()


def brier_min_sade(
    states: Float[Tensor, "B M N K X"],
    probabilities: Float[Tensor, "B M"],
    future: Float[Tensor, "B N K _"],
    mask: Bool[Tensor, "B N K"],
) -> Float[Tensor, " B"]:
    """minSADE + (1 - p)^2 with the probability p of the closest joint mode [m]; infinite if p is not a number."""
    return Errors.average(states, future, mask).brier(probabilities)


def missed(
    states: Float[Tensor, "B M N K X"],
    future: Float[Tensor, "B N K _"],
    mask: Bool[Tensor, "B N K"],
    radius: float = RADIUS,
) -> Float[Tensor, " B"]:
    """1 for scenes whose minSADE is above ``radius`` [m]: no joint mode is near the future; else 0.

    On data with known alternatives (RPI), its mean over the scenes of one alternative is the share in which that alternative
    is missing among the modes. NaN for a scene without a value.
    """
    return Errors.average(states, future, mask).missed(radius)


@dataclass(frozen=True)
class Errors:
    """Distances of all agents from their futures in every joint mode [m].

    They are averages over the steps, or those of step K. Several metrics of one forecast share them.

    Attributes:
        distance: of the agents, [B, M, N]; zero for agents that are not counted.
        counted: mask of the agents that were observed, [B, N].
    """

    distance: Float[Tensor, "B M N"]
    counted: Bool[Tensor, "B N"]

    @classmethod
    def average(
        cls, states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
    ) -> Errors:
        """Means over the observed steps; arguments as of :func:`min_ade`."""
        _check_shapes(states, future, mask)
        steps = mask.sum(-1)
        return cls(_distances(states, future, mask).sum(-1) / steps[:, None].clamp_min(1), steps > 0)

    @classmethod
    def final(
        cls, states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
    ) -> Errors:
        """Distances at step K; arguments as of :func:`min_ade`."""
        _check_shapes(states, future, mask)
        last = mask[..., -1:]
        return cls(_distances(states[..., -1:, :], future[..., -1:, :], last)[..., 0], last[..., 0])

    def marginal(self) -> Float[Tensor, " B"]:
        """mean_i min_m; 0 / 0 is the NaN of an empty scene."""
        return self.distance.amin(1).sum(-1) / self.counted.sum(-1)

    def joint(self) -> Float[Tensor, " B"]:
        """min_m mean_i."""
        return self._of_modes().amin(1)

    def joint_of_likely(self, probabilities: Float[Tensor, "B M"]) -> Float[Tensor, "B M"]:
        """min_m mean_i among the k most likely modes, k = 1 .. M; equally likely modes keep their order."""
        order = probabilities.argsort(dim=1, descending=True, stable=True)
        return self._of_modes().gather(1, order).cummin(1).values

    def closest(self) -> Int[Tensor, " B"]:
        """argmin_m mean_i, the first mode if several are equally close; 0 for a scene without a value."""
        return self.distance.sum(-1).argmin(1)

    def brier(self, probabilities: Float[Tensor, "B M"]) -> Float[Tensor, " B"]:
        """min_m mean_i plus (1 - p)^2, with the probability p of that mode; infinite if p is not a number."""
        wrong = (1.0 - probabilities.gather(1, self.closest()[:, None])[:, 0]).square()
        return self.joint() + wrong.nan_to_num(nan=torch.inf)

    def missed(self, radius: float = RADIUS) -> Float[Tensor, " B"]:
        """1 where min_m mean_i is above the radius [m], else 0; NaN for a scene without a value."""
        error = self.joint()
        return torch.where(error.isnan(), error, (error > radius).to(error.dtype))

    def _of_modes(self) -> Float[Tensor, "B M"]:
        """mean_i."""
        return self.distance.sum(-1) / self.counted.sum(-1, keepdim=True)


def _distances(
    states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
) -> Float[Tensor, "B M N K"]:
    """e[m,i,k], zero where nothing was observed, also if the value behind the mask is NaN."""
    offset = states[..., :2] - future[:, None, ..., :2]
    error = torch.linalg.vector_norm(offset, dim=-1)
    error = error.nan_to_num(nan=torch.inf, posinf=torch.inf)
    return torch.where(mask[:, None], error, 0.0)


def _check_shapes(states: Tensor, future: Tensor, mask: Tensor) -> None:
    """Refuse shapes that would be broadcast, such as a future of one step.

    Raises:
        ValueError: predictions, future and mask differ in the number of scenes, agents or steps.
    """
    if states.dim() != 5 or future.dim() != 4 or states.shape[:1] + states.shape[2:4] != future.shape[:3]:
        raise ValueError(
            f"predictions have shape {list(states.shape)} and the observed future {list(future.shape)}; they take "
            "[B, M, N, K, X] and [B, N, K, X] with the same numbers of scenes B, agents N and steps K"
        )
    if mask.shape != future.shape[:3]:
        raise ValueError(f"the mask has shape {list(mask.shape)}; this future takes {list(future.shape[:3])}")
