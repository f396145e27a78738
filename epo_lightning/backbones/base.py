"""The interface of backbones, which map scenes to agent features, and the common part of the paper's three."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.decoders.goals import given_goals
from epo_lightning.encoders.history import LSTMHistory, TransformerHistory
from epo_lightning.encoders.polyline import LanePolylines
from epo_lightning.registry import ConfigError, place
from epo_lightning.scene import Scene


class Backbone(nn.Module):
    """Observation encoder phi_glob: ``forward(scene)`` returns features z [B, N, width] of all agents (Section 4.1).

    Attributes:
        width: size of the features z; a subclass sets it.
    """

    width: int

    def __call__(self, scene: Scene) -> Float[Tensor, "B N D"]:
        """The features of a scene's agents.

        Raises:
            ConfigError: ``forward`` returns something else.
        """
        z = super().__call__(scene)
        expected = [*scene.agent_mask.shape, self.width]
        if not isinstance(z, Tensor) or list(z.shape) != expected:
            found = f"shape {list(z.shape)}" if isinstance(z, Tensor) else f"a {type(z).__name__}"
            raise ConfigError(
                f"the backbone {type(self).__name__} ({place(type(self))}) must return features z of shape [B, N, width] = "
                f"{expected}, but it returns {found}"
            )
        return z


@dataclass(eq=False, repr=False)
class PolylineBackbone(Backbone):
    """Backbone base that encodes histories and lanes as polyline features; subclasses define their interaction.

    The fields are the configuration of the paper's backbones; a subclass may add its own.

    Attributes:
        history_width: size of the history encoder's features.
        history_depth: number of layers of the history encoder.
        width: size of the features z, the backbone's output.
        lane_width, lane_depth: size and number of the lane encoder's layers.
        dropout: dropout rate, in training, of the history features and of the attention's output.
        scale: unit [m] of positions at the network's inputs.
        goal_input: whether a given goal is also an input of the network (``goal=all``), and not only of the energy.
        map_input: whether the data has a map.
    """

    history_width: int = 64
    history_depth: int = 3
    width: int = 128
    lane_width: int = 64
    lane_depth: int = 3
    dropout: float = 0.0
    scale: float = 1.0
    goal_input: bool = False
    map_input: bool = False

    def __post_init__(self) -> None:
        super().__init__()
        if not self.scale > 0:
            raise ValueError(
                f"scale, the unit [m] of positions at the network's inputs, must be positive, not {self.scale}"
            )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout, the share of features that is left out, must be in [0, 1), not {self.dropout}")
        # Initial weights are drawn in the order of construction, and checkpoints have modules in that of assignment.
        history = self.history_encoder()
        lanes = LanePolylines(self.lane_width, self.lane_depth, self.scale) if self.map_input else None
        self.history = history
        self.to_graph = nn.Linear(history.width, self.width)
        self.goal_to_graph = nn.Linear(2, self.width) if self.goal_input else None
        self.lanes = lanes
        self.lane_to_graph = None if lanes is None else nn.Linear(lanes.width, self.width)
        self.drop = nn.Dropout(self.dropout)

    def history_encoder(self) -> LSTMHistory | TransformerHistory:
        """The encoder of the agents' histories: an LSTM, unless a subclass overrides it."""
        return LSTMHistory(self.history_width, self.history_depth, self.scale)

    def agent_features(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """Features of each agent's history, and of its goal where that is an input of the network."""
        features = self.to_graph(self.drop(self.history(scene)))
        if self.goal_to_graph is not None:
            features = features + self.goal_to_graph(given_goals(scene) / self.scale)
        return features

    def lane_features(self, scene: Scene) -> tuple[Float[Tensor, "B L {self.width}"], Bool[Tensor, "B L"]]:
        """Features of every lane and the mask of existing lanes; empty where the data has no map.

        Raises:
            ValueError: the backbone was built for data with a map and the scene has none.
        """
        if self.lanes is None or self.lane_to_graph is None:
            none = scene.agent_mask[:, :0]
            return self.to_graph.weight.new_zeros(*none.shape, self.width), none
        if scene.lanes is None or scene.lane_mask is None:
            raise ValueError("this backbone reads a map, but scene.lanes [B, L, V, 4] is None")
        return self.lane_to_graph(self.lanes(scene.lanes, scene.lane_mask)), scene.lane_mask.any(-1)
