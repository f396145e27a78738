"""VIBES: LSTM histories; agents look at the map first and then at each other."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from epo_lightning.backbones.base import PolylineBackbone
from epo_lightning.encoders.history import LSTMHistory
from epo_lightning.encoders.interaction import TwoStageAttention
from epo_lightning.encoders.polyline import LanePolylines
from epo_lightning.registry import register
from epo_lightning.scene import Scene


@register("backbone", "vibes")
class VIBES(PolylineBackbone):
    """Vectorized Interaction-based Scene Prediction: V-LSTM's encoders and two stages of attention (Appendix C.1).

    Args:
        history_width: size of the LSTM's hidden state.
        history_depth: number of stacked LSTM layers.
        width: size of the features z that leave the global interaction graph.
        lane_width, lane_depth: size and number of the lane encoder's layers.
        scale: metres that an input of one stands for.
        goal_input: whether a given goal is also an input of the network (``goal=all``), not of the energy alone.
        map_input: whether the data has a map.
    """

    def __init__(
        self,
        history_width: int = 64,
        history_depth: int = 3,
        width: int = 128,
        lane_width: int = 64,
        lane_depth: int = 3,
        scale: float = 1.0,
        goal_input: bool = False,
        map_input: bool = False,
    ) -> None:
        history = LSTMHistory(history_width, history_depth, scale)
        lanes = LanePolylines(lane_width, lane_depth, scale) if map_input else None
        super().__init__(history, lanes, width, goal_input)
        self.interaction = TwoStageAttention(width, map_input)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features z_i of all agents."""
        return self.interaction(self.agent_features(scene), scene.agent_mask, *self.lane_features(scene))
