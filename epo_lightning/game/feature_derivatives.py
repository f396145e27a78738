"""Derivatives of named features: signals, their Jacobian along directions, and elementwise first and second derivatives.

A declared feature is c(s(u)) with a signal s whose Jacobian is known in closed form (:func:`signal_and_change`) and an
elementwise function c (:func:`own_derivatives`, :func:`pair_derivatives`). An undeclared feature is any differentiable
function of the trajectory and is differentiated by forward-mode automatic differentiation (:func:`undeclared_change`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.game import exported_derivatives
from epo_lightning.game.circles import overlap
from epo_lightning.game.features import SLOWEST_STEERING, OwnFeature, PairFeature, Source
from epo_lightning.game.game_end import at_end, until
from epo_lightning.scene import HEADING, SPEED, TURN_RATE

Bounds = Mapping[str, Sequence[float] | tuple[Tensor, Tensor]]
"""Lowest and highest value by signal: numbers, or one for every agent, [B, 1, N, 1]."""


class Derivatives(NamedTuple):
    """An elementwise function c(s) and its derivatives, entry by entry.

    Attributes:
        value: c(s).
        first: dc/ds; None where it is 1 everywhere.
        second: d2c/ds2; None where it is 0 everywhere, or was not asked for.
    """

    value: Tensor
    first: Tensor | None = None
    second: Tensor | None = None

    def within(self, mask: Bool[Tensor, "*#shape"] | None) -> Derivatives:
        """The same function, constantly zero outside of the mask; None for no mask."""
        if mask is None:
            return self
        first = mask.to(self.value.dtype).expand_as(self.value) if self.first is None else self.first.where(mask, 0.0)
        second = None if self.second is None else self.second.where(mask, 0.0)
        return Derivatives(self.value.where(mask, 0.0), first, second)


def differentiate(function: Callable[..., Tensor], value: Tensor, *others: Tensor, second: bool = False) -> Derivatives:
    """Value and first derivative of an elementwise function by its first argument; with ``second``, also the second one.

    The derivatives can be differentiated again by autograd.
    """

    def first(argument: Tensor) -> Tensor:
        return _jvp(lambda s: function(s, *others), argument)[1]

    if torch.compiler.is_exporting():
        once, twice = exported_derivatives.slopes(function, value, *others)
        return Derivatives(function(value, *others), once, twice if second else None)
    if second:
        return Derivatives(function(value, *others), *_jvp(first, value))
    return Derivatives(*_jvp(lambda s: function(s, *others), value))


def _jvp(function: Callable[[Tensor], Tensor], value: Tensor) -> tuple[Tensor, Tensor]:
    primal, tangent = torch.func.jvp(function, (value,), (torch.ones_like(value),))[:2]
    return primal, tangent


def own_derivatives(
    feature: OwnFeature, signal: Float[Tensor, "*shape"], bounds: Bounds, second: bool = False
) -> Derivatives:
    """A declared own feature c(s) of its signal s, with its derivatives.

    Args:
        feature, signal: the feature, and the values s of its signal.
        bounds: lowest and highest value by signal, for bounded features: numbers, or tensors that broadcast with the signal.
        second: whether second derivatives of functions are computed.
    """
    if feature.bounded:
        lower, upper = bounds[feature.signal]
        return violation(signal, lower, upper)
    if feature.function is not None:
        return differentiate(feature.function, signal, second=second)
    return Derivatives(signal)


def pair_derivatives(feature: PairFeature, distance: Tensor, reach: Tensor, second: bool = False) -> Derivatives:
    """A declared pair feature of the distance, with its derivatives by the distance."""
    if feature.function is overlap:
        return Derivatives(overlap(distance, reach), -(distance < reach).to(distance.dtype))
    return differentiate(feature.function, distance, reach, second=second)


def margin_derivatives(
    feature: PairFeature, distance: Tensor, reach: Tensor, c: Derivatives
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """Derivatives, by the margin (a part of the reach), of a declared pair feature c and of its slope dc/ds."""
    if feature.function is overlap:
        assert c.first is not None
        return -c.first, torch.zeros_like(c.first)
    reach = reach.expand_as(distance).contiguous()

    def by_distance(reach: Tensor) -> Tensor:
        return _jvp(lambda s: feature.function(s, reach), distance)[1]

    return _jvp(lambda reach: feature.function(distance, reach), reach)[1], _jvp(by_distance, reach)[1]


def violation(value: Float[Tensor, "*shape"], lower: float | Tensor, upper: float | Tensor) -> Derivatives:
    """The amount by which a signal leaves [lower, upper]; its derivative is 1 above, -1 below and 0 within."""
    excess = (value - upper).clamp_min(0.0) + (lower - value).clamp_min(0.0)
    return Derivatives(excess, (value > upper).to(value.dtype) - (value < lower).to(value.dtype))


# --- Signals ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Surroundings:
    """Inputs of own features besides the trajectory: zero for absent agents, None where no feature needs them.

    Attributes:
        initial: the states x_0.
        dt: time step [s].
        goals: goal positions.
        line: points of the followed reference lines.
        reference_speed: desired speeds [m/s].
        wheelbase: distances between the axles [m].
        goal_headings: headings that are wanted at the goals [rad].
        ends: number of steps of every game; None for all steps of the controls.
        reference_controls: the controls of the strategies that agents would choose by themselves.
        bounds: lowest and highest value of each bounded signal.
    """

    initial: Float[Tensor, "B 1 N 4"]
    dt: float
    goals: Float[Tensor, "B M N 2"] | None = None
    line: Float[Tensor, "B M N Q 2"] | None = None
    reference_speed: Float[Tensor, "B 1 N"] | None = None
    wheelbase: Float[Tensor, "B 1 N"] | None = None
    goal_headings: Float[Tensor, "B M N"] | None = None
    ends: Int[Tensor, " B"] | None = None
    reference_controls: Float[Tensor, "B M N K 2"] | None = None
    bounds: Bounds = field(default_factory=dict)

    def reference(self, feature: OwnFeature) -> Float[Tensor, "B _ N _"]:
        """The desired signal of a feature with the source CONTROL or SPEED, over time."""
        if feature.source is Source.SPEED:
            assert self.reference_speed is not None
            return self.reference_speed[..., None]
        assert self.reference_controls is not None
        return self.reference_controls[..., feature.channel]


def linear_signal(
    feature: OwnFeature, controls: Tensor, speed: Float[Tensor, "*batch K"], dt: float, channels: int = -1
) -> Float[Tensor, "*batch R"]:
    """The signal of a feature with the source CONTROL, RATE or SPEED.

    These signals are linear in controls and speeds, so the function also maps changes of them to the change of the signal.

    Args:
        feature: the feature.
        controls: accelerations and turn rates.
        speed: speeds v_1 .. v_K after every step.
        dt: time step [s].
        channels: the dimension of ``controls`` that holds accelerations and turn rates.
    """
    if feature.source is Source.SPEED:
        return speed
    control = controls.select(channels, feature.channel)
    return control if feature.source is Source.CONTROL else control.diff(dim=-1) / dt


def add_linear_gradient(
    feature: OwnFeature,
    gradient: Float[Tensor, "*batch R"],
    control: Float[Tensor, "*batch 2 K"],
    node: Float[Tensor, "*batch 2 K"],
    dt: float,
) -> None:
    """Backpropagate ``gradient``, the gradient with respect to a linear signal; the adjoint of :func:`linear_signal`.

    Adds in place to ``control``, the gradient with respect to the controls, or, for signals of states, to ``node``, the
    gradient with respect to speed and heading.
    """
    match feature.source:
        case Source.CONTROL:
            control[..., feature.channel, :] += gradient
        case Source.RATE:
            gradient = gradient / dt
            control[..., feature.channel, 1:] += gradient
            control[..., feature.channel, :-1] -= gradient
        case _:
            node[..., 0, :] += gradient


def signal_and_change(
    feature: OwnFeature,
    states: Float[Tensor, "*batch K 4"],
    controls: Float[Tensor, "*batch K 2"],
    moved: Float[Tensor, "D *batch K 4"],
    directions: Float[Tensor, "D *batch K 2"],
    around: Surroundings,
    slide: bool = False,
) -> tuple[Float[Tensor, "*batch R"], Float[Tensor, "D *batch R"]]:
    """The signal of a declared feature over time, and its change along D directions of the controls.

    R is K, K - 1 for rates, 2 K (x and y) for lines, 2 for goals, and 1 for their headings. Goals and headings are those of
    the last state of the game; the other signals go on after its end.

    Args:
        feature: a declared feature.
        states, controls: the trajectories.
        moved, directions: the changes of states and controls.
        around: the other inputs of the signal.
        slide: only for lines: whether the nearest point of the line moves when the agent moves, which gives the exact
            derivative. If False, the point is held fixed (``FeatureEnergy.lane_slides``).
    """
    match feature.source:
        case Source.CONTROL | Source.RATE | Source.SPEED:
            signal = linear_signal(feature, controls, states[..., SPEED], around.dt)
            if feature.needs:
                signal = signal - around.reference(feature)
            return signal, linear_signal(feature, directions, moved[..., SPEED], around.dt)
        case Source.STEERING:
            assert around.wheelbase is not None
            before, wheelbase = speed_before(states, around.initial), around.wheelbase[..., None]
            angle, by_turn_rate, by_speed = steering(controls[..., TURN_RATE], before, wheelbase)
            faster = speed_before(moved, torch.zeros_like(around.initial))
            return angle, by_turn_rate * directions[..., TURN_RATE] + by_speed * faster
        case Source.POSITION:
            assert around.line is not None
            position, change = states[..., :2], moved[..., :2]
            nearest, tangent = nearest_point(position, around.line)
            if slide:
                change = change - (change * tangent).sum(-1, keepdim=True) * tangent
            return (position - nearest).flatten(-2), change.flatten(-2)
        case Source.FINAL_POSITION:
            assert around.goals is not None
            return at_end(states, around.ends)[..., :2] - around.goals, at_end(moved, around.ends)[..., :2]
        case Source.FINAL_HEADING:
            assert around.goal_headings is not None
            heading, turned = at_end(states, around.ends)[..., HEADING], at_end(moved, around.ends)[..., HEADING]
            return (heading - around.goal_headings)[..., None], turned[..., None]
    raise AssertionError(feature)


def nearest_point(
    position: Float[Tensor, "*batch K 2"], line: Float[Tensor, "*#batch Q 2"]
) -> tuple[Float[Tensor, "*batch K 2"], Float[Tensor, "*batch K 2"]]:
    """The nearest point of a polyline, and the unit tangent there; the tangent is zero if the point is an end of a segment.

    Differentiable with respect to the position; the choice of the segment is held constant (the first one on a tie).
    """
    x, y = position.unbind(-1)
    start_x, start_y = (line[..., :-1, axis].contiguous() for axis in range(2))  # [.. Q-1]
    along_x, along_y = (line[..., axis].diff(dim=-1) for axis in range(2))
    squared = along_x.square() + along_y.square()
    inverse = torch.where(squared > 0, 1.0 / squared, 0.0)
    with torch.no_grad():
        off_x = x.detach()[..., None, :] - start_x[..., None]  # [.. Q-1 K]
        off_y = y.detach()[..., None, :] - start_y[..., None]
        share = (off_x * along_x[..., None]).addcmul_(off_y, along_y[..., None])
        share = share.mul_(inverse[..., None]).clamp_(0.0, 1.0)
        off_x = off_x - share * along_x[..., None]
        off_y = off_y - share * along_y[..., None]
        segment = off_x.square().add_(off_y.square()).min(-2).indices  # [.. K], the first one on a tie
    start_x, start_y, along_x, along_y, inverse = (
        values.expand(*segment.shape[:-1], -1).gather(-1, segment)
        for values in (start_x, start_y, along_x, along_y, inverse)
    )
    share = ((x - start_x) * along_x + (y - start_y) * along_y) * inverse
    length = torch.where((share > 0) & (share < 1), inverse.sqrt(), 0.0)
    share = share.clamp(0.0, 1.0)
    nearest = torch.stack((start_x + share * along_x, start_y + share * along_y), -1)
    return nearest, torch.stack((length * along_x, length * along_y), -1)


def steering(
    turn_rate: Float[Tensor, "*batch K"], speed: Float[Tensor, "*batch K"], wheelbase: Float[Tensor, "*#batch 1"]
) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K"], Float[Tensor, "*batch K"]]:
    """The steering angle atan(L omega / max(v, 1 m/s)) [rad], and its first derivatives by omega and v."""
    floored = speed.clamp_min(SLOWEST_STEERING)
    curvature = wheelbase / floored
    tangent = curvature * turn_rate
    by_turn_rate = curvature / (1.0 + tangent.square())
    by_speed = torch.where(speed < SLOWEST_STEERING, 0.0, -by_turn_rate * turn_rate / floored)
    return tangent.atan(), by_turn_rate, by_speed


def steering_second_derivatives(
    turn_rate: Float[Tensor, "*batch K"], speed: Float[Tensor, "*batch K"], wheelbase: Float[Tensor, "*#batch 1"]
) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K"], Float[Tensor, "*batch K"]]:
    """Second derivatives of the steering angle: by omega twice, by omega and v, by v twice."""
    floored = speed.clamp_min(SLOWEST_STEERING)
    curvature = wheelbase / floored
    tangent = curvature * turn_rate
    square = (1.0 + tangent.square()).square()
    slow = speed < SLOWEST_STEERING
    twice = -2.0 * curvature.square() * tangent / square
    mixed = torch.where(slow, 0.0, curvature * (tangent.square() - 1.0) / (floored * square))
    by_speed = torch.where(slow, 0.0, 2.0 * tangent / (floored.square() * square))
    return twice, mixed, by_speed


def speed_before(states: Float[Tensor, "*batch K 4"], initial: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch K"]:
    """The speeds v_0 .. v_{K-1} at which the controls of every step begin to act."""
    start = initial[..., SPEED, None].expand(*states.shape[:-2], 1)
    return torch.cat((start, states[..., :-1, SPEED]), -1)


# --- Undeclared features ----------------------------------------------------------------------------------------------


def undeclared_change(
    function: Callable[..., Tensor], at: tuple[Tensor, Tensor], directions: tuple[Tensor, Tensor], *others: Tensor
) -> tuple[Float[Tensor, "*batch R"], Float[Tensor, "D *batch R"]]:
    """Value of a function, and its change along D directions, by forward-mode automatic differentiation.

    Args:
        function: function of two tensors that vary and of ``others``, which are constant.
        at: values of the two tensors.
        directions: D directions of both tensors, stacked in a new first dimension.
        others: further arguments, held constant.
    """
    value = function(*at, *others)
    if len(directions[0]) == 0:
        return value, value.new_zeros(0, *value.shape)
    if torch.compiler.is_exporting():
        return value, exported_derivatives.change(function, at, directions, *others)
    return value, torch.func.vmap(
        lambda *moved: torch.func.jvp(lambda *states: function(*states, *others), at, moved)[1]
    )(*directions)


def derivatives_of_steps(
    function: Callable[..., Tensor], at: tuple[Tensor, Tensor], *others: Tensor
) -> tuple[Float[Tensor, "*batch K"], list[Float[Tensor, "*batch K _"]]]:
    """Value of a function of single steps, and its derivatives by the numbers of each step in its two tensors.

    Arguments are those of :func:`undeclared_change`. The changes along any number of directions follow from these few.
    """
    value, by = undeclared_change(function, at, unit_directions(at), *others)
    return value, [part.movedim(0, -1) for part in by.split([tensor.shape[-1] for tensor in at])]


def unit_directions(at: tuple[Tensor, Tensor]) -> tuple[Float[Tensor, "D *batch K _"], Float[Tensor, "D *batch K _"]]:
    """Directions of two tensors that change one of the D numbers of all steps, which the two have together."""
    sizes = [tensor.shape[-1] for tensor in at]
    unit = torch.eye(sum(sizes), dtype=at[0].dtype, device=at[0].device)
    first, second = (
        unit.view(-1, *[1] * (at[0].dim() - 1), sum(sizes)).expand(-1, *at[0].shape[:-1], -1).split(sizes, -1)
    )
    return first, second


def stepwise_change(
    function: Callable[..., Tensor], at: tuple[Tensor, Tensor], directions: tuple[Tensor, Tensor]
) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "D *batch K"]]:
    """The same as :func:`undeclared_change`, for a function of single steps."""
    if len(directions[0]) <= sum(tensor.shape[-1] for tensor in at):
        return undeclared_change(function, at, directions)
    value, (by_first, by_second) = derivatives_of_steps(function, at)
    return value, (by_first * directions[0]).sum(-1) + (by_second * directions[1]).sum(-1)


def undeclared_change_by_agent(
    feature: PairFeature,
    both: tuple[Tensor, Tensor],
    moved: tuple[Tensor, Tensor],
    *others: Tensor,
    ends: Int[Tensor, " E"] | None = None,
) -> tuple[Float[Tensor, "*batch R"], Float[Tensor, "D *batch R"], Float[Tensor, "D *batch R"]]:
    """Value of an undeclared pair feature, and its change along D directions of the first and of the second agent.

    Args:
        feature: the feature.
        both: states [.., L, 4] of the first and second agents.
        moved: changes [D, .., L, 4] of both.
        others: lengths and widths of both and the margin, for features that need them.
        ends: number of evaluated steps in the game of every row, for functions that are not stepwise.
    """
    if feature.stepwise:
        value, by = derivatives_of_steps(feature.function, both, *others)
        by_first, by_second = ((one * side).sum(-1) for one, side in zip(by, moved, strict=True))
        return value, by_first, by_second
    first, second = moved
    still = torch.zeros_like(first)
    function = until(feature.function, ends)
    value, by_first = undeclared_change(function, both, (first, still), *others)
    _, by_second = undeclared_change(function, both, (still, second), *others)
    return value, by_first, by_second
