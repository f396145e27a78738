"""The overlap rate that remembers."""

from __future__ import annotations

from typing import Any, get_args

from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.metrics.base import SceneMean
from epo_lightning.metrics.functional import overlap_rate
from epo_lightning.metrics.functional.overlap import Definition, Shape, check_choice


class OverlapRate(SceneMean):
    """Mean over scenes of :func:`~epo_lightning.metrics.functional.overlap_rate`.

    Args:
        definition: ``jfp`` or ``authors``.
        shape: ``disc`` or ``box``.
    """

    def __init__(self, definition: str = "jfp", shape: str = "disc", **options: Any) -> None:
        super().__init__(**options)
        check_choice("definition", definition, get_args(Definition))
        check_choice("shape", shape, get_args(Shape))
        self.definition, self.shape = definition, shape

    def update(
        self,
        states: Float[Tensor, "B M N K 4"],
        probabilities: Float[Tensor, "B M"],
        size: Float[Tensor, "B N 2"],
        agent_mask: Bool[Tensor, "B N"],
    ) -> None:
        """Count a batch of scenes."""
        self.add(overlap_rate(states, probabilities, size, agent_mask, self.definition, self.shape))
