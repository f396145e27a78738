"""Calibration of mode probabilities: whether modes with probability p are the closest ones in a share p of the scenes.

Every mode of every scene is one statement, "this mode is the closest to the future", which the forecast makes with
probability p and which is true or false. Statements are sorted into bins of equal width by p, and with the number n_b, the
mean probability p_b and the share of true statements t_b of bin b,

    ECE = sum_b n_b |p_b - t_b| / sum_b n_b

is the expected calibration error (Naeini et al., AAAI 2015; Guo et al., ICML 2017). The three sums of every bin add up over
scenes, batches and processes; :func:`expected_calibration_error` is computed from the totals.

Example: ten scenes with two modes of probabilities 0.8 and 0.2. The first mode is the closest in six of them:

    >>> import torch
    >>> from epo_lightning.metrics.functional import expected_calibration_error, reliability
    >>> probabilities = torch.tensor([[0.8, 0.2]]).repeat(10, 1)
    >>> closest = torch.tensor([0] * 6 + [1] * 4)
    >>> float(expected_calibration_error(reliability(probabilities, closest).sum(0)).round(decimals=3))
    0.2
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

BINS = 10
"""Number of bins of equal width."""


def reliability(probabilities: Float[Tensor, "B M"], closest: Int[Tensor, " B"]) -> Float[Tensor, "B bins 3"]:
    """Number of statements, sum of their probabilities and number of true ones, by scene and bin, in float64.

    Bin b holds the probabilities from b / BINS up to, but without, (b + 1) / BINS; the last bin also holds 1.

    Args:
        probabilities: probabilities of the joint modes.
        closest: index of the mode that is the closest to the future.
    """
    probabilities = probabilities.double()
    index = (probabilities * BINS).long().clamp(0, BINS - 1)
    true = torch.nn.functional.one_hot(closest, probabilities.shape[1]).double()
    values = torch.stack((torch.ones_like(probabilities), probabilities, true), -1)  # B M 3
    return torch.nn.functional.one_hot(index, BINS).double().mT @ values


def expected_calibration_error(totals: Float[Tensor, "*groups bins 3"]) -> Float[Tensor, "*groups"]:
    """ECE from the sums of every bin over all scenes (:func:`reliability`); NaN without any scene."""
    count, probability, true = totals.unbind(-1)
    return (probability - true).abs().sum(-1) / count.sum(-1)
