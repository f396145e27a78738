"""HiVT-M: transformer histories, attention to the map and then among agents (after Zhou et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from epo_lightning.backbones.base import PolylineBackbone
from epo_lightning.encoders.history import TransformerHistory
from epo_lightning.encoders.interaction import TwoStageAttention
from epo_lightning.registry import register
from epo_lightning.scene import Scene


@register("backbone", "hivt_m")
@dataclass(eq=False, repr=False)
class HiVTM(PolylineBackbone):
    """Hierarchical Vector Transformer, modified: a transformer per agent, then VIBES's two stages of attention.

    In HiVT itself the transformer already sees lanes and other agents; the paper moves both to the global graph (Appendix
    E.1, "Agent History Encoder").

    Attributes:
        history_heads: heads of the transformer's attention.
    """

    history_heads: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        self.interaction = TwoStageAttention(self.width, self.map_input, self.dropout)

    def history_encoder(self) -> TransformerHistory:
        return TransformerHistory(self.history_width, self.history_depth, self.history_heads, self.scale)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features z_i of all agents."""
        return self.interaction(self.agent_features(scene), scene.agent_mask, *self.lane_features(scene))
