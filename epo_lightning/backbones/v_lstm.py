"""V-LSTM: LSTM histories and one attention over agents and lanes (Ettinger et al. 2021, as the paper uses it)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.backbones.base import PolylineBackbone
from epo_lightning.encoders.interaction import Attention
from epo_lightning.registry import register
from epo_lightning.scene import Scene


@register("backbone", "v_lstm")
@dataclass(eq=False, repr=False)
class VLSTM(PolylineBackbone):
    """Vector-LSTM: each history through an LSTM, then one layer of attention (Appendix E.1, "Global Interaction")."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.interaction = Attention(self.width, self.dropout)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features z_i of all agents."""
        agents = self.agent_features(scene)
        lanes, lane_exists = self.lane_features(scene)
        sources, exist = torch.cat((agents, lanes), 1), torch.cat((scene.agent_mask, lane_exists), 1)
        return self.interaction(agents, sources, exist)
