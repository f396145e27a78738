"""V-LSTM: LSTM histories and a single attention over everything (Ettinger et al. 2021, as the paper uses it)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.backbones.base import Backbone
from epo_lightning.decoders.goals import given_goals
from epo_lightning.encoders.history import LSTMHistory
from epo_lightning.encoders.interaction import Attention
from epo_lightning.registry import register
from epo_lightning.scene import Scene


@register("backbone", "v_lstm")
class VLSTM(Backbone):
    """Vector-LSTM: each history through an LSTM, then one layer of attention (Appendix C.1, "Global Interaction").

    Args:
        history_width: size of the LSTM's hidden state.
        history_depth: number of stacked LSTM layers.
        width: size of the features z that leave the global interaction graph.
        goal_input: whether a given goal is also an input of the network (``goal=all``), not of the energy alone.
    """

    def __init__(
        self, history_width: int = 64, history_depth: int = 3, width: int = 128, goal_input: bool = False
    ) -> None:
        super().__init__()
        self.width = width
        self.history = LSTMHistory(history_width, history_depth)
        self.to_graph = nn.Linear(history_width, width)
        self.goal_to_graph = nn.Linear(2, width) if goal_input else None
        self.interaction = Attention(width)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features z_i of all agents."""
        features = self.to_graph(self.history(scene))
        if self.goal_to_graph is not None:
            features = features + self.goal_to_graph(given_goals(scene))
        return self.interaction(features, scene.agent_mask)
