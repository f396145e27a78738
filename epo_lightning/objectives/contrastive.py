"""Contrastive learning: energy of the observed strategy minus that of a sample ("analysis" in EBIOC, arXiv 1904.05453).

The negative log-likelihood of p(u | o) = exp(-E(u; o)) / Z(o) has the gradient

    dE(u_obs) / dtheta - < dE(u_s) / dtheta >,   u_s ~ p(u | o),

which lowers the energy of observed strategies and raises that of strategies that the energy wrongly prefers. Samples are
constants: no gradient flows through their computation.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning import losses
from epo_lightning.forecast import JointForecast
from epo_lightning.game.energy import GRADIENT, Energy
from epo_lightning.game.selection import games
from epo_lightning.game.tracking import demonstrated, observed_controls
from epo_lightning.objectives.base import Objective, Terms, checked_weights
from epo_lightning.objectives.terms import goal_term
from epo_lightning.registry import register
from epo_lightning.scene import Scene, observed_future
from epo_lightning.schedules import Annealing, is_positive
from epo_lightning.solvers.base import PATH, SAMPLES, STATIONARY


@register("objective", "contrastive")
class Contrastive(Objective):
    """Energy of the demonstration minus that of the forecast, in the mode closest to the observed future.

    Every mode is a game of its own with one sample. Only the mode whose forecast (without noise) is closest to the observed
    future is trained; the others would only learn to avoid their own forecasts. The observed controls are found by tracking
    (:mod:`~epo_lightning.game.tracking`). The controls after an agent's last observed step are unknown; they are copied
    from the sample, so that both energies are defined. A scene without observations has no gradient.

    With annealing, every mode is trained with its share (:func:`~epo_lightning.losses.mode_shares`), until the temperature
    has fallen and the closest one is trained alone.

    Besides the weighted terms, ``tracking`` is logged: the distance [m] between observed positions and those reproduced by
    tracking.

    Args:
        weights: lambda of ``contrastive``; of ``magnitude``, the squares of both energies, which holds a common offset of
            both but lowers the precision that is learned (EBIOC has no such term, and 0 leaves the temperature to the data);
            of ``initial``, the distance between initial strategies and samples (cooperative
            training: the network learns to start the chains where they end); of ``goal`` (unused if no goal is decoded);
            and of ``probability``, the cross entropy of the closest mode.
        annealing, annealing_steps: temperature [m] and duration of an :class:`~epo_lightning.schedules.Annealing`.
    """

    term_names = ("contrastive", "magnitude", "initial", "goal", "probability")
    needs_from_solver = frozenset({SAMPLES, STATIONARY, PATH})
    needs_from_energy = frozenset({GRADIENT})

    def __init__(self, weights: Mapping[str, float], annealing: float = 0.0, annealing_steps: int = 2000) -> None:
        self.weights = checked_weights(weights, self.term_names)
        self.annealing = Annealing(annealing, annealing_steps)

    def __call__(self, scene: Scene, forecast: JointForecast, energy: Energy, step: int = 0) -> Terms:
        future, mask = observed_future(scene)
        parameters, solution, starts = forecast.parameters, forecast.solution, forecast.initial_states
        assert parameters is not None
        assert solution is not None
        assert starts is not None
        distance = losses.distances(forecast.states[..., :2].detach(), future, mask)
        _, mode = losses.scene_imitation(distance, mask)
        controls, missed = observed_controls(energy.dynamics, scene)
        temperature, drawn, game = self.annealing.at(step), solution.controls.detach(), parameters
        if is_positive(temperature):
            share = losses.mode_shares(distance, mask, temperature)
        else:
            index = torch.arange(len(mode), device=mode.device)
            game, drawn = games(parameters, index, mode), drawn[index, mode][:, None]
            share = torch.ones_like(distance[:, :1, 0])
        followed = mask.any(-1)
        taught = followed.any(-1)  # without an observation, both energies are those of the sample
        shown = torch.where(demonstrated(scene)[:, None, ..., None], controls[:, None], drawn)
        of_shown, of_drawn = energy(scene, game, shown), energy(scene, game, drawn)
        sizes = torch.where(taught, (share * (of_shown.square() + of_drawn.square())).sum(1), 0.0)
        values = {
            "contrastive": (share * (of_shown - of_drawn)).sum(1).mean(),
            "magnitude": sizes.mean(),
            "initial": proposal(starts, solution.states.detach(), scene.agent_mask & taught[:, None]),
            "probability": losses.scene_probability(forecast.log_probabilities, mode, mask),
        }
        return {
            **{name: (self.weights[name], value) for name, value in values.items()},
            **goal_term(scene, forecast, self.weights["goal"]),
            "tracking": (0.0, missed.sum() / followed.sum().clamp_min(1)),
        }


def proposal(
    starts: Float[Tensor, "B M N K 4"], ends: Float[Tensor, "B M N K 4"], present: Bool[Tensor, "B N"]
) -> Float[Tensor, ""]:
    """Mean distance [m] between the positions of initial strategies and those of the samples that chains end at."""
    between = torch.where(present[:, None, :, None, None], starts[..., :2] - ends[..., :2], 0.0)
    distance = torch.linalg.vector_norm(between, dim=-1).mean((1, 3))
    return (distance.sum(-1) / present.sum(-1).clamp_min(1)).mean()
