"""Imitation through the solution: the joint future closest to the observed one is drawn towards it (Section 4.5, Eq. 12)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from epo_lightning.decoders.orders import order_loss
from epo_lightning.forecast import JointForecast
from epo_lightning.game.energy import Energy
from epo_lightning.objectives.base import Objective, Terms, checked_weights
from epo_lightning.objectives.terms import goal_term, imitation_terms
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.schedules import Annealing, ImitationSchedule, Relaxation


@register("objective", "imitation")
class Imitation(Objective):
    """The paper's loss, lambda_1 L_imit + lambda_2 L_goal + lambda_3 L_prob, through the derivative of the solution.

    Args:
        weights: lambda of ``imitation``, ``goal`` (unused if no goal is decoded), ``probability`` and ``initial``.
            ``initial`` is the imitation loss of the initial strategies; it is used if no gradient reaches them through the
            solution (``truncated``, ``implicit``). If games go on after the forecast, it also compares the initial controls
            after the forecast with those of the solution, because there are no data for them. If orders of agents are
            decoded, ``probability`` is their cross entropy.
        relaxation, relaxation_steps: see :class:`~epo_lightning.schedules.Relaxation`.
        annealing, annealing_steps: temperature [m] and duration of an :class:`~epo_lightning.schedules.Annealing`.
        power: 1 for Euclidean distances; above, exponent of each coordinate's error; see
            :func:`~epo_lightning.losses.distances`.
    """

    term_names: ClassVar[tuple[str, ...]] = ("imitation", "goal", "probability", "initial")
    through_solution = True
    observed_orders = True

    def __init__(
        self,
        weights: Mapping[str, float],
        power: float = 1.0,
        relaxation: float = 0.0,
        relaxation_steps: int = 1000,
        annealing: float = 0.0,
        annealing_steps: int = 2000,
    ) -> None:
        self.weights = checked_weights(weights, self.term_names)
        self.schedule = ImitationSchedule(
            power, Relaxation(relaxation, relaxation_steps), Annealing(annealing, annealing_steps)
        )

    def __call__(self, scene: Scene, forecast: JointForecast, energy: Energy, step: int = 0) -> Terms:
        softness = self.schedule.at(step)
        terms = imitation_terms(scene, forecast, self.weights, softness)
        if forecast.order_logits is not None and energy.pair_order is not None:
            entropy = order_loss(forecast.order_logits, *energy.pair_order.observed(scene))
            terms["probability"] = (self.weights["probability"], entropy)
        starts = forecast.initial_states
        # EPO leaves them out, or detaches them, if the solution already teaches the strategies.
        if starts is not None and starts.requires_grad:
            initial = dataclasses.replace(forecast, states=starts)
            closest = imitation_terms(scene, initial, self.weights, softness)["imitation"][1]
            terms["initial"] = (self.weights["initial"], closest + _difference_ahead(scene, forecast))
        return terms | goal_term(scene, forecast, self.weights["goal"])


def _difference_ahead(scene: Scene, forecast: JointForecast) -> Tensor | float:
    """Mean difference of initial controls from those of the solution after the forecast; 0 if the game ends with it."""
    assert forecast.parameters is not None
    assert forecast.solution is not None
    first = forecast.states.shape[3]
    initial = forecast.parameters.initial_controls[..., first:, :]
    if initial.shape[3] == 0:
        return 0.0
    difference = (initial - forecast.solution.controls[..., first:, :].detach()).abs().mean((1, 3, 4))
    of_scenes = torch.where(scene.agent_mask, difference, 0.0).sum(-1) / scene.agent_mask.sum(-1).clamp_min(1)
    return of_scenes.mean()
