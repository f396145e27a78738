"""Displacement metrics that remember: sums over scenes of the functions of the same name."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.metrics.base import SceneMean
from epo_lightning.metrics.functional import min_ade, min_fde, min_sade, min_sfde


class MinADE(SceneMean):
    """Mean over scenes of :func:`~epo_lightning.metrics.functional.min_ade` [m]."""

    def update(
        self, states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
    ) -> None:
        """Count a batch of scenes."""
        self.add(min_ade(states, future, mask))


class MinFDE(SceneMean):
    """Mean over scenes of :func:`~epo_lightning.metrics.functional.min_fde` [m]."""

    def update(
        self, states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
    ) -> None:
        """Count a batch of scenes."""
        self.add(min_fde(states, future, mask))


class MinSADE(SceneMean):
    """Mean over scenes of :func:`~epo_lightning.metrics.functional.min_sade` [m]."""

    def update(
        self, states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
    ) -> None:
        """Count a batch of scenes."""
        self.add(min_sade(states, future, mask))


class MinSFDE(SceneMean):
    """Mean over scenes of :func:`~epo_lightning.metrics.functional.min_sfde` [m]."""

    def update(
        self, states: Float[Tensor, "B M N K X"], future: Float[Tensor, "B N K _"], mask: Bool[Tensor, "B N K"]
    ) -> None:
        """Count a batch of scenes."""
        self.add(min_sfde(states, future, mask))
