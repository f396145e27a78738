"""Sums over the features of an energy, to which each of them adds its part of the quadratic model."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from epo_lightning.solvers.gauss_newton.iterate import Iterate


@dataclass
class Sums:
    """Running sums over features, to which functions add.

    Attributes:
        at, exact: as for :func:`.expansion.expand`.
        agent_value: own energy of each agent. The energy of all pairs of a problem is added to the problem's first agent.
        control_gradient, node_gradient: gradients by controls and by nodes, without the part that acts through positions
            (``positions``).
        positions: gradient by positions (x, y), then their second derivatives (xx, xy, yy).
        control, rate, node, cross, own_dense, pair_position, pair_dense: see :class:`.quadratic_model.QuadraticModel`.
    """

    at: Iterate
    exact: bool
    agent_value: Tensor
    control_gradient: Tensor
    node_gradient: Tensor
    positions: Tensor
    control: Tensor
    node: Tensor
    rate: Tensor | None = None
    cross: Tensor | None = None
    own_dense: Tensor | None = None
    pair_position: Tensor | None = None
    pair_dense: Tensor | None = None

    @classmethod
    def zeros(cls, at: Iterate, exact: bool) -> Sums:
        """Sums over no feature."""

        def zeros(components: int) -> Tensor:
            return at.u.new_zeros(at.problems, at.agents, components, at.horizon)

        return cls(
            at,
            exact,
            agent_value=at.u.new_zeros(at.problems, at.agents),
            control_gradient=zeros(2),
            node_gradient=zeros(2),
            positions=zeros(5),
            control=zeros(2),
            node=zeros(2),
        )

    def crossed(self) -> Tensor:
        """The array ``cross``, allocated at first use."""
        if self.cross is None:
            self.cross = torch.zeros_like(self.node)
        return self.cross

    def add_value(self, scaled: Tensor, value: Tensor) -> None:
        """Add the energy of a feature, 1/2 w^2 c^2, with ``scaled`` = w^2 c."""
        self.agent_value += 0.5 * (scaled * value).flatten(2).sum(-1)


def outer(vector: Tensor, dim: int) -> Tensor:
    """The entries xx, xy and yy of v v^T."""
    x, y = vector.unbind(dim)
    return torch.stack((x * x, x * y, y * y), dim)
