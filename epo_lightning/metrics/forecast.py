"""All metrics of a forecast at once, on all scenes and on named subsets of the data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric

from epo_lightning.metrics.functional import min_ade, min_fde, min_sade, min_sfde
from epo_lightning.metrics.functional.overlap import Shape, check_choice, overlap_rates
from epo_lightning.scene import JointForecast, Scene

METRICS = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp", "overlap_authors")
"""What every forecaster is scored by; displacements in m, overlaps as rates."""
INITIAL_METRICS = ("initial/minSADE", "initial/minSFDE")
"""Scores of the strategies from which the solver started (the paper's figure over the number of steps S)."""


class ForecastMetrics(Metric):
    """Means over scenes of all metrics of the tables in Section 5, computed once per batch.

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
        zeros = torch.zeros(1 + len(self.subsets), len(METRICS + INITIAL_METRICS), dtype=torch.float64)
        self.add_state("total", zeros, dist_reduce_fx="sum")
        self.add_state("count", zeros.clone(), dist_reduce_fx="sum")

    def update(self, forecast: JointForecast, scene: Scene) -> None:
        """Count a batch of scenes.

        Raises:
            ValueError: the scene holds no future to compare with, or no sizes.
        """
        values = forecast_values(forecast, scene, self.shape).double()
        groups = torch.ones(len(values), 1, dtype=torch.bool, device=values.device)
        if self.subsets:
            numbers = torch.arange(len(self.subsets), device=values.device)
            subset = torch.full_like(numbers[:1], -1).expand(len(values)) if scene.subset is None else scene.subset
            groups = torch.cat([groups, subset[:, None] == numbers], dim=1)
        counted = groups[:, :, None] & ~values.isnan()[:, None]  # scene, group, metric
        self.total += torch.where(counted, values[:, None], 0.0).sum(0)
        self.count += counted.sum(0)

    def compute(self) -> dict[str, Tensor]:
        """Scores by name.

        The six metrics over all scenes are always there, NaN before the first scene; those of a subset and of initial
        strategies only where there was one.
        """
        mean = self.total / self.count
        scores = dict(zip(METRICS, mean[0], strict=False))
        for row, prefix in enumerate(("", *(f"{name}/" for name in self.subsets))):
            for column, metric in enumerate(METRICS + INITIAL_METRICS):
                if self.count[row, column] > 0:
                    scores[prefix + metric] = mean[row, column]
        return scores


def forecast_values(forecast: JointForecast, scene: Scene, shape: str) -> Float[Tensor, "B metrics"]:
    """Every metric of every scene, in the order of ``METRICS + INITIAL_METRICS``; NaN where there is none.

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
    return torch.stack(columns, dim=1)
