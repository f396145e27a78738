"""What a backbone is: a module from scenes to agent features; and what the paper's three have in common."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.decoders.goals import given_goals
from epo_lightning.encoders.history import LSTMHistory, TransformerHistory
from epo_lightning.encoders.polyline import LanePolylines
from epo_lightning.scene import Scene


class Backbone(nn.Module):
    """Observation encoder phi_glob: ``forward(scene)`` returns features z [B, N, width] of all agents (Section 4.1)."""

    width: int


class PolylineBackbone(Backbone):
    """Histories and lanes as polyline features of one width; how they interact is left to the subclass.

    Args:
        history: encoder of the agents' histories.
        lanes: encoder of the lanes; None where the data has no map.
        width: size of all features.
        goal_input: whether a given goal is also an input of the network (``goal=all``), not of the energy alone.
    """

    def __init__(
        self, history: LSTMHistory | TransformerHistory, lanes: LanePolylines | None, width: int, goal_input: bool
    ) -> None:
        super().__init__()
        if not history.scale > 0:
            raise ValueError(f"scale must be positive, not {history.scale}: the metres that an input of one stands for")
        self.width = width
        self.history = history
        self.to_graph = nn.Linear(history.width, width)
        self.goal_to_graph = nn.Linear(2, width) if goal_input else None
        self.lanes = lanes
        self.lane_to_graph = None if lanes is None else nn.Linear(lanes.width, width)

    def agent_features(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """What each agent did, and its goal where that is given to the network."""
        features = self.to_graph(self.history(scene))
        if self.goal_to_graph is not None:
            features = features + self.goal_to_graph(given_goals(scene) / self.history.scale)
        return features

    def lane_features(self, scene: Scene) -> tuple[Float[Tensor, "B L {self.width}"], Bool[Tensor, "B L"]]:
        """Every lane, and which of them exist; no lane at all where the data has no map.

        Raises:
            ValueError: the backbone was built for data with a map and the scene has none.
        """
        if self.lanes is None or self.lane_to_graph is None:
            none = scene.agent_mask[:, :0]
            return self.to_graph.weight.new_zeros(*none.shape, self.width), none
        if scene.lanes is None or scene.lane_mask is None:
            raise ValueError("this backbone reads a map, but scene.lanes [B, L, V, 4] is None")
        return self.lane_to_graph(self.lanes(scene.lanes, scene.lane_mask)), scene.lane_mask.any(-1)
