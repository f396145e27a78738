"""Loss terms that several objectives share."""

from __future__ import annotations

from collections.abc import Mapping

from epo_lightning import losses
from epo_lightning.decoders.goals import goal_candidates
from epo_lightning.forecast import JointForecast
from epo_lightning.objectives.base import Terms
from epo_lightning.scene import Scene, observed_future
from epo_lightning.schedules import Softness


def goal_term(scene: Scene, forecast: JointForecast, weight: float) -> Terms:
    """The term L_goal for forecasters that choose among goal candidates; no term for others."""
    if forecast.goal_log_probabilities is None:  # from the logits, as all log-probabilities of a forecast
        return {}
    future, mask = observed_future(scene)
    final, observed = future[:, :, -1, :2], mask[:, :, -1]
    return {"goal": (weight, losses.goal(forecast.goal_log_probabilities, *goal_candidates(scene), final, observed))}


def imitation_terms(
    scene: Scene,
    forecast: JointForecast,
    weights: Mapping[str, float],
    softness: Softness,
) -> Terms:
    """Distance of the closest joint future, and the cross entropy of its probability, which is always that of the closest.

    Args:
        scene: the scene with its future.
        forecast: the forecast.
        weights: lambda of ``imitation`` and ``probability``.
        softness: power of the distances, relaxation and temperature.
    """
    future, mask = observed_future(scene)
    distance = losses.distances(forecast.states[..., :2], future, mask, softness.power)
    imitation, mode = losses.scene_imitation(distance, mask, softness.relaxation, softness.temperature)
    probability = losses.scene_probability(forecast.log_probabilities, mode, mask)
    return {"imitation": (weights["imitation"], imitation), "probability": (weights["probability"], probability)}
