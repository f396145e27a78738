"""The energies of JFP (networks) and of EBIOC (networks and named features)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.checks import check_whole
from epo_lightning.forecast import GameParameters
from epo_lightning.game.dynamics import Dynamics
from epo_lightning.game.energy import GRADIENT
from epo_lightning.game.limits import Bound
from epo_lightning.game.network_energy import NetworkEnergy
from epo_lightning.game.networks import ENCOUNTER, MOTION, Layers, encounter, motion
from epo_lightning.game.pairs import pairs
from epo_lightning.registry import register
from epo_lightning.scene import Scene

_TABLE_ENTRIES = 50_000
"""Number of candidate pairs that are evaluated together, which bounds the memory where no gradient is recorded."""


@register("energy", "neural")
class NeuralEnergy(NetworkEnergy):
    """A network's cost of every agent's trajectory, and of the trajectories of every two agents (Table 1, "NN").

        e_i = layers([z_i, trajectory of i in its own frame]),    E_i = v . e_i,
        E_ij = (V(e_i, e_j, g_ij) + V(e_j, e_i, g_ji)) / 2,

    with the encounter g_ij of i with j (:func:`~epo_lightning.game.networks.encounter`). Averaging both orders makes pair
    terms symmetric, which a potential needs. The energy is invariant to the frame: it depends on positions relative to
    other agents and to the agent's own state at t0.

    Without named features this is JFP (Luo et al., CoRL 2022, Section 3.3) as far as published: JFP's own terms are the
    logits of the marginal decoder, here they are functions of the trajectory; the inputs of its pair network are not
    published. With named features it is EBIOC (Xu et al., 2019), "features augmented by a network". EBIOC predicts one agent
    and takes the trajectories of the others as given; here all agents move, so there is a term for pairs as well.

    Args:
        dynamics, width, horizon, scale, own, pair, bounds, pair_stride: see
            :class:`~epo_lightning.game.network_energy.NetworkEnergy`.
        hidden: size of the hidden features.

    Raises:
        ConfigError: no hidden feature.
    """

    offers = frozenset({GRADIENT})
    term, pair_term = "neural", "neural_pair"

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
        hidden: int = 64,
    ) -> None:
        super().__init__(dynamics, width, horizon, scale, own, pair, bounds, pair_stride)
        check_whole("energy.hidden", hidden)
        self.embedding = Layers((width, MOTION * horizon), hidden)
        self.own_value = nn.Linear(hidden, 1, bias=False)
        self.interaction = Layers((hidden, hidden, ENCOUNTER), hidden)
        self.pair_value = nn.Linear(hidden, 1, bias=False)

    def embed(self, context: Tensor, states: Tensor, initial: Tensor) -> Float[Tensor, "... hidden"]:
        """Embeddings e of agents with features [B, 1, A, D], states [B, C, A, K, 4] and x_0 [B, 1, A, 4]."""
        return self.embedding(context, motion(states, initial, self.scale).flatten(-2))

    def interact(
        self, ours: Tensor, theirs: Tensor, first: Float[Tensor, "*#batch K 4"], second: Float[Tensor, "*#batch K 4"]
    ) -> Float[Tensor, "*batch"]:
        """E_ij from embeddings and states of two agents, which broadcast."""
        one = self.interaction(ours, theirs, encounter(first, second, self.scale))
        other = self.interaction(theirs, ours, encounter(second, first, self.scale))
        return self.pair_value(0.5 * (one + other))[..., 0]

    def network_own(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> Float[Tensor, "B C N"]:
        features = self.embed(self.context(scene, parameters), states, self.current_states(scene))
        return self.own_value(features)[..., 0]

    def network_pair(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> Float[Tensor, "B C P"]:
        context, initial = self.context(scene, parameters), self.current_states(scene)
        ours, theirs = (
            self.embed(context[:, :, members], states, initial[:, :, members])
            for members, states in zip(pairs(context.shape[2], first.device), (first, second), strict=True)
        )
        return self.interact(ours, theirs, first, second)

    def network_tables(
        self, scene: Scene, parameters: GameParameters, states: Float[Tensor, "B C N K 4"]
    ) -> tuple[Float[Tensor, "B C N"], Float[Tensor, "B P C C"]]:
        """E_i and E_ij with every candidate embedded once; only encounters and the last layers are evaluated per pair."""
        features = self.embed(self.context(scene, parameters), states, self.current_states(scene))
        first, second = pairs(states.shape[2], states.device)
        ours, theirs, left, right = (
            values[:, :, members].transpose(1, 2) for values in (features, states) for members in (first, second)
        )  # [B, P, C, ..]
        rows = max(1, _TABLE_ENTRIES // max(1, theirs[..., 0].numel()))
        parts = [
            self.interact(some[:, :, :, None], theirs[:, :, None], states[:, :, :, None], right[:, :, None])
            for some, states in zip(ours.split(rows, 2), left.split(rows, 2), strict=True)
        ]
        return self.own_value(features)[..., 0], torch.cat(parts, 2)
