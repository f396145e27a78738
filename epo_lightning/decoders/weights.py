"""Weight decoding: weights of the energy's named features for every agent and every pair of agents, and pairs' margins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP
from epo_lightning.game.pairs import of_pairs, pairs


def _by_name(weights: Float[Tensor, "B R out"], names: Sequence[str], games: int) -> dict[str, Float[Tensor, "B M R"]]:
    per_mode = weights.unflatten(-1, (games, len(names))).transpose(1, 2)
    return dict(zip(names, per_mode.unbind(-1), strict=True))


def _starts(features: Sequence[str], start: float | Mapping[str, float]) -> list[float]:
    return [float(start.get(name, 1.0) if isinstance(start, Mapping) else start) for name in features]


class OwnWeights(nn.Module):
    """phi_own: weights W_i of the energy's own features, decoded from z_i alone, by one network for all agents.

    Args:
        width: size of the agent features.
        games: number of games: the number M of joint modes, or 1 if all modes are of one game (then M is 1 in the
            shapes below).
        features: names of the own features; without any there is no network.
        start: weights at a network output of zero: one number for all features, or numbers by name (1 for names that are
            missing). The weight is start * (1 + output): features differ in unit and magnitude, and so do their weights.
    """

    start: Tensor

    def __init__(
        self, width: int, games: int, features: Sequence[str], start: float | Mapping[str, float] = 1.0
    ) -> None:
        super().__init__()
        self.games, self.features = games, tuple(features)
        self.register_buffer("start", torch.tensor(_starts(features, start) * games), persistent=False)
        self.mlp = MLP(width, 64, games * len(self.features), norm="batch") if self.features else None

    def forward(self, z: Float[Tensor, "B N D"], mask: Bool[Tensor, "B N"]) -> dict[str, Float[Tensor, "B M N"]]:
        """Weights by feature name; ``mask`` marks the agents that exist."""
        if self.mlp is None:
            return {}
        return _by_name(self.start * (1.0 + self.mlp(z, mask)), self.features, self.games)


class SharedWeights(nn.Module):
    """Weights of features that all agents or pairs, modes and scenes share: one learned number for each feature.

    For populations whose agents differ only in how they weigh each other, as in RPI: a single history
    does not determine the shared weights, but all scenes together do. EBIOC shares the weights of pairs as well.

    Args:
        games: number M of games: one per joint mode, or a single one.
        features: names of the features.
        start: weights before training, as for :class:`OwnWeights`. The weight is start * exp(learned number).
    """

    start: Tensor

    def __init__(self, games: int, features: Sequence[str], start: float | Mapping[str, float] = 1.0) -> None:
        super().__init__()
        self.games, self.features = games, tuple(features)
        self.register_buffer("start", torch.tensor(_starts(features, start)), persistent=False)
        self.logarithms = nn.Parameter(torch.zeros(len(self.features)))

    def of_rows(self, batch: int, rows: int) -> dict[str, Float[Tensor, "B M R"]]:
        """Weights by feature name, for R agents or pairs in each of B scenes."""
        weights = (self.start * self.logarithms.exp()).unbind()
        shape = batch, self.games, rows
        return {name: weight.expand(shape) for name, weight in zip(self.features, weights, strict=True)}


class SharedOwnWeights(SharedWeights):
    """Shared weights in the place of :class:`OwnWeights`."""

    def forward(self, z: Float[Tensor, "B N D"], mask: Bool[Tensor, "B N"]) -> dict[str, Float[Tensor, "B M N"]]:
        """Weights by feature name; only the sizes of ``mask`` are read."""
        return self.of_rows(*mask.shape)


class SharedPairWeights(SharedWeights):
    """Shared weights in the place of :class:`PairWeights`."""

    def forward(
        self, z: Float[Tensor, "B N D"], chosen: Bool[Tensor, "B P"] | None = None
    ) -> dict[str, Float[Tensor, "B M P"]]:
        """Weights by feature name; zero for pairs that are not ``chosen``. Only the sizes of ``z`` are read."""
        agents = z.shape[1]
        weights = self.of_rows(len(z), agents * (agents - 1) // 2)
        if chosen is None:
            return weights
        return {name: torch.where(chosen[:, None], weight, 0.0) for name, weight in weights.items()}


class PairWeights(nn.Module):
    """phi_pair: interaction weights of a pair from the features of both agents, one network for all pairs.

    For two agents this is the paper's decoder on the concatenation of all agent features. For more agents the paper
    concatenates all N features, so that a model works for one N only; a decoder per pair works for any N. The first agent of
    a pair may have a special role (the robot of RPI); where agents are exchangeable, ``symmetric`` averages both orders.

    Args:
        width: size of the agent features.
        games: number M of games: one per joint mode, or a single one.
        features: names of the pair features; without any there is no network.
        start: weight at a network output of zero.
        symmetric: whether weights are the same in both orders of the two agents.
        positive: whether the weight is start * exp(output) rather than start + output. A weight enters the energy squared,
            so that one that has reached zero has no gradient and stays there.
    """

    def __init__(
        self,
        width: int,
        games: int,
        features: Sequence[str],
        start: float = 3.0,
        symmetric: bool = False,
        positive: bool = False,
    ) -> None:
        super().__init__()
        self.games, self.features, self.start = games, tuple(features), start
        self.symmetric, self.positive = symmetric, positive
        self.mlp = MLP(2 * width, 64, games * len(self.features), norm="layer") if self.features else None

    def forward(
        self, z: Float[Tensor, "B N D"], chosen: Bool[Tensor, "B P"] | None = None
    ) -> dict[str, Float[Tensor, "B M P"]]:
        """Weights by feature name; zero for pairs that are not ``chosen``, for which nothing is computed."""
        if self.mlp is None:
            return {}
        if chosen is None:
            return _by_name(self._between(of_pairs(z)), self.features, self.games)
        agents = torch.stack(pairs(z.shape[1], z.device), 1)
        scene, pair = chosen.nonzero(as_tuple=True)
        decoded = self._between(z[scene[:, None], agents[pair]])
        weights = decoded.new_zeros(*chosen.shape, decoded.shape[-1]).index_put((scene, pair), decoded)
        return _by_name(weights, self.features, self.games)

    def _between(self, agents: Float[Tensor, "*batch 2 D"]) -> Tensor:
        """Weights of all features and games from the features of both agents of each pair."""
        assert self.mlp is not None
        weights = self.mlp(agents.flatten(-2))
        if self.symmetric:
            weights = 0.5 * (weights + self.mlp(agents.flip(-2).flatten(-2)))
        return self.start * weights.exp() if self.positive else self.start + weights


class Margins(nn.Module):
    """phi_margin: margins [m] of a pair from the features of both agents, one network for all pairs.

    The margin is largest * sigmoid(s + output) with sigmoid(s) = start / largest, so it stays between 0 and ``largest``.

    Args:
        width: size of the agent features.
        games: number M of games: one per joint mode, or a single one.
        features: names of the pair features with a margin.
        largest: upper limit of a margin [m].
        start: margin at a network output of zero [m].
        symmetric: whether margins are the same in both orders of the two agents.
    """

    def __init__(
        self, width: int, games: int, features: Sequence[str], largest: float, start: float, symmetric: bool = False
    ) -> None:
        super().__init__()
        self.outputs = PairWeights(width, games, features, math.log(start / (largest - start)), symmetric)
        self.largest = largest

    def forward(
        self, z: Float[Tensor, "B N D"], chosen: Bool[Tensor, "B P"] | None = None
    ) -> dict[str, Float[Tensor, "B M P"]]:
        """Margins by feature name; of pairs that are not ``chosen``, ``largest / 2``, which has no effect."""
        return {name: self.largest * output.sigmoid() for name, output in self.outputs(z, chosen).items()}
