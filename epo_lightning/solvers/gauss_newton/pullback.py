"""The adjoint of a Gauss-Newton step: its gradient with respect to controls, weights and goals, in closed form.

For constant changes mu (``adjoint``) and d (``step``) of the controls, the gradient is that of the scalar

    phi(u, p) = -<J mu, r + J d>

by the controls u and by the weights and goals p. The quadratic model holds the first and second derivatives of every
residual r = w c(s(u)). The derivatives of phi by controls, nodes and positions are summed over the features, and at the end
they are backpropagated to the controls, as for the gradient of an energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.feature_derivatives import add_linear_gradient, linear_signal, steering_second_derivatives
from epo_lightning.scene import TURN_RATE
from epo_lightning.solvers.gauss_newton.iterate import following, suffix_sums
from epo_lightning.solvers.gauss_newton.quadratic_model import (
    GoalTerm,
    HeadingTerm,
    LaneTerm,
    QuadraticModel,
    SignalTerm,
    SteeringTerm,
)


@dataclass(frozen=True)
class Gradients:
    """The gradient of phi, without the parts of undeclared features, which need automatic differentiation.

    Attributes:
        controls: gradient by the controls.
        own, pair: gradients by the weights, by name of the feature.
        goals: gradient by the goals; None without a feature that needs goals.
        goal_headings: gradient by the headings wanted at the goals; None without a feature that needs them.
        margins: gradients by decoded margins, by name of the pair feature.
        reference_controls: gradient by the reference controls; None without a feature that needs them.
    """

    controls: Float[Tensor, "problems N 2 K"]
    own: dict[str, Float[Tensor, "problems N"]]
    pair: dict[str, Float[Tensor, "problems P"]]
    goals: Float[Tensor, "problems N 2"] | None
    goal_headings: Float[Tensor, "problems N"] | None
    margins: dict[str, Float[Tensor, "problems P"]]
    reference_controls: Float[Tensor, "problems N K 2"] | None


@dataclass(frozen=True)
class _Changes:
    """Changes along mu and d, stacked in the first dimension: of controls, nodes and positions."""

    controls: Float[Tensor, "2 problems N 2 K"]
    nodes: Float[Tensor, "2 problems N 2 K"]
    positions: Float[Tensor, "2 problems N 2 K"]


@dataclass(frozen=True)
class _Sums:
    """Derivatives of phi by controls, nodes and positions, to which the functions below add in place.

    Attributes:
        controls, nodes: derivatives by controls and nodes.
        positions: three derivatives, stacked in dimension 2: by the positions, by the change of positions along mu, and by
            their change along d.
    """

    controls: Float[Tensor, "problems N 2 K"]
    nodes: Float[Tensor, "problems N 2 K"]
    positions: Float[Tensor, "problems N 3 2 K"]


def pullback(
    model: QuadraticModel, adjoint: Float[Tensor, "problems N 2 K"], step: Float[Tensor, "problems N 2 K"]
) -> Gradients:
    """The gradient of phi = -<J mu, r + J d> for constant changes mu (``adjoint``) and d (``step``) of the controls."""
    at, dt = model.at, model.at.dt
    controls = torch.stack((adjoint, step))
    nodes = dt * controls.cumsum(-1)
    changes = _Changes(controls, nodes, at.to_positions((at.moves * nodes[:, :, :, :, None]).sum(3)))
    sums = _gradients_along_mu(model, changes)
    own: dict[str, Tensor] = {}
    goals = headings = None
    referring = "reference_controls" in at.energy.needs
    references = torch.zeros_like(adjoint).mT if referring else None
    for name, term in model.own.items():
        match term:
            case SignalTerm():
                along_mu, ahead = _pull_signal(term, changes, sums, dt)
                if references is not None and term.feature.needs == "reference_controls":
                    references[..., term.feature.channel] += term.weight.square() * along_mu
            case SteeringTerm():
                along_mu, ahead = _pull_steering(model, term, changes, sums)
            case LaneTerm():
                along_mu, ahead = _pull_lane(model, term, changes, sums)
            case GoalTerm():
                along_mu, ahead = _pull_goal(model, term, changes, sums)
                goals = term.weight.square() * along_mu
            case HeadingTerm():  # its derivative by the heading is in `_gradients_along_mu`
                along_mu, along_d = (at.last(change[:, :, 1:]) for change in changes.nodes)
                ahead = term.offset + along_d
                headings = (term.weight.square() * along_mu)[..., 0]
        own[name] = -2.0 * term.weight[..., 0] * (along_mu * ahead).flatten(2).sum(-1)
    pair, margins = _pull_pairs(model, changes, sums)
    after = at.to_velocities(sums.positions)
    along_e, along_left = (
        (direction[:, :, None] * after).sum(3) for direction in (at.unit, at.left)
    )  # [problems, N, 3, K]
    faster, turned = nodes.movedim(0, 2).unbind(3)  # [problems, N, 2, K]
    # Entry 0 acts through the velocities, entries 1 and 2 through their changes along mu and d, which are
    # (change of v) e + v (change of theta) e'.
    node = sums.nodes
    node[:, :, 0] += along_e[:, :, 0] + (turned * along_left[:, :, 1:]).sum(2)
    node[:, :, 1] += at.speed * (along_left[:, :, 0] - (turned * along_e[:, :, 1:]).sum(2))
    node[:, :, 1] += (faster * along_left[:, :, 1:]).sum(2)
    return Gradients(sums.controls + dt * suffix_sums(node), own, pair, goals, headings, margins, references)


def _gradients_along_mu(model: QuadraticModel, changes: _Changes) -> _Sums:
    """Initial values: minus the diagonal second derivatives times mu for controls and nodes, zero for positions."""
    mu = changes.controls[0]
    control = -model.control * mu
    node = -model.node * changes.nodes[0]
    if model.rate is not None:
        rate = -model.rate * (following(mu) - mu) / model.at.dt**2
        control -= rate - torch.nn.functional.pad(rate[..., :-1], (1, 0))
    problems, agents, _, steps = mu.shape
    return _Sums(control, node, mu.new_zeros(problems, agents, 3, 2, steps))


# Each of the functions for one own feature (`_pull_signal`, `_pull_steering`, `_pull_lane` and `_pull_goal`) adds the
# derivatives of this feature that are not in `_gradients_along_mu`. It returns J mu (``along_mu``) and r + J d (``ahead``),
# both without the feature's weight. `_pull_pairs` does the same for all pair features at once and returns gradients instead.


def _pull_signal(term: SignalTerm, changes: _Changes, sums: _Sums, dt: float) -> tuple[Tensor, Tensor]:
    along_mu, along_d = linear_signal(term.feature, changes.controls, changes.nodes[:, :, :, 0], dt, channels=-2)
    value, first, second = term.c
    if first is None:
        return along_mu, value + along_d
    ahead = value + first * along_d
    if second is not None:
        gradient = -term.weight.square() * second * (along_mu * ahead + first * along_mu * along_d)
        add_linear_gradient(term.feature, gradient, sums.controls, sums.nodes, dt)
    return first * along_mu, ahead


def _pull_steering(model: QuadraticModel, term: SteeringTerm, changes: _Changes, sums: _Sums) -> tuple[Tensor, Tensor]:
    square = term.weight.square()
    turned = changes.controls[:, :, :, TURN_RATE]
    faster = torch.nn.functional.pad(changes.nodes[:, :, :, 0, :-1], (1, 0))
    along_mu, along_d = term.by_turn_rate * turned + term.by_speed * faster
    ahead = term.angle + along_d
    twice, mixed, by_speeds = steering_second_derivatives(*model.at.steered())
    by_turn_rate = twice * turned + mixed * faster
    by_speed = mixed * turned + by_speeds * faster
    cross = square * term.by_turn_rate * term.by_speed
    sums.controls[:, :, TURN_RATE] -= (
        square * (ahead * by_turn_rate[0] + along_mu * by_turn_rate[1]) + cross * faster[0]
    )
    by_node = square * (ahead * by_speed[0] + along_mu * by_speed[1]) + cross * turned[0]
    sums.nodes[:, :, 0, :-1] -= by_node[..., 1:]
    return along_mu, ahead


def _pull_lane(model: QuadraticModel, term: LaneTerm, changes: _Changes, sums: _Sums) -> tuple[Tensor, Tensor]:
    square = term.weight.square()[..., None]
    active = model.at.within_game
    along_mu, along_d = changes.positions if active is None else changes.positions.where(active, 0.0)
    across = along_mu - term.tangent * (term.tangent * along_mu).sum(2, keepdim=True)
    if model.at.energy.lane_slides:
        along_mu, along_d = across, along_d - term.tangent * (term.tangent * along_d).sum(2, keepdim=True)
    ahead = term.offset + along_d
    sums.positions[:, :, 0] -= square * across
    sums.positions[:, :, 1] -= square * ahead
    sums.positions[:, :, 2] -= square * along_mu
    return along_mu, ahead


def _pull_goal(model: QuadraticModel, term: GoalTerm, changes: _Changes, sums: _Sums) -> tuple[Tensor, Tensor]:
    square = term.weight.square()
    at = model.at
    along_mu, along_d = (at.last(change) for change in changes.positions)
    ahead = term.offset + along_d
    scaled = square * along_mu
    for part, gradient in enumerate((scaled, square * ahead, scaled)):
        at.add_last_(sums.positions[:, :, part], -gradient)
    return along_mu, ahead


def _pull_pairs(
    model: QuadraticModel, changes: _Changes, sums: _Sums
) -> tuple[dict[str, Float[Tensor, "problems P"]], dict[str, Float[Tensor, "problems P"]]]:
    """Adds the derivatives of the declared pair features; returns the gradients by their weights and by their margins."""
    by_weight: dict[str, Tensor] = {}
    by_margin: dict[str, Tensor] = {}
    if not model.pair:
        return by_weight, by_margin
    at, edges, separation = model.at, model.edges, model.separation
    assert separation is not None
    normal = separation.normal
    at_steps = at.energy.at_pair_steps(changes.positions.movedim(0, 2).transpose(-1, -2)).transpose(-1, -2)
    apart = edges.difference(at_steps)  # [E, 2, xy, L]
    closing = (normal[:, None] * apart).sum(2)
    along_mu, along_d = closing.unbind(1)
    outward, with_mu, with_d = (torch.zeros_like(separation.distance) for _ in range(3))
    for name, term in model.pair.items():
        value, first, second = term.c
        assert first is not None
        square = term.weight.square()
        ahead = value + first * along_d
        slid = first * along_mu
        gain = first * slid
        if second is not None:
            outward -= square * second * (along_mu * ahead + slid * along_d)
        outward -= square * gain
        with_mu -= square * first * ahead
        with_d -= square * gain
        by_weight[name] = _of_all_pairs(model, -2.0 * term.weight[:, 0] * (slid * ahead).sum(-1))
        if term.by_margin is not None:
            wider, steeper = term.by_margin
            widened = steeper * along_mu * ahead + slid * (wider + steeper * along_d)
            by_margin[name] = _of_all_pairs(model, -square[:, 0] * widened.sum(-1))
    turning = (apart - closing[:, :, None] * normal[:, None]) * separation.inverse[:, None, None]
    gradient = outward[:, None] * normal + with_mu[:, None] * turning[:, 0] + with_d[:, None] * turning[:, 1]
    gradient = torch.stack((gradient, with_mu[:, None] * normal, with_d[:, None] * normal), 1)
    gradient = at.at_every_step(gradient.flatten(1, 2)).view(-1, 3, 2, at.horizon)
    edges.spread_(sums.positions, gradient, -gradient)
    return by_weight, by_margin


def _of_all_pairs(model: QuadraticModel, values: Float[Tensor, " E"]) -> Float[Tensor, "problems P"]:
    """Values of edges as values of all pairs, zero for pairs that are no edge."""
    at, edges = model.at, model.edges
    if not edges.every:
        rows = values.new_zeros(at.problems * at.agents * (at.agents - 1) // 2)
        values = rows.index_copy_(0, edges.pair, values)
    return values.view(at.problems, -1)
