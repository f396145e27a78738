"""What all metric classes share: a sum over scenes and their number."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric


class SceneMean(Metric):
    """Mean over scenes of a metric with one value per scene; scenes whose value is NaN have none and are left out.

    The states are sums, so that batches and processes of any sizes add up to the same mean, and are kept in double
    precision: a float32 sum over the 60 000 scenes of a data set loses the digits that tables print. ``compute`` is NaN
    as long as there is no scene.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def add(self, values: Float[Tensor, " B"]) -> None:
        """Count the scenes that have a value."""
        self.total += values.double().nansum()
        self.count += (~values.isnan()).sum()

    def compute(self) -> Tensor:
        """The mean over all scenes so far."""
        return self.total / self.count
