"""Definitions of the metrics: batched functions that return one value per scene."""

from epo_lightning.metrics.functional.displacement import (
    min_ade,
    min_fde,
    min_sade,
    min_sade_of_likely,
    min_sfde,
)
from epo_lightning.metrics.functional.marginal import marginal_to_joint
from epo_lightning.metrics.functional.overlap import overlap_rate, overlapping_pairs

__all__ = [
    "marginal_to_joint",
    "min_ade",
    "min_fde",
    "min_sade",
    "min_sade_of_likely",
    "min_sfde",
    "overlap_rate",
    "overlapping_pairs",
]
