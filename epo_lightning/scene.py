"""Data classes of the project: the observed scene, the inferred game, its solution and the forecast.

Letters in shapes (``game`` and ``solvers/gauss_newton`` state the few that they use otherwise):

====  ==========================  ======  ================================================================
B     scenes in a batch           P       pairs of agents i < j, P = N (N - 1) / 2
M     joint modes                 G       goal candidates of an agent
N     agents                      X = 4   state: x, y [m], heading [rad], speed [m/s]
H     history steps               U = 2   control: acceleration [m/s^2], turn rate [rad/s]
K     future steps                S       optimisation steps
R     reference lines, residuals  Q       points of a reference line
L     lane polylines              V       vectors of a lane polyline
C     candidate strategies        D       width of the features z
====  ==========================  ======  ================================================================
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from numbers import Real
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

X, Y, HEADING, SPEED = range(4)
KINDS = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "other")
"""Classes of agents; ``Scene.kind`` is an index into this tuple."""
ACCELERATION, TURN_RATE = range(2)
LARGEST_HEADING = 1e4
"""Largest size of a heading [rad]: beyond it, single precision has no digits left for a direction."""


def wrapped(turn: Tensor) -> Tensor:
    """The turn in [-pi, pi) that leads to the same direction as a difference of two headings [rad].

    Example:
        From just below pi to just above -pi, as recordings write headings:

        >>> wrapped(torch.tensor(-3.0 - 3.0))
        tensor(0.2832)
    """
    return torch.remainder(turn + math.pi, 2.0 * math.pi) - math.pi


Some = TypeVar("Some", bound="Batch")


class Batch:
    """A data class of tensors that share their leading dimension B; they are moved and indexed together."""

    def map(self: Some, function: Callable[[Tensor], Tensor]) -> Some:
        """A copy with ``function`` applied to every tensor, also inside nested mappings, tuples and batches."""

        def visit(value: Any) -> Any:
            if isinstance(value, Tensor):
                return function(value)
            if isinstance(value, Batch):
                return value.map(function)
            if isinstance(value, Mapping):
                return {key: visit(entry) for key, entry in value.items()}
            if isinstance(value, tuple):
                return tuple(visit(entry) for entry in value)
            return value

        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return type(self)(**{field.name: visit(getattr(self, field.name)) for field in fields})

    def to(self: Some, target: torch.device | torch.dtype | str) -> Some:
        """A copy on another device, or with its floating-point tensors in another precision."""
        if isinstance(target, torch.dtype):
            return self.map(lambda tensor: tensor.to(target) if tensor.is_floating_point() else tensor)
        return self.map(lambda tensor: tensor.to(target))

    def __getitem__(self: Some, index: Any) -> Some:
        """The chosen scenes of the batch; an integer keeps the batch dimension."""
        if isinstance(index, int):
            index = [index]
        return self.map(lambda tensor: tensor[index])


_FLOAT, _INTEGER, _MASK = "floating-point", "integer", "boolean"

FIELDS: Mapping[str, tuple[str, tuple[str | int, ...], str | None]] = {
    "history": (_FLOAT, ("B", "N", "H", 4), None),
    "history_mask": (_MASK, ("B", "N", "H"), None),
    "agent_mask": (_MASK, ("B", "N"), None),
    "future": (_FLOAT, ("B", "N", "K", 4), None),
    "future_mask": (_MASK, ("B", "N", "K"), "future"),
    "goal_candidates": (_FLOAT, ("B", "N", "G", 2), None),
    "goal_mask": (_MASK, ("B", "N", "G"), "goal_candidates"),
    "goal_reference": (_INTEGER, ("B", "N", "G"), "goal_candidates"),
    "size": (_FLOAT, ("B", "N", 2), None),
    "kind": (_INTEGER, ("B", "N"), None),
    "lanes": (_FLOAT, ("B", "L", "V", 4), None),
    "lane_mask": (_MASK, ("B", "L", "V"), "lanes"),
    "references": (_FLOAT, ("B", "N", "R", "Q", 2), None),
    "reference_mask": (_MASK, ("B", "N", "R"), "references"),
    "reference_speed": (_FLOAT, ("B", "N"), None),
    "frame": (_FLOAT, ("B", 3), None),
    "subset": (_INTEGER, ("B",), None),
    "id": (_INTEGER, ("B",), None),
    "goal_headings": (_FLOAT, ("B", "N", "G"), "goal_candidates"),
    "game_steps": (_INTEGER, ("B",), None),
}
"""For every tensor of a :class:`Scene`: number type, shape, and the field that it belongs to, which must be given too."""

_LEAST = {"H": (1, "step; the last one is the current state, t0"), "K": (1, "step"), "Q": (2, "points of each line")}
"""Smallest sizes of some dimensions, with the unit that error messages name."""


@dataclass(frozen=True)
class Scene(Batch):
    """A batch of B observed scenes: agents' histories and sizes, the map and, in training, the agents' futures.

    Positions are in one fixed frame for the whole scene. Masks are True where an entry is real and False for padding; the
    values of padding never influence a result. A mask that is left out means that every entry is real.

    Attributes:
        history: states x, y [m], heading [rad], speed [m/s]; the last step is the current one, t0.
        dt: length of a time step [s].
        history_mask: observed steps of the history. An agent that is present is observed at t0.
        agent_mask: agents that exist; the others are padding.
        future: observed states after t0, the first one dt later; None when forecasting.
        future_mask: observed steps of the future.
        goal_candidates: possible goal positions [m] of each agent; G = 1 where the goal is given (RPI).
        goal_mask: candidates that exist.
        goal_reference: index of the reference line on which each candidate lies.
        size: length and width [m].
        kind: class of each agent, an index into :data:`KINDS`.
        lanes: the map, as polylines of vectors from one point of a lane to the next: x, y of both [m].
        lane_mask: lane vectors that exist.
        references: lines that an agent may follow, as points [m] (lane centres); a line with fewer points repeats its
            last one.
        reference_mask: reference lines that exist.
        reference_speed: desired speed of each agent [m/s].
        frame: origin x, y [m] and rotation [rad] of the transformation back to the recording's coordinates:
            world = R(rotation) position + origin.
        subset: index of the named subset of the data that the future belongs to (RPI: executed 0, alternative 1;
            recorded data: calm 0, interactive 1).
        id: index of the scene's record in its data set.
        goal_headings: heading [rad] that an agent wants at each goal candidate, continuous with the agent's heading: it is
            not wrapped to (-pi, pi], so a difference of 2 pi is a full turn.
        game_steps: number of steps from t0 to the end of each scene's game. Controls after the end have no cost and no
            effect. A forecaster whose `game_horizon` is the forecast's removes these numbers. None if all games end
            with the last control.

    Raises:
        TypeError: a field that is not a tensor (numpy arrays included), or a time step that is not a number.
        ValueError: a shape or type of number that does not fit, or a time step that is not positive and finite.
    """

    history: Float[Tensor, "B N H 4"]
    dt: float
    history_mask: Bool[Tensor, "B N H"] = None  # type: ignore[assignment]  # filled in below
    agent_mask: Bool[Tensor, "B N"] = None  # type: ignore[assignment]
    future: Float[Tensor, "B N K 4"] | None = None
    future_mask: Bool[Tensor, "B N K"] | None = None
    goal_candidates: Float[Tensor, "B N G 2"] | None = None
    goal_mask: Bool[Tensor, "B N G"] | None = None
    goal_reference: Int[Tensor, "B N G"] | None = None
    size: Float[Tensor, "B N 2"] | None = None
    kind: Int[Tensor, "B N"] | None = None
    lanes: Float[Tensor, "B L V 4"] | None = None
    lane_mask: Bool[Tensor, "B L V"] | None = None
    references: Float[Tensor, "B N R Q 2"] | None = None
    reference_mask: Bool[Tensor, "B N R"] | None = None
    reference_speed: Float[Tensor, "B N"] | None = None
    frame: Float[Tensor, "B 3"] | None = None
    subset: Int[Tensor, " B"] | None = None
    id: Int[Tensor, " B"] | None = None
    goal_headings: Float[Tensor, "B N G"] | None = None
    game_steps: Int[Tensor, " B"] | None = None

    def __post_init__(self) -> None:
        # Only shapes and types are checked here; checking values would make the host wait for a GPU (`validate_values`).
        if not isinstance(self.dt, Real) or isinstance(self.dt, bool):
            raise TypeError(f"scene.dt is a {type(self.dt).__name__}; it takes a number of seconds")
        if not 0 < self.dt < math.inf:
            raise ValueError(f"scene.dt must be positive and finite [s], not {self.dt}")
        sizes: dict[str, int] = {}
        for name, (numbers, shape, owner) in FIELDS.items():
            value = getattr(self, name)
            if value is not None:
                if owner is not None and getattr(self, owner) is None:
                    raise ValueError(f"scene.{name} describes scene.{owner}, which is None: give both or neither")
                _check_tensor(name, value, numbers, shape, sizes)
            elif name == "history":
                raise TypeError("scene.history is None; it takes a tensor [B, N, H, 4]: x, y, heading, speed")

        for name, (numbers, shape, owner) in FIELDS.items():
            if numbers == _MASK and getattr(self, name) is None and (owner is None or getattr(self, owner) is not None):
                ones = torch.ones([sizes[str(dim)] for dim in shape], dtype=torch.bool, device=self.history.device)
                object.__setattr__(self, name, ones)

    def validate_values(self) -> None:
        """Refuse values that no forecaster can use. On a GPU, this check makes the host wait for the tensors.

        Raises:
            ValueError: a present agent that is not observed at t0, a heading without digits for a direction, a length or
                width that is not positive and finite, a kind that does not exist, or the index of a reference line that does
                not exist.
        """
        assert self.history_mask is not None
        bad = self.agent_mask & ~self.history_mask[..., -1]
        if bad.any():
            scene, agent = bad.nonzero()[0].tolist()
            raise ValueError(
                f"scene.history_mask[{scene}, {agent}, -1] is False; an agent that is there (agent_mask) is observed at t0"
            )
        bad = (self.history[..., HEADING].abs() > LARGEST_HEADING) & self.history_mask & self.agent_mask[..., None]
        if bad.any():
            scene, agent, step = bad.nonzero()[0].tolist()
            heading = float(self.history[scene, agent, step, HEADING])
            raise ValueError(
                f"scene.history[{scene}, {agent}, {step}] has the heading {heading:g} rad; headings are at most "
                f"{LARGEST_HEADING:g} in size"
            )
        if self.size is not None:
            bad = ~((self.size > 0) & self.size.isfinite()).all(-1) & self.agent_mask
            if bad.any():
                scene, agent = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"scene.size[{scene}, {agent}] is {self.size[scene, agent].tolist()}; length and width must be "
                    "positive and finite [m]"
                )
        if self.kind is not None:
            bad = ((self.kind < 0) | (self.kind >= len(KINDS))) & self.agent_mask
            if bad.any():
                scene, agent = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"scene.kind[{scene}, {agent}] is {int(self.kind[scene, agent])}; kinds are 0 to {len(KINDS) - 1}: "
                    f"{', '.join(KINDS)}"
                )
        if self.goal_reference is not None and self.references is not None:
            lines = self.references.shape[2]
            assert self.goal_mask is not None
            bad = (self.goal_reference < 0) | (self.goal_reference >= lines)
            bad &= self.goal_mask & self.agent_mask[..., None]
            if bad.any():
                at = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"scene.goal_reference{at} is {int(self.goal_reference[tuple(at)])}; scene.references holds the "
                    f"lines 0 to {lines - 1}"
                )

    @property
    def current(self) -> Float[Tensor, "B N 4"]:
        """The states at t0."""
        return self.history[:, :, -1]

    @property
    def finite(self) -> Bool[Tensor, " B"]:
        """Mask of the scenes whose real entries are all finite; padding is not checked."""
        result = torch.ones(len(self.history), dtype=torch.bool, device=self.history.device)
        references = None if self.references is None else self.references.flatten(3)
        speed = None if self.reference_speed is None else self.reference_speed[..., None]
        headings = None if self.goal_headings is None else self.goal_headings[..., None]
        for values, mask in (
            (self.history, self.history_mask),
            (self.future, self.future_mask),
            (self.goal_candidates, self.goal_mask),
            (headings, self.goal_mask),
            (self.size, None),
            (references, self.reference_mask),
            (speed, None),
        ):
            if values is not None:
                bad = ~values.isfinite().all(-1)
                bad &= self.agent_mask.view(*self.agent_mask.shape, *[1] * (bad.dim() - 2))
                result &= ~(bad if mask is None else bad & mask).flatten(1).any(1)
        if self.lanes is not None:
            assert self.lane_mask is not None
            result &= (self.lanes.isfinite().all(-1) | ~self.lane_mask).flatten(1).all(1)
        return result


def _check_tensor(name: str, value: Any, numbers: str, shape: tuple[str | int, ...], sizes: dict[str, int]) -> None:
    """Compare a field of a scene with its declared type and shape, and store the size of each dimension letter in ``sizes``.

    Raises:
        TypeError: not a tensor.
        ValueError: another type of number or another shape.
    """
    if not isinstance(value, Tensor):
        given = type(value)
        raise TypeError(f"scene.{name} is a {given.__module__}.{given.__qualname__}; convert it with torch.as_tensor")
    kind = "boolean" if value.dtype == torch.bool else "floating-point" if value.is_floating_point() else "integer"
    if kind != numbers:
        hint = "; masks are torch.bool, True where an entry is real" if numbers == _MASK else ""
        raise ValueError(f"scene.{name} is of type {value.dtype}, expected {numbers} numbers{hint}")
    expected = [sizes.get(dim, dim) if isinstance(dim, str) else dim for dim in shape]
    fits = value.dim() == len(expected) and all(
        isinstance(want, str) or want == got for want, got in zip(expected, value.shape, strict=True)
    )
    if not fits:
        words = ", ".join(map(str, expected))
        raise ValueError(f"scene.{name} has shape {list(value.shape)}; this scene takes [{words}]")
    for dim, got in zip(shape, value.shape, strict=True):
        least, unit = _LEAST.get(str(dim), (0, ""))
        if got < least:
            raise ValueError(f"scene.{name} has shape {list(value.shape)}; it takes at least {least} {unit}")
        if isinstance(dim, str):
            sizes[dim] = got


@dataclass(frozen=True)
class GameParameters(Batch):
    """The inferred game of every scene and mode (Section 4.2), p = (w, g), and the strategies at which its solver starts.

    Attributes:
        own_weights: weight of each named feature of an agent; the energy squares it.
        pair_weights: weight of each named feature of a pair i < j, in the order of ``torch.triu_indices(N, N, 1)``.
        goals: goal position of each agent [m]; None for energies without a goal feature.
        initial_controls: the strategies from which the solver starts, one for every mode; or any number C of candidate
            strategies, for solvers that choose among candidates.
        reference: index of the reference line that an agent follows, the one its goal lies on; None for energies without a
            lane feature.
        context: features z of the agents, for energies that are networks.
        order: +1 or -1 for every pair i < j: the side on which they pass, or the agent that goes first
            (:mod:`~epo_lightning.game.pair_order`). None for energies without orders.
        goal_headings: heading [rad] wanted at the goal, continuous with the agent's heading (not wrapped); None for scenes
            without goal headings.
        margins: additional distance [m] that a pair keeps, >= 0, by name of the pair feature.
        reference_controls: controls that an agent would choose by itself, for energies in which a deviation from them has a
            cost.
    """

    own_weights: Mapping[str, Float[Tensor, "B M N"]]
    pair_weights: Mapping[str, Float[Tensor, "B M P"]]
    initial_controls: Float[Tensor, "B _ N K 2"]
    goals: Float[Tensor, "B M N 2"] | None = None
    reference: Int[Tensor, "B M N"] | None = None
    context: Float[Tensor, "B N D"] | None = None
    order: Float[Tensor, "B M P"] | None = None
    goal_headings: Float[Tensor, "B M N"] | None = None
    margins: Mapping[str, Float[Tensor, "B M P"]] = dataclasses.field(default_factory=dict)
    reference_controls: Float[Tensor, "B M N K 2"] | None = None

    def for_every_mode(self, modes: int) -> GameParameters:
        """The same games for M modes: a single game is repeated for all of them. Initial strategies stay unchanged."""

        def widen(tensor: Tensor | None) -> Tensor | None:
            return None if tensor is None else tensor.expand(-1, modes, *tensor.shape[2:])

        return dataclasses.replace(
            self,
            own_weights={name: weight.expand(-1, modes, -1) for name, weight in self.own_weights.items()},
            pair_weights={name: weight.expand(-1, modes, -1) for name, weight in self.pair_weights.items()},
            goals=widen(self.goals),
            reference=widen(self.reference),
            order=widen(self.order),
            goal_headings=widen(self.goal_headings),
            margins={name: margin.expand(-1, modes, -1) for name, margin in self.margins.items()},
            reference_controls=widen(self.reference_controls),
        )


class Status(IntEnum):
    """Outcome of the minimisation of one scene and mode."""

    SOLVED = 0
    """All steps were taken, with the configured damping and step size. It does not mean that the solver has converged."""
    DAMPED = 1
    """A factorisation succeeded only with more damping, or steps were shortened."""
    STOPPED = 2
    """A step could not be taken and the last good iterate was kept; or an implicit gradient was requested where the Hessian
    is not positive definite."""


@dataclass(frozen=True)
class Tables(Batch):
    """Energies of C candidate strategies per agent, and the density p(k) = exp(-E(k)) / Z over joint choices k.

    Attributes:
        states: states of the candidates; candidate k of one agent and candidate k of another one do not belong together.
        unary: E_i of every candidate.
        pair: E_ij of every two candidates: entry (k, l) is agent i's k-th with agent j's l-th; pairs in the order of
            ``torch.triu_indices``.
        log_marginals: log p(k_i), exact or from sum-product messages; zero for the first candidate of absent agents.
        log_partition: log Z, exact or Bethe's approximation.
    """

    states: Float[Tensor, "B C N K 4"]
    unary: Float[Tensor, "B N C"]
    pair: Float[Tensor, "B P C C"]
    log_marginals: Float[Tensor, "B N C"]
    log_partition: Float[Tensor, " B"]


@dataclass(frozen=True)
class Constraints(Batch):
    """Hard constraints h <= 0 of a solution, for solvers that have any.

    Attributes:
        multipliers: lambda >= 0 by constraint, for every pair or agent and step.
        penalty: mu of the last round.
        violation: the largest h, or zero where all constraints are met; [m] for pairs, the unit of the signal for bounds.
        rounds: number of updates of the multipliers.
    """

    multipliers: Mapping[str, Float[Tensor, "B M _ _"]]
    penalty: Float[Tensor, "B M"]
    violation: Float[Tensor, "B M"]
    rounds: Int[Tensor, "B M"]


@dataclass(frozen=True)
class Solution(Batch):
    """Joint strategies found by a solver, with their energy and status.

    Attributes:
        controls: joint strategies u.
        states: the states x_1 .. x_K that result from ``controls``.
        initial_energy, energy: E at the initial strategies and at ``controls``.
        gradient_norm: Euclidean norm of dE/du at ``controls``.
        status: a :class:`Status` per scene and mode.
        iterates: u_0 .. u_S, for solvers with ``keep_iterates``.
        tables: energies of the candidates, for solvers that choose among candidates; the joint modes are then the most
            likely choices.
        assignment: index of the candidate that each agent takes in each mode, for the same solvers.
        constraints: multipliers and violation of hard constraints, for solvers with any; ``gradient_norm`` is then that of
            the Lagrangian.
    """

    controls: Float[Tensor, "B M N K 2"]
    states: Float[Tensor, "B M N K 4"]
    initial_energy: Float[Tensor, "B M"]
    energy: Float[Tensor, "B M"]
    gradient_norm: Float[Tensor, "B M"]
    status: Int[Tensor, "B M"]
    iterates: tuple[Float[Tensor, "B M N K 2"], ...] | None = None
    tables: Tables | None = None
    assignment: Int[Tensor, "B M N"] | None = None
    constraints: Constraints | None = None


@dataclass(frozen=True)
class Equilibrium(Batch):
    """Distance of a forecast's most likely joint mode from an open-loop Nash equilibrium of its game.

    Attributes:
        initial, energy: E at the strategies from which the solver started, and at the forecast.
        optimum: E at the local minimum that a descent from the forecast reaches; never above ``energy``. NaN if the
            energy, or one agent's objective, was still falling when its descent ended: energies that are networks may
            have no minimum.
        gradient_norm: Euclidean norm of dE/du at the forecast; NaN where strategies are chosen among candidates.
        nash_gap: decrease of J_i when agent i alone changes to a local best response; zero for absent agents, NaN where
            ``optimum`` is NaN.
        objective: J_i, the agent's own objective, at the forecast; zero for absent agents. NaN for energies that are not
            sums of squares: their zero is arbitrary, so a gap relative to it means nothing.
    """

    initial: Float[Tensor, " B"]
    energy: Float[Tensor, " B"]
    optimum: Float[Tensor, " B"]
    gradient_norm: Float[Tensor, " B"]
    nash_gap: Float[Tensor, "B N"]
    objective: Float[Tensor, "B N"]


@dataclass(frozen=True)
class JointForecast(Batch):
    """M joint futures of all agents of a scene and their probabilities.

    Losses use ``log_probabilities``, computed from the logits where there are any: the gradient of a log-softmax does not
    vanish for very small probabilities.

    Attributes:
        states: futures; the agents of one mode belong together.
        probabilities: probabilities of the joint modes; they sum to one and are zero for modes that repeat an earlier one.
        agent_probabilities: each agent's probabilities of its own modes, for marginal forecasters; the joint modes are
            then ordered so that mode m consists of every agent's m-th most likely one.
        controls: the strategies behind ``states``, for forecasters that have any.
        initial_states: the futures of the strategies from which the solver started.
        parameters: the inferred game.
        solution: the solver's result.
        goal_probabilities: each agent's probabilities of its goal candidates, for forecasters that choose among them.
        order_logits: logit of p(order of the pair = +1), zero for pairs whose order does not matter; for forecasters whose
            modes are orders.
        own_energy: energy by feature and agent at the solution.
        pair_energy: energy by feature and pair at the solution.
        equilibrium: distance of the most likely mode from an equilibrium, where it was measured.
        states_without_pairs: solution of the same games from the same start, but without their pair terms, where it was
            computed.
        logits: unnormalised log-probabilities of the joint modes, of which ``probabilities`` are the softmax; -inf for
            modes that repeat an earlier one.
        agent_logits: the same for ``agent_probabilities``, over dimension 1.
        goal_logits: the same for ``goal_probabilities``, over the last dimension.
    """

    states: Float[Tensor, "B M N K 4"]
    probabilities: Float[Tensor, "B M"]
    agent_probabilities: Float[Tensor, "B M N"] | None = None
    controls: Float[Tensor, "B M N K 2"] | None = None
    initial_states: Float[Tensor, "B M N K 4"] | None = None
    parameters: GameParameters | None = None
    solution: Solution | None = None
    goal_probabilities: Float[Tensor, "B N G"] | None = None
    order_logits: Float[Tensor, "B P"] | None = None
    own_energy: Mapping[str, Float[Tensor, "B M N"]] | None = None
    pair_energy: Mapping[str, Float[Tensor, "B M P"]] | None = None
    equilibrium: Equilibrium | None = None
    states_without_pairs: Float[Tensor, "B M N K 4"] | None = None
    logits: Float[Tensor, "B M"] | None = None
    agent_logits: Float[Tensor, "B M N"] | None = None
    goal_logits: Float[Tensor, "B N G"] | None = None

    @property
    def log_probabilities(self) -> Float[Tensor, "B M"]:
        """Logarithms of ``probabilities``, for losses."""
        return log_probabilities(self.probabilities, self.logits, 1)

    @property
    def agent_log_probabilities(self) -> Float[Tensor, "B M N"] | None:
        """Logarithms of ``agent_probabilities``, for losses; None for forecasters without any."""
        if self.agent_probabilities is None:
            return None
        return log_probabilities(self.agent_probabilities, self.agent_logits, 1)

    @property
    def goal_log_probabilities(self) -> Float[Tensor, "B N G"] | None:
        """Logarithms of ``goal_probabilities``, for losses; None for forecasters without any."""
        if self.goal_probabilities is None:
            return None
        return log_probabilities(self.goal_probabilities, self.goal_logits, 2)


def log_probabilities(probabilities: Tensor, logits: Tensor | None, dim: int) -> Tensor:
    """Logarithms of probabilities, whose gradient does not vanish when a probability underflows.

    Args:
        probabilities: softmax of the logits.
        logits: unnormalised log-probabilities. Without any, a probability of zero counts as the smallest number.
        dim: dimension over which probabilities sum to one.
    """
    least = torch.finfo(probabilities.dtype).tiny
    logs = probabilities.clamp_min(least).log()
    if logits is None:
        return logs
    # For probabilities that are not tiny, both formulas are correct but differ in the last digit. The first one is used
    # there, so that the results of earlier versions are reproduced exactly.
    return torch.where(probabilities > math.sqrt(least), logs, logits.log_softmax(dim))
