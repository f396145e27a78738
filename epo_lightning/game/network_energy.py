"""What energies that are networks have in common: the agents' features as inputs, and named features beside them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.game.dynamics import Dynamics
from epo_lightning.game.energy import Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pair_mask
from epo_lightning.registry import ConfigError
from epo_lightning.scene import GameParameters, Scene


class NetworkEnergy(nn.Module, Energy):
    """One term of agents and one of pairs that networks make of ``parameters.context``, and any features besides.

    The features are those of :class:`~epo_lightning.game.feature_energy.FeatureEnergy`, with decoded weights: an energy
    term that works there works here.

    Args:
        dynamics: what turns controls into states.
        width: size D of the agents' features ``context [B, N, D]``.
        horizon: number K of future steps.
        scale: metres that an input of one stands for.
        own, pair, bounds, pair_stride: of the features, see :class:`~epo_lightning.game.feature_energy.FeatureEnergy`.

    Attributes:
        term, pair_term: names of the terms that are its own.
        features: the energy of the named features; None without any.

    Raises:
        ConfigError: features that do not exist, or one whose name is that of a term.
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
        bounds: Mapping[str, Sequence[float]] | None = None,
        pair_stride: int = 1,
    ) -> None:
        super().__init__()
        self.dynamics, self.width, self.horizon, self.scale = dynamics, width, horizon, scale
        self.features: FeatureEnergy | None = None
        if own or pair or bounds:
            self.features = FeatureEnergy(own, pair, bounds or {}, dynamics, pair_stride)
        for name in (*own, *pair):
            if name in (self.term, self.pair_term):
                raise ConfigError(f"a feature is called {name!r}, like a term of this energy: give it another name")
        self.own, self.pair = (*own, self.term), (*pair, self.pair_term)

    @property
    def weighted(self) -> tuple[Sequence[str], Sequence[str]]:
        """The named features; networks weigh themselves."""
        return self.own[:-1], self.pair[:-1]

    @property
    def needs(self) -> set[str]:
        """The agents' features, and what the named features refer to."""
        return {"context"} | (self.features.needs if self.features else set())

    @property
    def heading(self) -> set[str]:
        """Those of the named features."""
        return self.features.heading if self.features else set()

    @abstractmethod
    def network_own(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> Float[Tensor, "B C N"]:
        """E_i of the network; what it is for absent agents does not matter."""

    @abstractmethod
    def network_pair(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> Float[Tensor, "B C P"]:
        """E_ij of the network; what it is for pairs with an absent agent does not matter. Symmetric."""

    @abstractmethod
    def network_tables(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> tuple[Float[Tensor, "B C N"], Float[Tensor, "B P C C"]]:
        """Both for C candidates of every agent and all pairs of them, at a lower price than pair by pair."""

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
        """See :meth:`~epo_lightning.game.energy.Energy.tables`."""
        self.validate(scene, parameters, candidates)
        controls = torch.where(scene.agent_mask[:, None, :, None, None], candidates, 0.0)
        states = self.dynamics.rollout(self.initial(scene), controls, scene.dt)
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
        """Refuse tensors that do not fit together, naming the one that does not and the shape it should have.

        Raises:
            ValueError: a wrong shape, missing features of the agents, or what the named features lack.
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


def check_hidden(hidden: int) -> None:
    """Refuse networks without hidden features.

    Raises:
        ConfigError: as said.
    """
    if hidden < 1:
        raise ConfigError(f"energy.hidden must be 1 or more, not {hidden}")
