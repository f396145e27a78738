"""The base of energies that are networks: the agents' features as inputs, and named features as further terms."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Dynamics
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.limits import Bound
from epo_lightning.game.pairs import pair_mask
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene


class NetworkEnergy(nn.Module, Energy):
    """Network terms of agents and of pairs, computed from ``parameters.context``, and any named features.

    The named features are those of :class:`~epo_lightning.game.feature_energy.FeatureEnergy`, including custom ones, with
    decoded weights.

    Args:
        dynamics: the map from controls to states.
        width: size D of the agents' features ``context [B, N, D]``.
        horizon: number K of future steps.
        scale: metres per unit of the network's inputs.
        own, pair, bounds, pair_stride: the named features, see :class:`~epo_lightning.game.feature_energy.FeatureEnergy`.

    Attributes:
        term, pair_term: names of the network's terms.
        features: the energy of the named features; None without any.

    Raises:
        ConfigError: an unknown feature, or one with the name of a network term.
    """

    term: ClassVar[str]
    pair_term: ClassVar[str]

    def __init__(
        self,
        dynamics: Dynamics,
        width: int,
        horizon: int,
        scale: float,
        own: Sequence[str] = (),
        pair: Sequence[str] = (),
        bounds: Mapping[str, Bound] | None = None,
        pair_stride: int = 1,
    ) -> None:
        super().__init__()
        self.dynamics, self.width, self.horizon, self.scale = dynamics, width, horizon, scale
        self.features: FeatureEnergy | None = None
        if own or pair or bounds:
            self.features = FeatureEnergy(own, pair, bounds or {}, dynamics, pair_stride)
            self.features.check_horizon(horizon)
        for name in (*own, *pair):
            if name in (self.term, self.pair_term):
                raise ConfigError(
                    f"the feature {name!r} has the name of this energy's network term: rename the feature"
                )
        self.own, self.pair = (*own, self.term), (*pair, self.pair_term)

    @property
    def weighted(self) -> tuple[Sequence[str], Sequence[str]]:
        """The named features; network terms have no decoded weight."""
        return self.own[:-1], self.pair[:-1]

    @property
    def needs(self) -> set[str]:
        """The agents' features, and the inputs of the named features."""
        return {"context"} | (self.features.needs if self.features else set())

    @property
    def goal_terms(self) -> set[str]:
        """Names of the named features of goals and lines."""
        return self.features.goal_terms if self.features else set()

    @property
    def decoded_margins(self) -> Sequence[str]:
        """Names of the named pair features with a margin."""
        return self.features.decoded_margins if self.features else ()

    @abstractmethod
    def network_own(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> Float[Tensor, "B C N"]:
        """E_i of the network; values for absent agents are ignored."""

    @abstractmethod
    def network_pair(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> Float[Tensor, "B C P"]:
        """E_ij of the network, symmetric; values for pairs with an absent agent are ignored."""

    @abstractmethod
    def network_tables(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> tuple[Float[Tensor, "B C N"], Float[Tensor, "B P C C"]]:
        """E_i and E_ij for C candidates of every agent and all pairs of them, faster than pair by pair."""

    def forward(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> Float[Tensor, "B M"]:
        """The energy of every joint strategy."""
        return Energy.__call__(self, scene, parameters, controls)

    def own_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        states: Float[Tensor, "B C N K 4"],
        controls: Float[Tensor, "B C N K 2"],
    ) -> dict[str, Float[Tensor, "B C N"]]:
        terms = self.features.own_terms(scene, parameters, states, controls) if self.features else {}
        value = self.network_own(scene, parameters, states)
        return {**terms, self.term: torch.where(scene.agent_mask[:, None], value, 0.0)}

    def pair_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> dict[str, Float[Tensor, "B C P"]]:
        terms = self.features.pair_terms(scene, parameters, first, second) if self.features else {}
        value = self.network_pair(scene, parameters, first, second)
        return {**terms, self.pair_term: torch.where(pair_mask(scene)[:, None], value, 0.0)}

    def tables(
        self, scene: Scene, parameters: GameParameters, candidates: Float[Tensor, "B C N K 2"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, "B P C C"]]:
        """Tables of E_i and E_ij, see :meth:`~epo_lightning.game.energy.Energy.tables`."""
        self.validate(scene, parameters, candidates)
        controls = torch.where(scene.agent_mask[:, None, :, None, None], candidates, 0.0)
        states = self.dynamics.rollout(self.current_states(scene), controls, scene.dt)
        unary, pair = self.network_tables(scene, parameters, states)
        unary = torch.where(scene.agent_mask[..., None], unary.transpose(1, 2), 0.0)
        pair = torch.where(pair_mask(scene)[..., None, None], pair, 0.0)
        if self.features is None:
            return unary, pair
        more, more_pair = self.features.tables(scene, parameters, candidates)
        return unary + more, pair + more_pair

    def context(self, scene: Scene, parameters: GameParameters) -> Float[Tensor, "B 1 N D"]:
        """The agents' features, zero for absent agents."""
        assert parameters.context is not None
        return torch.where(scene.agent_mask[..., None], parameters.context, 0.0)[:, None]

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Check that scene, parameters and controls fit together.

        Raises:
            ValueError: a wrong shape, missing features of the agents, or missing inputs of the named features.
        """
        super().validate(scene, parameters, controls)
        if controls.shape[3] != self.horizon:
            raise ValueError(f"controls span K = {controls.shape[3]} steps; this energy's networks take {self.horizon}")
        expected = [*scene.agent_mask.shape, self.width]
        if parameters.context is None:
            raise ValueError(f"networks take the agents' features from parameters.context {expected}, which is None")
        if list(parameters.context.shape) != expected:
            shape = list(parameters.context.shape)
            raise ValueError(f"parameters.context has shape {shape}; this scene and energy take {expected}")
        if self.features is not None:
            self.features.validate(scene, parameters, controls)
