"""All metrics of a forecast at once, on all scenes and on named subsets of the data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric

from epo_lightning.metrics.functional import min_ade, min_fde, min_sade, min_sade_of_likely, min_sfde
from epo_lightning.metrics.functional.overlap import Shape, check_choice, overlap_rates
from epo_lightning.scene import JointForecast, Scene

METRICS = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp", "overlap_authors")
"""What every forecaster is scored by; displacements in m, overlaps as rates."""
INITIAL_METRICS = ("initial/minSADE", "initial/minSFDE")
"""Scores of the strategies from which the solver started (the paper's figure over the number of steps S)."""
EQUILIBRIUM_METRICS = (
    "energy_initial",
    "energy_solved",
    "energy_optimum",
    "gradient_norm",
    "nash_gap",
    "nash_gap_relative",
)
"""How close the most likely joint mode is to an equilibrium of its game (:class:`~epo_lightning.scene.Equilibrium`): of the
agents of a scene, the largest gap, and the largest share of its objective J_i that an agent could save."""
MODE_METRICS = tuple(f"minSADE_{k}" for k in range(1, 17))
"""The minSADE among the k most likely joint modes, for forecasts of several; more than sixteen are not told apart."""
COLUMNS = METRICS + INITIAL_METRICS + EQUILIBRIUM_METRICS + MODE_METRICS
_OF_SUBSETS = len(METRICS + INITIAL_METRICS)


class ForecastMetrics(Metric):
    """Means over scenes of all metrics of the tables in Section 5, computed once per batch.

    Forecasts that carry a report on their equilibrium are scored by it as well, over all scenes alone. A scene whose report
    holds no finite number (a game that overflows) is not counted there: it would hide what is known of all the others, and a
    forecast that is broken shows in the displacements, which are infinite then.

    Args:
        subsets: names of the subsets that ``Scene.subset`` numbers, e.g. ``("executed", "alternative")`` for RPI. Each
            gets its own scores, ``"executed/minADE"``; a scene with a number beyond the names belongs to none of them.
        shape: of the agents when they overlap, ``disc`` or ``box``.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self, subsets: Sequence[str] = (), shape: str = "disc", **options: Any) -> None:
        super().__init__(**options)
        check_choice("shape", shape, get_args(Shape))
        self.subsets, self.shape = tuple(subsets), shape
        # First row: all scenes; then one for each subset. Sums in double precision, see SceneMean.
        zeros = torch.zeros(1 + len(self.subsets), len(COLUMNS), dtype=torch.float64)
        self.add_state("total", zeros, dist_reduce_fx="sum")
        self.add_state("count", zeros.clone(), dist_reduce_fx="sum")

    def update(self, forecast: JointForecast, scene: Scene) -> None:
        """Count a batch of scenes.

        Raises:
            ValueError: the scene holds no future to compare with, or no sizes.
        """
        values = forecast_values(forecast, scene, self.shape)
        groups = torch.ones(len(values), 1, dtype=torch.bool, device=values.device)
        if self.subsets:
            numbers = torch.arange(len(self.subsets), device=values.device)
            subset = torch.full_like(numbers[:1], -1).expand(len(values)) if scene.subset is None else scene.subset
            groups = torch.cat([groups, subset[:, None] == numbers], dim=1)
        counted = groups[:, :, None] & ~values.isnan()[:, None]  # scene, group, metric
        counted[:, 1:, _OF_SUBSETS:] = False
        self.total += torch.where(counted, values[:, None], 0.0).sum(0)
        self.count += counted.sum(0)

    def compute(self) -> dict[str, Tensor]:
        """Scores by name.

        The six metrics over all scenes are always there, NaN before the first scene; those of a subset, of initial
        strategies, of equilibria and of some modes only where there was one.
        """
        mean = self.total / self.count
        scores = dict(zip(METRICS, mean[0], strict=False))
        for row, prefix in enumerate(("", *(f"{name}/" for name in self.subsets))):
            for column, metric in enumerate(COLUMNS):
                if self.count[row, column] > 0:
                    scores[prefix + metric] = mean[row, column]
        return scores


def forecast_values(forecast: JointForecast, scene: Scene, shape: str) -> Float[Tensor, "B metrics"]:
    """Every metric of every scene, in the order in which they are named above, in float64; NaN where there is none.

    Raises:
        ValueError: the scene holds no future to compare with, or no sizes.
    """
    if scene.future is None or scene.future_mask is None:
        raise ValueError("metrics compare with what happened: Scene.future is missing")
    if scene.size is None:
        raise ValueError("overlap rates need the sizes of agents: Scene.size is missing")
    assert scene.agent_mask is not None
    mask = scene.future_mask & scene.agent_mask[..., None]
    states, future = forecast.states, scene.future
    columns = [distance(states, future, mask) for distance in (min_ade, min_fde, min_sade, min_sfde)]
    columns += overlap_rates(states, forecast.probabilities, scene.size, scene.agent_mask, shape)
    for distance in (min_sade, min_sfde):
        initial = forecast.initial_states
        columns.append(torch.full_like(columns[0], torch.nan) if initial is None else distance(initial, future, mask))
    columns += equilibrium_values(forecast)
    none = torch.full_like(columns[0], torch.nan)
    modes = min(states.shape[1], len(MODE_METRICS)) if states.shape[1] > 1 else 0
    columns += min_sade_of_likely(states, forecast.probabilities, future, mask)[:, :modes].unbind(1)
    columns += [none] * (len(MODE_METRICS) - modes)
    return torch.stack([column.double() for column in columns], dim=1)


def equilibrium_values(forecast: JointForecast) -> list[Float[Tensor, " B"]]:
    """``EQUILIBRIUM_METRICS`` of every scene; NaN where there is no finite value.

    Agents whose objective is not positive have no relative gap: nothing says what to compare with.
    """
    found = forecast.equilibrium
    if found is None:
        return [forecast.probabilities.new_full((len(forecast.probabilities),), torch.nan)] * len(EQUILIBRIUM_METRICS)
    values = [found.initial, found.energy, found.optimum, found.gradient_norm]
    if found.nash_gap.shape[1]:
        positive = found.objective > 0
        relative = torch.where(positive, found.nash_gap / torch.where(positive, found.objective, 1.0), -torch.inf)
        values += [found.nash_gap.amax(1), relative.amax(1)]
    else:
        values += [torch.full_like(found.energy, torch.nan)] * 2
    return [torch.where(value.isfinite(), value, torch.nan) for value in values]
