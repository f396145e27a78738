"""Definitions of the metrics: batched functions that return one value per scene."""

from epo_lightning.metrics.functional.calibration import expected_calibration_error, reliability
from epo_lightning.metrics.functional.displacement import (
    brier_min_sade,
    closest_mode,
    min_ade,
    min_fde,
    min_sade,
    min_sade_of_likely,
    min_sfde,
    missed,
)
from epo_lightning.metrics.functional.interaction import interactive_scenes
from epo_lightning.metrics.functional.marginal import marginal_to_joint
from epo_lightning.metrics.functional.overlap import overlap_rate, overlapping_pairs

__all__ = [
    "brier_min_sade",
    "closest_mode",
    "expected_calibration_error",
    "interactive_scenes",
    "marginal_to_joint",
    "min_ade",
    "min_fde",
    "min_sade",
    "min_sade_of_likely",
    "min_sfde",
    "missed",
    "overlap_rate",
    "overlapping_pairs",
    "reliability",
]
