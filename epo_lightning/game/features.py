"""The named features of an energy: what an agent, or a pair of agents, would rather keep small.

An own feature is a *signal* of the trajectory (a control, its rate of change, the speed, the steering angle, the way to a
line or a goal), taken as it is, or as the amount by which it leaves its bounds (names that end in ``b``: the paper's soft
constraints max(0, g(z))), or through an elementwise function of one's own. A pair feature is such a function of the
distance between two agents, or any function of their states and sizes. Where a signal comes from is *declared*, and is all
that a solver has to know of its Jacobian.

A feature of one's own needs no declaration: any differentiable function of the trajectory will do, at lower speed::

    @own_feature("lateral")                                   # [.., K, 4], [.., K, 2] -> [.., R]
    def lateral(states, controls):
        return states[..., SPEED] * controls[..., TURN_RATE]

    @own_feature("hard_braking", Source.CONTROL, channel=ACCELERATION)   # declared: of the signal alone, elementwise
    def hard_braking(acceleration):
        return torch.relu(-3.0 - acceleration)

    @pair_feature("gap", Source.DISTANCE)                     # declared: of distance and reach, elementwise
    def gap(distance, reach):
        return torch.exp(reach - distance)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game import symmetry
from epo_lightning.game.circles import disc, overlap, row_extent, row_overlap
from epo_lightning.registry import ConfigError
from epo_lightning.scene import ACCELERATION, SPEED, TURN_RATE

Function = TypeVar("Function", bound=Callable[..., Tensor])

WHEELBASE = 0.6
"""Distance between the axles, as a share of a vehicle's length."""
SLOWEST_STEERING = 1.0
"""Speed [m/s] below which steering angles are those of this speed: a standing vehicle turns at no angle at all."""


class Source(Enum):
    """What a signal is read from, which fixes the structure of its Jacobian."""

    CONTROL = "control"
    """A control at its own step: diagonal."""
    RATE = "rate"
    """The rate of change of a control: bidiagonal."""
    SPEED = "speed"
    """The speed: every acceleration before it counts the same."""
    STEERING = "steering"
    """The turn rate and the speed before the step at which it acts."""
    POSITION = "position"
    """All positions: all controls before them count."""
    FINAL_POSITION = "final_position"
    """The last position: all controls of the agent count."""
    DISTANCE = "distance"
    """How far two agents are apart: the positions of both."""
    TRAJECTORY = "trajectory"
    """Undeclared: automatic differentiation finds out."""


@dataclass(frozen=True)
class OwnFeature:
    """One entry of c(u_i, g_i) in Eq. 10: a signal, and what is made of it.

    Attributes:
        source: where the signal comes from.
        signal: name of the signal, by which its bounds are given.
        channel: index of the control, for signals of controls.
        bounded: whether the feature is zero within the bounds.
        needs: what of scene and game the signal refers to: ``goals``, ``reference``, ``reference_speed``, ``size``.
        function: of the signal, elementwise; of states and controls where the source is TRAJECTORY.
    """

    source: Source
    signal: str
    channel: int = 0
    bounded: bool = False
    needs: str | None = None
    function: Callable[..., Tensor] | None = None


@dataclass(frozen=True)
class PairFeature:
    """One entry of d(u_i, u_j) in Eq. 11.

    Attributes:
        source: DISTANCE or TRAJECTORY.
        function: of distance and reach, elementwise; of the states of both agents where the source is TRAJECTORY, and of
            their sizes where it needs them.
        needs: ``size`` for a function of states that takes the agents' sizes too.
        stepwise: whether a function of states has one residual for every step, which reads the states at that step alone.
        extent: how far from its position an agent of some size can be felt [m]; None for a function that knows no limit.
    """

    source: Source
    function: Callable[..., Tensor]
    needs: str | None = None
    stepwise: bool = False
    extent: Callable[[Tensor], Tensor] | None = None

    @cached_property
    def asymmetry(self) -> tuple[float, float] | None:
        """What two agents cost in one order and in the other, where it is not the same; see :mod:`.symmetry`."""
        if self.source is Source.DISTANCE:
            return None
        return symmetry.difference(self.function, sizes=self.needs == "size")


def _with_bounds(features: Mapping[str, OwnFeature]) -> dict[str, OwnFeature]:
    bounded = {
        f"{name}b": OwnFeature(feature.source, feature.signal, feature.channel, bounded=True)
        for name, feature in features.items()
    }
    return {**features, **bounded}


OWN_FEATURES: dict[str, OwnFeature] = {
    "goal": OwnFeature(Source.FINAL_POSITION, "goal", needs="goals"),
    "lane": OwnFeature(Source.POSITION, "lane", needs="reference"),
    "velref": OwnFeature(Source.SPEED, "velref", needs="reference_speed"),
    "steer": OwnFeature(Source.STEERING, "steer", needs="size"),
    **_with_bounds(
        {
            "vel": OwnFeature(Source.SPEED, "vel"),
            "acc": OwnFeature(Source.CONTROL, "acc", ACCELERATION),
            "turnr": OwnFeature(Source.CONTROL, "turnr", TURN_RATE),
            "jerk": OwnFeature(Source.RATE, "jerk", ACCELERATION),
            "turnacc": OwnFeature(Source.RATE, "turnacc", TURN_RATE),
        }
    ),
}
"""Name to feature: goal [m]; lane, the way from the followed reference line [m]; vel, velref, the speed and what it exceeds
the reference speed by [m/s]; acc [m/s^2]; turnr [rad/s]; jerk [m/s^3]; turnacc [rad/s^2]; steer, the steering angle of a
vehicle that turns like this [rad]; ``...b`` for what bounds are exceeded by."""


PAIR_FEATURES: dict[str, PairFeature] = {
    "proximity": PairFeature(Source.DISTANCE, overlap, extent=disc),
    "circles": PairFeature(Source.TRAJECTORY, row_overlap, needs="size", stepwise=True, extent=row_extent),
}
"""``proximity``: max(0, r_i + r_j - |p_i - p_j|) [m], how deep two discs overlap; ``circles``: how deep two rows of circles
do [m] (:mod:`~epo_lightning.game.circles`)."""

_BUILT_IN = {*OWN_FEATURES, *PAIR_FEATURES}


def _refuse(name: str, source: Source, sources: tuple[Source, ...]) -> None:
    if name in _BUILT_IN:
        raise ConfigError(f"{name!r} is a built-in feature; choose another name")
    if not isinstance(source, Source):
        raise ConfigError(
            f"feature {name!r} is declared by a Source, such as Source.{sources[0].name}, not by {source!r}"
        )
    if source not in sources:
        raise ConfigError(
            f"feature {name!r} can be declared as one of {[s.name for s in sources]}, not as {source.name}"
        )


def own_feature(
    name: str, source: Source = Source.TRAJECTORY, channel: int = ACCELERATION
) -> Callable[[Function], Function]:
    """Make a function an own feature that energies can name.

    Args:
        name: how energies call it.
        source: CONTROL, RATE or SPEED for an elementwise function of that one signal; TRAJECTORY for any differentiable
            function of an agent's states [.., K, 4] and controls [.., K, 2], elementwise over all leading dimensions,
            that returns residuals [.., R].
        channel: ``ACCELERATION`` or ``TURN_RATE``, for signals of controls.

    Raises:
        ConfigError: the name of a built-in feature, or a source that functions cannot be declared with.
    """
    _refuse(name, source, (Source.CONTROL, Source.RATE, Source.SPEED, Source.TRAJECTORY))

    def add(function: Function) -> Function:
        OWN_FEATURES[name] = OwnFeature(source, name, channel, function=function)
        return function

    return add


def pair_feature(
    name: str, source: Source = Source.TRAJECTORY, needs: str | None = None
) -> Callable[[Function], Function]:
    """Make a function a pair feature that energies can name.

    Args:
        name: how energies call it.
        source: DISTANCE for an elementwise function of distance [.., K] and reach [.., 1], the sum of both radii;
            TRAJECTORY for any differentiable function of the states [.., K, 4] of the first and of the second agent,
            elementwise over all leading dimensions, that returns residuals [.., R]; energies refuse one whose sum of
            squares depends on who comes first. Either sees only the steps at which the energy evaluates pairs.
        needs: ``size`` for a function of states that takes the length and width [.., 1, 2] of the first and of the second
            agent too; those of absent agents are zero.

    Raises:
        ConfigError: the name of a built-in feature, a source that functions cannot be declared with, or another need.
    """
    _refuse(name, source, (Source.DISTANCE, Source.TRAJECTORY))
    if needs is not None and (needs != "size" or source is not Source.TRAJECTORY):
        raise ConfigError(
            f"pair feature {name!r} can need 'size' if it is a function of states (Source.TRAJECTORY), "
            f"not {needs!r} as {source.name}"
        )

    def add(function: Function) -> Function:
        PAIR_FEATURES[name] = PairFeature(source, function, needs)
        return function

    return add


@dataclass(frozen=True)
class Surroundings:
    """What own features refer to besides the trajectory; zero where an agent is absent, None where nothing is known.

    Attributes:
        initial: the states x_0.
        goals: where agents are heading.
        line: the reference lines that they follow.
        reference_speed: how fast they would like to be.
        wheelbase: distance between their axles.
    """

    initial: Float[Tensor, "B 1 N 4"]
    dt: float
    goals: Float[Tensor, "B M N 2"] | None = None
    line: Float[Tensor, "B M N Q 2"] | None = None
    reference_speed: Float[Tensor, "B 1 N"] | None = None
    wheelbase: Float[Tensor, "B 1 N"] | None = None


def foot(
    position: Float[Tensor, "*batch K 2"], line: Float[Tensor, "*#batch Q 2"]
) -> tuple[Float[Tensor, "*batch K 2"], Float[Tensor, "*batch K 2"]]:
    """The nearest point of a polyline, and how it slides: the segment's unit tangent, zero at the end of a segment.

    Differentiable with respect to the position; which segment is nearest is a constant, the first one on a tie.
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
    """The steering angle atan(L omega / max(v, 1 m/s)) [rad], and its slopes in omega and v."""
    floored = speed.clamp_min(SLOWEST_STEERING)
    curvature = wheelbase / floored
    tangent = curvature * turn_rate
    by_turn_rate = curvature / (1.0 + tangent.square())
    by_speed = torch.where(speed < SLOWEST_STEERING, 0.0, -by_turn_rate * turn_rate / floored)
    return tangent.atan(), by_turn_rate, by_speed


def steering_curvatures(
    turn_rate: Float[Tensor, "*batch K"], speed: Float[Tensor, "*batch K"], wheelbase: Float[Tensor, "*#batch 1"]
) -> tuple[Float[Tensor, "*batch K"], Float[Tensor, "*batch K"], Float[Tensor, "*batch K"]]:
    """Second derivatives of the steering angle: twice in omega, in omega and v, twice in v."""
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


def signal(
    feature: OwnFeature,
    states: Float[Tensor, "*batch K 4"],
    controls: Float[Tensor, "*batch K 2"],
    around: Surroundings,
) -> Float[Tensor, "*batch R"]:
    """The declared signal of a feature over time: R = K, K - 1 for rates, 2 K (x and y) for lines, 2 for goals."""
    match feature.source:
        case Source.CONTROL:
            return controls[..., feature.channel]
        case Source.RATE:
            return controls[..., feature.channel].diff(dim=-1) / around.dt
        case Source.SPEED if feature.needs:
            assert around.reference_speed is not None
            return states[..., SPEED] - around.reference_speed[..., None]
        case Source.SPEED:
            return states[..., SPEED]
        case Source.STEERING:
            assert around.wheelbase is not None
            before = speed_before(states, around.initial)
            return steering(controls[..., TURN_RATE], before, around.wheelbase[..., None])[0]
        case Source.POSITION:
            assert around.line is not None
            position = states[..., :2]
            return (position - foot(position, around.line)[0]).flatten(-2)
        case Source.FINAL_POSITION:
            assert around.goals is not None
            return states[..., -1, :2] - around.goals
    raise AssertionError(feature)


def signal_change(
    feature: OwnFeature,
    states: Float[Tensor, "*batch K 4"],
    controls: Float[Tensor, "*batch K 2"],
    moved: Float[Tensor, "D *batch K 4"],
    directions: Float[Tensor, "D *batch K 2"],
    around: Surroundings,
) -> Float[Tensor, "D *batch R"]:
    """How a declared signal changes as controls move along D directions and states therefore along ``moved``.

    The nearest point of a line stays where it is while an agent moves: a line pulls as stiffly along as across.
    """
    match feature.source:
        case Source.CONTROL:
            return directions[..., feature.channel]
        case Source.RATE:
            return directions[..., feature.channel].diff(dim=-1) / around.dt
        case Source.SPEED:
            return moved[..., SPEED]
        case Source.STEERING:
            assert around.wheelbase is not None
            before = speed_before(states, around.initial)
            _, by_turn_rate, by_speed = steering(controls[..., TURN_RATE], before, around.wheelbase[..., None])
            faster = speed_before(moved, torch.zeros_like(around.initial))
            return by_turn_rate * directions[..., TURN_RATE] + by_speed * faster
        case Source.POSITION:
            return moved[..., :2].flatten(-2)
        case Source.FINAL_POSITION:
            return moved[..., -1, :2]
    raise AssertionError(feature)


def slope(function: Callable[..., Tensor], value: Tensor, *others: Tensor) -> tuple[Tensor, Tensor]:
    """An elementwise function's value and its derivative with respect to the first argument, itself differentiable."""
    shaped, steepness = torch.func.jvp(
        lambda argument: function(argument, *others), (value,), (torch.ones_like(value),)
    )[:2]
    return shaped, steepness


def violation(
    value: Float[Tensor, "*shape"], lower: float, upper: float
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """How far a signal leaves [lower, upper], and the derivative of that: 1 above, -1 below, 0 within."""
    excess = (value - upper).clamp_min(0.0) + (lower - value).clamp_min(0.0)
    slope = (value > upper).to(value.dtype) - (value < lower).to(value.dtype)
    return excess, slope
