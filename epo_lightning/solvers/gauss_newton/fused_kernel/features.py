"""The features of an energy as the fused kernels are compiled for them."""

from __future__ import annotations

from dataclasses import dataclass

from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, PAIR


@dataclass(frozen=True)
class Features:
    """The features of an energy, with their places in the kernels' arguments.

    Attributes:
        own, pair: names of the features, in the order of their weights.
        margins: names of the pair features with a margin, in the order of the margins.
    """

    own: tuple[str, ...]
    pair: tuple[str, ...]
    margins: tuple[str, ...] = ()

    @property
    def own_slots(self) -> list[int]:
        """For every known own feature its position among the weights, or -1."""
        return [self.own.index(name) if name in self.own else -1 for name in OWN]

    @property
    def pair_features(self) -> list[int]:
        """Number of every pair feature; the rest is -1."""
        return [*(PAIR.index(name) for name in self.pair), *[-1] * (len(PAIR) - len(self.pair))]

    @property
    def margin_slots(self) -> list[int]:
        """For every pair feature its position among the margins, or -1; the rest is -1."""
        found = [self.margins.index(name) if name in self.margins else -1 for name in self.pair]
        return [*found, *[-1] * (len(PAIR) - len(self.pair))]
