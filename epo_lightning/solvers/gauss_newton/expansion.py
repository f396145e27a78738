"""Expansion of an energy to second order around joint strategies: the contributions of every feature to the model.

Read :mod:`.iterate` (the unknowns, called nodes) and :class:`.quadratic_model.QuadraticModel` (what is added up) first.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_derivatives import (
    Bounds,
    add_linear_gradient,
    linear_signal,
    nearest_point,
    own_derivatives,
    steering,
    steering_second_derivatives,
)
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OwnFeature, Source
from epo_lightning.scene import HEADING, TURN_RATE, Scene
from epo_lightning.solvers.gauss_newton.edges import Edges
from epo_lightning.solvers.gauss_newton.expansion_sums import Sums, outer
from epo_lightning.solvers.gauss_newton.iterate import Iterate, suffix_sums
from epo_lightning.solvers.gauss_newton.pair_expansion import add_pairs, add_undeclared_pair, pair_terms
from epo_lightning.solvers.gauss_newton.quadratic_model import (
    GoalTerm,
    HeadingTerm,
    LaneTerm,
    OwnTerm,
    QuadraticModel,
    Separation,
    SignalTerm,
    SteeringTerm,
)

XX_YY = slice(2, None, 2)
"""Entries xx and yy among the five of :attr:`.Sums.positions`: x, y, xx, xy, yy."""


@torch.no_grad()
def expand(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    every_pair: bool,
    exact: bool = False,
) -> QuadraticModel:
    """The quadratic model of an energy around joint strategies.

    Args:
        energy, scene, parameters, controls: the game and where to expand it.
        every_pair: whether all pairs are evaluated, or only those that may interact.
        exact: whether the matrix is the Hessian. Otherwise it is the Gauss-Newton approximation, which leaves out the second
            derivatives of residuals.
    """
    at = Iterate.of(energy, scene, parameters, controls)
    sums = Sums.zeros(at, exact)
    own = {}
    for name, feature in energy.own_features.items():
        if feature.declared:
            own[name] = _add_own(sums, feature, at.by_problem(energy.own_weight(scene, parameters, name)))
        else:
            _add_undeclared(sums, name)
    if not energy.pair or at.agents < 2:
        edges = Edges.none(at.problems, at.agents, at.u.device)
    elif every_pair:
        edges = Edges.all(at.problems, at.agents, at.u.device)
    else:
        edges = Edges.near(energy, scene, parameters, at.states)
    separation = Separation.of(at, edges) if edges.pair.shape[0] else None
    linked = torch.zeros(edges.pair.shape[0], dtype=torch.bool, device=at.u.device)
    pair = {}
    if separation is not None:
        for name, pair_feature in energy.pair_features.items():
            if not pair_feature.declared:
                linked |= add_undeclared_pair(sums, edges, pair_feature, name)
        pair = pair_terms(at, edges, separation)
        if pair:
            linked |= add_pairs(sums, edges, separation, pair)
    if exact:
        _set_undeclared_hessian(sums, edges)
    by_velocity = at.to_velocities(sums.positions[:, :, :2])
    if exact:
        # The unit vector of a heading has the second derivative e'' = -e.
        sums.node[:, :, 1] -= at.speed * (at.unit * by_velocity).sum(2)
        sums.crossed()[:, :, 0] += (at.left * by_velocity).sum(2)
    sums.node_gradient += (at.moves * by_velocity[:, :, None]).sum(3)
    return QuadraticModel(
        at=at,
        value=sums.agent_value.cumsum(1)[:, -1],  # agent by agent, so that absent agents add an exact zero
        gradient=sums.control_gradient + at.dt * suffix_sums(sums.node_gradient),
        control=sums.control,
        rate=sums.rate,
        node=sums.node,
        cross=sums.cross,
        position=sums.positions[:, :, 2:],
        own_dense=sums.own_dense,
        edges=edges,
        linked=linked,
        pair_position=sums.pair_position,
        pair_dense=sums.pair_dense,
        own=own,
        pair=pair,
        separation=separation,
    )


def _add_own(sums: Sums, feature: OwnFeature, weight: Float[Tensor, "problems N 1"]) -> OwnTerm:
    """Add a declared own feature."""
    match feature.source:
        case Source.STEERING:
            return _add_steering(sums, weight)
        case Source.POSITION:
            return _add_lane(sums, weight)
        case Source.FINAL_POSITION:
            return _add_goal(sums, weight)
        case Source.FINAL_HEADING:
            return _add_heading(sums, weight)
        case _:
            return _add_signal(sums, feature, weight)


def _bounds(at: Iterate, feature: OwnFeature) -> Bounds:
    """Bounds of a feature's signal, for every problem where they depend on the kind of agent: [problems, N, 1]."""
    if not feature.bounded or feature.signal not in at.energy.bounded_by_kind:
        return at.around.bounds
    both = [torch.as_tensor(bound) for bound in at.around.bounds[feature.signal]]
    lower, upper = (bound.expand(-1, at.modes, -1, -1).flatten(0, 1) for bound in both)
    return {feature.signal: (lower, upper)}


def _add_signal(sums: Sums, feature: OwnFeature, weight: Float[Tensor, "problems N 1"]) -> SignalTerm:
    at, square = sums.at, weight.square()
    signal = linear_signal(feature, at.u, at.speed, at.dt, channels=-2)
    if feature.needs:
        signal = signal - at.around.reference(feature).expand(-1, at.modes, -1, -1).flatten(0, 1)
    active = at.within_game
    if active is not None:
        # Entry l of a rate is that from control l to control l + 1, which must be part of the game.
        active = active[:, :, 0, 1:] if feature.source is Source.RATE else active[:, :, 0]
    c = own_derivatives(feature, signal, _bounds(at, feature), second=True).within(active)
    scaled = square * c.value
    sums.add_value(scaled, c.value)
    curvature = square if c.first is None else square * c.first.square()
    if sums.exact and c.second is not None:
        curvature = curvature + scaled * c.second
    add_linear_gradient(
        feature, scaled if c.first is None else scaled * c.first, sums.control_gradient, sums.node_gradient, at.dt
    )
    match feature.source:
        case Source.CONTROL:
            sums.control[:, :, feature.channel] += curvature
        case Source.RATE:
            if sums.rate is None:
                sums.rate = torch.zeros_like(sums.control)
            sums.rate[:, :, feature.channel, :-1] += curvature
        case _:
            sums.node[:, :, 0] += curvature
    return SignalTerm(feature, weight, c)


def _add_steering(sums: Sums, weight: Float[Tensor, "problems N 1"]) -> SteeringTerm:
    at, square = sums.at, weight.square()
    angle, by_turn_rate, by_speed = steering(*at.steered())
    if at.within_game is not None:
        angle, by_turn_rate, by_speed = (
            part.where(at.within_game[:, :, 0], 0.0) for part in (angle, by_turn_rate, by_speed)
        )
    scaled = square * angle
    sums.add_value(scaled, angle)
    curvature = [square * by_turn_rate.square(), square * by_turn_rate * by_speed, square * by_speed.square()]
    if sums.exact:
        second = steering_second_derivatives(*at.steered())
        curvature = [part + scaled * by for part, by in zip(curvature, second, strict=True)]
    sums.control_gradient[:, :, TURN_RATE] += scaled * by_turn_rate
    sums.control[:, :, TURN_RATE] += curvature[0]
    # The steering angle of a step depends on the speed at the node before the step. The initial speed is not an unknown.
    # Entry l of an array of nodes is node l + 1, and a turn rate is the difference of two headings, divided by dt.
    sums.node_gradient[:, :, 0, :-1] += (scaled * by_speed)[..., 1:]
    sums.node[:, :, 0, :-1] += curvature[2][..., 1:]
    cross = curvature[1][..., 1:] / at.dt
    sums.crossed()[:, :, 0, :-1] -= cross
    sums.crossed()[:, :, 1, :-1] += cross
    return SteeringTerm(weight, angle, by_turn_rate, by_speed)


def _add_lane(sums: Sums, weight: Float[Tensor, "problems N 1"]) -> LaneTerm:
    at = sums.at
    assert at.around.line is not None
    position = at.states[..., :2]
    nearest, tangent = nearest_point(position, at.around.line)
    offset, tangent = (rows.flatten(0, 1).transpose(-1, -2).contiguous() for rows in (position - nearest, tangent))
    square = weight.square()[..., None]
    if at.within_game is not None:
        offset, square = offset.where(at.within_game, 0.0), square.where(at.within_game, 0.0)
    scaled = square * offset
    sums.positions[:, :, :2] += scaled
    sums.positions[:, :, XX_YY] += square
    if sums.exact or at.energy.lane_slides:
        sums.positions[:, :, 2:] -= square * outer(tangent, 2)
    sums.add_value(scaled, offset)
    return LaneTerm(weight, offset, tangent)


def _add_goal(sums: Sums, weight: Float[Tensor, "problems N 1"]) -> GoalTerm:
    at, square = sums.at, weight.square()
    assert at.around.goals is not None
    offset = at.last(at.x[:, :, :2]) - at.around.goals.flatten(0, 1)
    scaled = square * offset
    at.add_last_(sums.positions[:, :, :2], scaled)
    at.add_last_(sums.positions[:, :, XX_YY], square)
    sums.add_value(scaled, offset)
    return GoalTerm(weight, offset)


def _add_heading(sums: Sums, weight: Float[Tensor, "problems N 1"]) -> HeadingTerm:
    at, square = sums.at, weight.square()
    offset = at.last(at.x[:, :, HEADING, None]) - at.by_problem(at.around.goal_headings)
    scaled = square * offset
    at.add_last_(sums.node_gradient[:, :, 1:], scaled)
    at.add_last_(sums.node[:, :, 1:], square)
    sums.add_value(scaled, offset)
    return HeadingTerm(weight, offset)


def _add_undeclared(sums: Sums, name: str) -> None:
    at = sums.at
    directions = at.node_directions()
    moved = at.energy.dynamics.tangent(at.states, directions, at.dt), directions
    value, change = at.energy.own_residual(
        name, at.scene, at.parameters, at.around, (at.states, at.controls), moved
    )  # [B, M, N, R], [2 K, B, M, N, R]
    # The residual is weighted already, w c, and its derivatives as well.
    value, jacobian = value.flatten(0, 1), change.flatten(1, 2).permute(1, 2, 0, 3)
    sums.add_value(value, value)
    sums.node_gradient += (jacobian @ value[..., None]).view_as(sums.node_gradient)
    if not sums.exact:
        block = jacobian @ jacobian.mT
        sums.own_dense = block if sums.own_dense is None else sums.own_dense + block


def _set_undeclared_hessian(sums: Sums, edges: Edges) -> None:
    """Set the second derivatives of undeclared features, by automatic differentiation of their gradient, row by row."""
    at, part = sums.at, sums.at.energy.undeclared
    if part is not None and not edges.pair.shape[0]:
        part = dataclasses.replace(part, pair=()) if part.own else None
    if part is None:
        return
    with torch.enable_grad():
        controls = at.controls.detach().requires_grad_()
        energy = part(at.scene, at.parameters.map(Tensor.detach), controls).sum()
        (gradient,) = torch.autograd.grad(energy, controls, create_graph=True)
        rows = []
        for unit in torch.eye(controls[0, 0].numel(), dtype=controls.dtype, device=controls.device):
            along_unit = (gradient * unit.view(controls.shape[2:])).sum()
            rows.append(
                torch.autograd.grad(along_unit, controls, retain_graph=True, allow_unused=True)[0]
                if along_unit.requires_grad
                else None
            )
    hessian = torch.stack([torch.zeros_like(controls) if row is None else row for row in rows])
    hessian = hessian.flatten(1, 2).view(at.agents, at.horizon, 2, at.problems, at.agents, at.horizon, 2)
    at_nodes = at.to_nodes(
        at.to_nodes(hessian.permute(3, 0, 2, 4, 6, 5, 1)).transpose(-1, -2)
    )  # [problems i c j d k l]
    at_nodes = at_nodes.permute(0, 1, 3, 2, 5, 4, 6)
    at_nodes = at_nodes.reshape(at.problems, at.agents, at.agents, 2 * at.horizon, 2 * at.horizon)
    sums.own_dense = at_nodes.diagonal(dim1=1, dim2=2).movedim(-1, 1)
    if part.pair:
        rows_of = edges.first * at.agents + edges.second % at.agents
        sums.pair_dense = at_nodes.flatten(0, 2)[rows_of]
