"""VIBES: LSTM histories, attention to the map and then among agents."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from epo_lightning.backbones.base import PolylineBackbone
from epo_lightning.encoders.interaction import TwoStageAttention
from epo_lightning.registry import register
from epo_lightning.scene import Scene


@register("backbone", "vibes")
@dataclass(eq=False, repr=False)
class VIBES(PolylineBackbone):
    """Vectorized Interaction-based Scene Prediction: V-LSTM's encoders and two stages of attention (Appendix E.1)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.interaction = TwoStageAttention(self.width, self.map_input, self.dropout)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features z_i of all agents."""
        return self.interaction(self.agent_features(scene), scene.agent_mask, *self.lane_features(scene))
