"""Expansion of the features of pairs to second order: what they add to the quadratic model, by edge."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.feature_derivatives import margin_derivatives, pair_derivatives, undeclared_change_by_agent
from epo_lightning.game.features import PairFeature
from epo_lightning.solvers.gauss_newton.edges import Edges
from epo_lightning.solvers.gauss_newton.expansion_sums import Sums, outer
from epo_lightning.solvers.gauss_newton.iterate import Iterate
from epo_lightning.solvers.gauss_newton.quadratic_model import PairTerm, Separation


def _by_edge(at: Iterate, edges: Edges, values: Float[Tensor, "B _ P *steps"]) -> Float[Tensor, "E _"]:
    """Values of pairs by edge, one for all steps or one per step.

    Those that are the same in all modes may have a dimension of 1 for modes.
    """
    if values.dim() == 4:
        return edges.of_pairs(values.expand(-1, at.modes, -1, -1).flatten(0, 2))
    return edges.of_pairs(values.expand(-1, at.modes, -1).flatten())[:, None]


def _edge_exists(at: Iterate, edges: Edges, feature: PairFeature, steps: int) -> Bool[Tensor, "E _"]:
    """Mask of the edges whose agents are present, at the evaluated steps of their game."""
    exists = at.energy.pair_exists(at.scene, feature, steps).expand(-1, at.modes, -1, -1).flatten(0, 2)
    return exists.index_select(0, edges.pair)


def _edge_weight(at: Iterate, edges: Edges, name: str) -> Float[Tensor, "E 1"]:
    return _by_edge(at, edges, at.energy.pair_weight(at.scene, at.parameters, name))


def pair_terms(at: Iterate, edges: Edges, separation: Separation) -> dict[str, PairTerm]:
    """The declared pair features with their derivatives by the distance."""
    terms = {}
    for name, feature in at.energy.pair_features.items():
        if feature.declared:
            reach = _by_edge(at, edges, at.energy.reach(at.scene, at.parameters, name))
            c = pair_derivatives(feature, separation.distance, reach, second=True)
            by_margin = None
            if name in at.energy.decoded_margins:
                by_margin = margin_derivatives(feature, separation.distance, reach, c)
            if at.within_game is not None:
                active = _edge_exists(at, edges, feature, separation.distance.shape[-1])
                c = c.within(active)
                by_margin = by_margin and (by_margin[0].where(active, 0.0), by_margin[1].where(active, 0.0))
            terms[name] = PairTerm(_edge_weight(at, edges, name), c, by_margin)
    return terms


def add_pairs(sums: Sums, edges: Edges, separation: Separation, terms: dict[str, PairTerm]) -> Bool[Tensor, " E"]:
    """Add the declared pair features; returns the edges that couple their agents."""
    at, normal = sums.at, separation.normal
    by_distance = torch.zeros_like(separation.distance)
    curvature, value = torch.zeros_like(by_distance), torch.zeros_like(by_distance)
    for term in terms.values():
        c = term.c
        assert c.first is not None
        square = term.weight.square()
        scaled = square * c.value
        value += scaled * c.value
        if sums.exact and c.second is not None:
            curvature += scaled * c.second
        by_distance += scaled * c.first
        curvature += square * c.first.square()
    gradient = by_distance[:, None] * normal
    position = curvature[:, None] * outer(normal, 1)
    if sums.exact:
        turning = by_distance * separation.inverse
        position -= turning[:, None] * outer(normal, 1)
        position[:, ::2] += turning[:, None]
    gradient, position = at.at_every_step(gradient), at.at_every_step(position)
    edges.spread_(sums.positions, torch.cat((gradient, position), 1), torch.cat((-gradient, position), 1))
    sums.pair_position = position
    _add_pair_value(sums, edges, value)
    return (curvature != 0).any(1)


def add_undeclared_pair(sums: Sums, edges: Edges, feature: PairFeature, name: str) -> Bool[Tensor, " E"]:
    """Add an undeclared pair feature; returns the edges that couple their agents."""
    at, energy = sums.at, sums.at.energy
    both = edges.ends(energy.at_pair_steps(at.states.flatten(0, 1)))
    moved = energy.dynamics.tangent(at.states, at.node_directions(), at.dt).flatten(1, 2)
    moved = energy.at_pair_steps(moved).permute(1, 2, 0, 3, 4)  # [problems, N, 2 K, L, 4]
    first, second = (side.transpose(0, 1) for side in edges.ends(moved))
    others: tuple[Tensor, ...] = ()
    if feature.needs:
        others = edges.ends(energy.size(at.scene).repeat_interleave(at.modes, 0)[:, :, None])
    if feature.margin:
        others = (*others, _by_edge(at, edges, energy.margin(at.scene, at.parameters, name)))
    weight, exists = _edge_weight(at, edges, name), _edge_exists(at, edges, feature, both[0].shape[-2])
    ends = energy.evaluated(at.scene)
    if ends is not None:
        ends = ends[edges.first // (at.agents * at.modes)]
    found = undeclared_change_by_agent(feature, both, (first, second), *others, ends=ends)
    value, by_first, by_second = (weight * torch.where(exists, part, 0.0) for part in found)
    jacobians = by_first.permute(1, 0, 2), by_second.permute(1, 0, 2)  # [E, 2 K, R]
    gradients = (side @ value[..., None] for side in jacobians)
    edges.spread_(sums.node_gradient, *(part.view(-1, 2, at.horizon) for part in gradients))
    _add_pair_value(sums, edges, value.square())
    if not sums.exact:
        if sums.own_dense is None:
            sums.own_dense = value.new_zeros(at.problems, at.agents, 2 * at.horizon, 2 * at.horizon)
        edges.spread_(sums.own_dense, *(side @ side.mT for side in jacobians))
        shared = jacobians[0] @ jacobians[1].mT
        sums.pair_dense = shared if sums.pair_dense is None else sums.pair_dense + shared
    coupled = ((by_first != 0) & exists).any(-1).any(0)
    # The Hessian couples two agents also where the residual has derivatives of second order alone.
    return coupled | (value != 0).any(-1) if sums.exact else coupled


def _add_pair_value(sums: Sums, edges: Edges, value: Float[Tensor, "E L"]) -> None:
    """Add the energies of pairs, 1/2 w^2 c^2, with ``value`` = w^2 c^2."""
    first_of_problem = edges.first // sums.at.agents * sums.at.agents
    sums.agent_value.flatten().index_add_(0, first_of_problem, 0.5 * value.sum(-1))
