"""The named features of an energy: quantities that an agent, or a pair of agents, tries to keep small.

An own feature is a function of a *signal*. A signal is a quantity of one trajectory: a control, its rate of change, the
speed, the steering angle, or the offset from a line or a goal. The feature is the signal itself, or the amount by which it
leaves its bounds (names that end in ``b``; the paper's soft constraints max(0, g(z))), or a custom elementwise function.

A pair feature is an elementwise function of the distance between two agents and of their *reach*, the sum of their radii, or
any function of their states and sizes.

Every feature declares its *source*, the quantity from which its signal is computed. The source fixes the structure of the
Jacobian, and solvers need to know nothing else about a feature (:mod:`~epo_lightning.game.feature_derivatives`). A custom
feature may be undeclared: any differentiable function of the trajectory works, but more slowly::

    @own_feature("latacc")                                    # [.., K, 4], [.., K, 2] -> [.., R]
    def latacc(states, controls):
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
from typing import Any, TypeVar

from torch import Tensor

from epo_lightning.game import symmetry, trials
from epo_lightning.game.circles import disc, overlap, row_extent, row_overlap
from epo_lightning.game.vehicles import half_sizes, headway, lateral, longitudinal, time_to_conflict
from epo_lightning.registry import ConfigError, place
from epo_lightning.scene import ACCELERATION, TURN_RATE

Function = TypeVar("Function", bound=Callable[..., Tensor])

TARGETS = ("goals", "goal_headings", "reference_controls")
"""What features compare trajectories with: fields of the parameters of a game by which, as by weights and margins, its
solutions are differentiable."""
WHEELBASE = 0.6
"""Distance between the axles, as a fraction of a vehicle's length."""
SLOWEST_STEERING = 1.0
"""Lower bound on the speed [m/s] in the steering angle, which is undefined for a standing vehicle."""


class Source(Enum):
    """Quantity from which the signal of a feature is computed; it fixes the structure of the signal's Jacobian."""

    CONTROL = "control"
    """A control at every step: the Jacobian is diagonal."""
    RATE = "rate"
    """The rate of change of a control: the Jacobian is bidiagonal."""
    SPEED = "speed"
    """The speed: its derivative is dt by every earlier acceleration."""
    STEERING = "steering"
    """The steering angle: it depends on the turn rate of a step and on the speed before that step."""
    POSITION = "position"
    """All positions: each depends on all earlier controls."""
    FINAL_POSITION = "final_position"
    """The last position: it depends on all controls of the agent."""
    FINAL_HEADING = "final_heading"
    """The last heading: it is the sum of all turn rates."""
    DISTANCE = "distance"
    """The distance between two agents: it depends on the positions of both."""
    STEP = "step"
    """States and controls of single steps, with one residual per step: its few derivatives, by the state after the step and
    by the control of the step, are found by automatic differentiation."""
    TRAJECTORY = "trajectory"
    """Undeclared: the Jacobian is found by automatic differentiation."""


@dataclass(frozen=True)
class OwnFeature:
    """One entry of c(u_i, g_i) in Eq. 10: a signal, and a function of it.

    Attributes:
        source: quantity from which the signal is computed.
        signal: name of the signal, the key of its bounds in ``energy.bounds``.
        channel: index of the control, for signals of controls.
        bounded: whether the feature is zero within the bounds.
        needs: further input of the signal: ``goals``, ``goal_headings``, ``reference``, ``reference_speed``,
            ``reference_controls``, ``size``; None for no other input.
        function: elementwise function of the signal, or of states and controls for the sources STEP and TRAJECTORY.
    """

    source: Source
    signal: str
    channel: int = 0
    bounded: bool = False
    needs: str | None = None
    function: Callable[..., Tensor] | None = None

    @property
    def declared(self) -> bool:
        """Whether the feature is a function of a known signal, so that the Jacobian is known in closed form."""
        return self.source not in (Source.STEP, Source.TRAJECTORY)

    @property
    def of_control_or_state(self) -> bool:
        """Whether every residual depends on the control or on the next state of a single time step, and not on both."""
        return self.source not in (Source.RATE, Source.STEERING, Source.STEP, Source.TRAJECTORY)

    @property
    def linear(self) -> bool:
        """Whether the signal is linear in the controls of one channel."""
        return self.source in (Source.CONTROL, Source.RATE, Source.SPEED)

    @cached_property
    def flaw(self) -> str | None:
        """Reason why the function is of no use (:mod:`~epo_lightning.game.trials`); None where nothing is wrong."""
        if self.function is None:
            return None
        if self.declared:
            takes = "It takes one signal [.., K] and returns a value for each of its values, [.., K]"
            return trials.flaw(self.function, [trials.numbers()], [], takes)
        states, _ = trials.agents()[0]
        stepwise = self.source is Source.STEP
        takes = f"It takes states [.., K, 4] and controls [.., K, 2] and returns {_residuals(stepwise)}"
        return trials.flaw(self.function, [states, trials.numbers(2)], [], takes, stepwise)


@dataclass(frozen=True)
class PairFeature:
    """One entry of d(u_i, u_j) in Eq. 11.

    Attributes:
        source: DISTANCE, STEP or TRAJECTORY.
        function: elementwise function of distance and reach; for the sources STEP and TRAJECTORY, function of the states of
            both agents, and of their sizes if it needs them.
        needs: ``size`` for a function of states that takes the agents' sizes too.
        extent: function from an agent's size to the radius [m] around its position within which it can affect others,
            besides a margin; None if there is no limit.
        margin: whether the feature takes a margin, an additional distance [m] of every pair: it is added to the reach, or
            is the last argument of a function of states.
    """

    source: Source
    function: Callable[..., Tensor]
    needs: str | None = None
    extent: Callable[[Tensor], Tensor] | None = None
    margin: bool = False

    @property
    def declared(self) -> bool:
        """Whether the feature is a function of the distance, so that its Jacobian is known in closed form."""
        return self.source is Source.DISTANCE

    @property
    def stepwise(self) -> bool:
        """Whether a function of states returns one residual per step, which depends only on the states at that step."""
        return self.source is Source.STEP

    @cached_property
    def flaw(self) -> str | None:
        """Reason why the function is of no use (:mod:`~epo_lightning.game.trials`); None where nothing is wrong."""
        states, sizes = zip(*trials.agents(), strict=True)
        margin = [sizes[0][..., 0]] if self.margin else []
        if self.declared:
            takes = "It takes distances [.., K] and reaches [.., 1] and returns a value for each distance, [.., K]"
            return trials.flaw(self.function, [trials.numbers().abs()], [sizes[0][..., 0]], takes)
        with_sizes = " and sizes [.., 1, 2]" if self.needs else ""
        takes = (
            f"It takes the states [.., K, 4]{with_sizes} of two agents{' and a margin [.., 1]' if self.margin else ''} "
            f"and returns {_residuals(self.stepwise)}"
        )
        return trials.flaw(self.function, states, [*(sizes if self.needs else ()), *margin], takes, self.stepwise)

    @cached_property
    def asymmetry(self) -> tuple[float, float] | None:
        """Costs of two trial agents in both orders (:mod:`~epo_lightning.game.symmetry`); None if the costs are equal."""
        if self.declared:
            return None
        return symmetry.difference(self.function, sizes=self.needs == "size", margin=self.margin)


def _residuals(stepwise: bool) -> str:
    """Words for what a function of trajectories returns, in messages."""
    return "one residual per step, [.., K]" if stepwise else "residuals [.., R]; a single one is [.., 1]"


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
    "heading": OwnFeature(Source.FINAL_HEADING, "heading", needs="goal_headings"),
    "accref": OwnFeature(Source.CONTROL, "accref", ACCELERATION, needs="reference_controls"),
    "turnrref": OwnFeature(Source.CONTROL, "turnrref", TURN_RATE, needs="reference_controls"),
}
"""Own features by name: goal, the offset of the last position from the goal [m]; lane, the offset from the followed
reference line [m]; vel, the speed, and velref, the speed minus the reference speed [m/s]; acc [m/s^2]; turnr [rad/s]; jerk
[m/s^3]; turnacc [rad/s^2]; steer, the steering angle [rad]; heading, the last heading minus the one that is wanted at the
goal [rad], not wrapped to (-pi, pi]; accref and turnrref, acc and turnr minus those of the strategy that the agent would
choose by itself (``GameParameters.reference_controls``); ``...b``, the amount by which the signal leaves its bounds."""


def _of_vehicles(function: Callable[..., Tensor], extent: Callable[[Tensor], Tensor] | None = None) -> PairFeature:
    return PairFeature(Source.STEP, function, needs="size", extent=extent, margin=True)


PAIR_FEATURES: dict[str, PairFeature] = {
    "proximity": PairFeature(Source.DISTANCE, overlap, extent=disc),
    "clearance": PairFeature(Source.DISTANCE, overlap, extent=disc, margin=True),
    "circles": PairFeature(Source.STEP, row_overlap, needs="size", extent=row_extent),
    "headway": _of_vehicles(headway),
    "longitudinal": _of_vehicles(longitudinal, half_sizes),
    "lateral": _of_vehicles(lateral, half_sizes),
    "time_to_conflict": _of_vehicles(time_to_conflict),
}
"""Pair features by name: ``proximity``, max(0, r_i + r_j - |p_i - p_j|), the overlap of two discs [m]; ``clearance``,
max(0, r_i + r_j + m_ij - |p_i - p_j|), the same with a margin m_ij [m] (``GameParameters.margins`` or ``energy.margins``);
``circles``, the overlap of two rows of circles [m] (:mod:`~epo_lightning.game.circles`); ``headway``, ``longitudinal``,
``lateral``, ``time_to_conflict``, missing distances [m] of vehicles with margins (:mod:`~epo_lightning.game.vehicles`)."""

BUILT_IN = {*OWN_FEATURES, *PAIR_FEATURES}


def _refuse(kind: str, name: Any, source: Source, sources: tuple[Source, ...]) -> None:
    if not isinstance(name, str):
        own = getattr(name, "__name__", name)
        raise ConfigError(f'@{kind}_feature needs a name, as text: write @{kind}_feature("{own}") above the function')
    if name in BUILT_IN:
        raise ConfigError(f"{name!r} is a built-in feature; choose another name")
    if not isinstance(source, Source):
        raise ConfigError(
            f"source of feature {name!r} must be a Source, such as Source.{sources[0].name}, not {source!r}"
        )
    if source not in sources:
        raise ConfigError(
            f"feature {name!r} can be declared as one of {[s.name for s in sources]}, not as {source.name}"
        )


def _refuse_another(
    kind: str, name: str, taken: OwnFeature | PairFeature | None, function: Callable[..., Tensor]
) -> None:
    """Refuse a second function for a name, except one from the same module: a cell of a notebook may run again."""
    if taken is not None and taken.function is not None and taken.function.__module__ != function.__module__:
        places = f"{place(taken.function)} and {place(function)}"
        raise ConfigError(f"two {kind} features are called {name!r}, in {places}: rename one")


def own_feature(
    name: str, source: Source = Source.TRAJECTORY, channel: int = ACCELERATION
) -> Callable[[Function], Function]:
    """Decorator that registers a function as an own feature.

    Args:
        name: the feature's name in ``energy.own``.
        source: CONTROL, RATE or SPEED for an elementwise function of that one signal. STEP for a differentiable function
            from an agent's states [.., K, 4] and controls [.., K, 2] to residuals [.., K], where residual k depends on the
            entries k of both alone. TRAJECTORY for any differentiable function of both to residuals [.., R]. All of them
            work independently for all leading dimensions.
        channel: ``ACCELERATION`` or ``TURN_RATE``, for signals of controls.

    Raises:
        ConfigError: no name, the name of a built-in feature or of one in another module, or a source that custom functions
            cannot have.
    """
    _refuse("own", name, source, (Source.CONTROL, Source.RATE, Source.SPEED, Source.STEP, Source.TRAJECTORY))

    def add(function: Function) -> Function:
        _refuse_another("own", name, OWN_FEATURES.get(name), function)
        OWN_FEATURES[name] = OwnFeature(source, name, channel, function=function)
        return function

    return add


def pair_feature(
    name: str, source: Source = Source.TRAJECTORY, needs: str | None = None, margin: bool = False
) -> Callable[[Function], Function]:
    """Decorator that registers a function as a pair feature.

    Args:
        name: the feature's name in ``energy.pair``.
        source: DISTANCE for an elementwise function of distance [.., K] and reach [.., 1], the sum of both radii. STEP for a
            differentiable function from the states [.., K, 4] of the first and of the second agent to residuals [.., K],
            where residual k depends on the states k alone. TRAJECTORY for any differentiable function of the states to
            residuals [.., R]. All of them work independently for all leading dimensions. Energies refuse a function whose
            sum of squares changes when the two agents are swapped. K counts only the steps at which the energy evaluates
            pairs.
        needs: ``size`` for a function of states that also takes the lengths and widths [.., 1, 2] of the first and of the
            second agent, zero for absent agents.
        margin: whether pairs have a margin [m], decoded or fixed by ``energy.margins``. It is added to the reach; a function
            of states takes it as its last argument [.., 1].

    Raises:
        ConfigError: no name, the name of a built-in feature or of one in another module, a source that custom functions
            cannot have, or an unknown need.
    """
    _refuse("pair", name, source, (Source.DISTANCE, Source.STEP, Source.TRAJECTORY))
    if needs is not None and (needs != "size" or source is Source.DISTANCE):
        raise ConfigError(
            f"pair feature {name!r} can need 'size' if it is a function of states (Source.STEP or Source.TRAJECTORY), "
            f"not {needs!r} as {source.name}"
        )

    def add(function: Function) -> Function:
        _refuse_another("pair", name, PAIR_FEATURES.get(name), function)
        PAIR_FEATURES[name] = PairFeature(source, function, needs, margin=margin)
        return function

    return add
