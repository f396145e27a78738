"""The quadratic model of an energy around an iterate: value, gradient, and the structured Gauss-Newton or exact matrix.

In the unknowns z of :mod:`~epo_lightning.solvers.gauss_newton.iterate`, positions contribute to the matrix at (l, l') with
l >= l'

    M_l^T [dt^2 sum_{k>l} Q_k] M_l',   Q_k the second derivatives by p_k,

where Q_k couples the agents. So the lower triangle of this part equals that of a product A B^T, where A and B have a row for
each unknown and two columns (x and y) for each agent: a row of B has M_l' in the columns of its own agent. All other
contributions are banded matrices: controls are first differences of z, their rates second differences, speeds contribute to
the diagonal, and a steering angle couples a turn rate with the speed before it. The model holds the second derivatives by
these quantities; :mod:`~epo_lightning.solvers.gauss_newton.blocks` assembles and factorises the matrix.

Pairs are a list of E edges between agents. Agent i of problem b has the number b N + i.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.feature_derivatives import Derivatives
from epo_lightning.game.features import OwnFeature
from epo_lightning.solvers.gauss_newton.edges import Edges
from epo_lightning.solvers.gauss_newton.iterate import Iterate


@dataclass(frozen=True)
class SignalTerm:
    """A feature of a control, its rate or the speed: c(s) with derivatives."""

    feature: OwnFeature
    weight: Float[Tensor, "problems N 1"]
    c: Derivatives


@dataclass(frozen=True)
class SteeringTerm:
    """The steering angle, with its derivatives by the turn rate and by the speed before it."""

    weight: Float[Tensor, "problems N 1"]
    angle: Float[Tensor, "problems N K"]
    by_turn_rate: Float[Tensor, "problems N K"]
    by_speed: Float[Tensor, "problems N K"]


@dataclass(frozen=True)
class LaneTerm:
    """The offset from the nearest point of a line, and the unit tangent there, which is zero at the ends of segments."""

    weight: Float[Tensor, "problems N 1"]
    offset: Float[Tensor, "problems N 2 K"]
    tangent: Float[Tensor, "problems N 2 K"]


@dataclass(frozen=True)
class GoalTerm:
    """The offset of the last position from the goal."""

    weight: Float[Tensor, "problems N 1"]
    offset: Float[Tensor, "problems N 2"]


@dataclass(frozen=True)
class HeadingTerm:
    """The last heading minus the one that is wanted at the goal."""

    weight: Float[Tensor, "problems N 1"]
    offset: Float[Tensor, "problems N 1"]


OwnTerm = SignalTerm | SteeringTerm | LaneTerm | GoalTerm | HeadingTerm


@dataclass(frozen=True)
class PairTerm:
    """A feature of the distance, c(|p_i - p_j|), with derivatives.

    Attributes:
        by_margin: derivatives of c and of c' by the margin; None if the margin is not decoded.
    """

    weight: Float[Tensor, "E 1"]
    c: Derivatives
    by_margin: tuple[Float[Tensor, "E L"], Float[Tensor, "E L"]] | None = None


@dataclass(frozen=True)
class Separation:
    """The edges' distances at the L evaluated steps.

    Attributes:
        distance: distance of the two agents.
        inverse: inverse of the distance, zero where both agents are at the same point.
        normal: unit vector from the second agent to the first, zero where both are at the same point.
    """

    distance: Float[Tensor, "E L"]
    inverse: Float[Tensor, "E L"]
    normal: Float[Tensor, "E 2 L"]

    @classmethod
    def of(cls, at: Iterate, edges: Edges) -> Separation:
        """The distances of all edges."""
        position = at.energy.at_pair_steps(at.x[:, :, :2].transpose(-1, -2)).transpose(-1, -2)
        offset = edges.difference(position)
        squared = offset.square().sum(1)
        apart = squared > 0
        root = torch.where(apart, squared, 1.0).sqrt()
        inverse = torch.where(apart, 1.0 / root, 0.0)
        return cls(torch.where(apart, root, 0.0), inverse, offset * inverse[:, None])


@dataclass(frozen=True)
class QuadraticModel:
    """The energy around joint strategies u: its value, gradient and Gauss-Newton (or exact) matrix, in the unknowns z.

    Attributes:
        at: the iterate.
        value: E(u), by problem.
        gradient: dE/du.
        control, node: second derivatives by single controls and by single nodes.
        rate: second derivatives by single rates of controls, zero at the last entry (there are K - 1 rates); None if no
            feature uses a rate.
        cross: second derivatives by the speed of node l and the heading of node l (entry 0) or l + 1 (entry 1); None if
            they are zero.
        position: second derivatives by the positions: xx, xy and yy.
        own_dense: all second derivatives of undeclared own features by the D = 2 K entries of z; None without.
        edges: the pairs that were evaluated.
        linked: the edges whose two agents are coupled.
        pair_position: xx, xy and yy of an edge; None without edges. ``position`` already contains them for both agents, and
            the block between the two agents is minus them.
        pair_dense: second derivatives of undeclared pair features by the nodes of both agents; None without.
        own: declared own features by name.
        pair: declared pair features by name.
        separation: distances of the edges; None without edges.
    """

    at: Iterate
    value: Float[Tensor, " problems"]
    gradient: Float[Tensor, "problems N 2 K"]
    control: Float[Tensor, "problems N 2 K"]
    rate: Float[Tensor, "problems N 2 K"] | None
    node: Float[Tensor, "problems N 2 K"]
    cross: Float[Tensor, "problems N 2 K"] | None
    position: Float[Tensor, "problems N 3 K"]
    own_dense: Float[Tensor, "problems N D D"] | None
    edges: Edges
    linked: Bool[Tensor, " E"]
    pair_position: Float[Tensor, "E 3 K"] | None
    pair_dense: Float[Tensor, "E D D"] | None
    own: dict[str, OwnTerm]
    pair: dict[str, PairTerm]
    separation: Separation | None
