"""The vocabulary: what is observed, what is inferred, what is solved and what is forecast.

Shapes use one alphabet everywhere:

====  =========================  ======  ================================================================
B     scenes in a batch          P       pairs of agents i < j, P = N (N - 1) / 2
M     joint modes                G       goal candidates of an agent
N     agents                     X = 4   state: x, y [m], heading [rad], speed [m/s]
H     history steps              U = 2   control: acceleration [m/s^2], turn rate [rad/s]
K     future steps               S       optimisation steps
R     reference lines, residuals Q       points of a reference line
L     lane polylines             V       vectors of a lane polyline
====  =========================  ======  ================================================================
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

X, Y, HEADING, SPEED = range(4)
KINDS = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "other")
"""What agents can be; ``Scene.kind`` is an index into this."""
ACCELERATION, TURN_RATE = range(2)


Batch = TypeVar("Batch", bound="_Batch")


class _Batch:
    """Tensors that share their leading dimension B, moved and indexed together."""

    def map(self: Batch, function: Callable[[Tensor], Tensor]) -> Batch:
        """Apply ``function`` to every tensor, also inside mappings, tuples and batches within this one."""

        def visit(value: Any) -> Any:
            if isinstance(value, Tensor):
                return function(value)
            if isinstance(value, _Batch):
                return value.map(function)
            if isinstance(value, Mapping):
                return {key: visit(entry) for key, entry in value.items()}
            if isinstance(value, tuple):
                return tuple(visit(entry) for entry in value)
            return value

        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return type(self)(**{field.name: visit(getattr(self, field.name)) for field in fields})

    def to(self: Batch, target: torch.device | torch.dtype | str) -> Batch:
        """Move to a device, or convert the floating-point tensors to another precision."""
        if isinstance(target, torch.dtype):
            return self.map(lambda tensor: tensor.to(target) if tensor.is_floating_point() else tensor)
        return self.map(lambda tensor: tensor.to(target))

    def __getitem__(self: Batch, index: Any) -> Batch:
        """Choose scenes of the batch; an integer keeps the batch dimension."""
        if isinstance(index, int):
            index = [index]
        return self.map(lambda tensor: tensor[index])


@dataclass(frozen=True)
class Scene(_Batch):
    """What is known of B scenes: agents' histories, their sizes, and, while learning, their futures.

    Positions are in one fixed frame for the whole scene. Masks are True where an entry is real; whatever stands behind a
    False never influences a result. A mask that is left out means that everything is real.

    Attributes:
        history: states x, y [m], heading [rad], speed [m/s]; the last step is the current one, t0.
        dt: length of a time step [s].
        history_mask: which history steps were observed. An agent that is present is observed at t0.
        agent_mask: which agents exist.
        future: observed states after t0, the first one dt later; None when forecasting.
        future_mask: which future steps were observed.
        goal_candidates: positions [m] that an agent may be heading for; G = 1 where the goal is given (RPI).
        goal_mask: which candidates exist.
        goal_reference: index of the reference line on which each candidate lies.
        size: length and width [m].
        kind: what an agent is, an index into :data:`KINDS`.
        lanes: the map, as polylines of vectors from one point of a lane to the next: x, y of both [m].
        lane_mask: which of these vectors exist.
        references: lines that an agent may follow, as points [m] (lane centres); a line with fewer points repeats its
            last one.
        reference_mask: which of these lines exist.
        reference_speed: the speed at which an agent would like to travel [m/s].
        frame: origin x, y [m] and rotation [rad] that lead back to the recording's coordinates:
            world = R(rotation) position + origin.
        subset: index of the named subset of the data that the future belongs to (RPI: executed 0, alternative 1).
        id: which record of its data set a scene is.

    Raises:
        ValueError: a shape that does not fit the history, or a time step that is not positive.
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

    def __post_init__(self) -> None:
        if self.history.dim() != 4 or self.history.shape[-1] != 4:
            raise ValueError(
                f"scene.history has shape {list(self.history.shape)}; it takes [B, N, H, 4]: x, y, heading, speed"
            )
        if self.history.shape[2] == 0:
            raise ValueError("scene.history has no step; the last one is the current state, t0")
        for name in ("history_mask", "agent_mask", "future_mask", "goal_mask", "lane_mask", "reference_mask"):
            mask = getattr(self, name)
            if mask is not None and mask.dtype != torch.bool:
                raise ValueError(
                    f"scene.{name} is of type {mask.dtype}; masks are torch.bool, True where an entry is real"
                )
        if not self.dt > 0:
            raise ValueError(f"scene.dt must be positive, not {self.dt}")
        batch, agents, steps, _ = self.history.shape
        for name, shape in (
            ("history_mask", (batch, agents, steps)),
            ("agent_mask", (batch, agents)),
            ("size", (batch, agents, 2)),
            ("kind", (batch, agents)),
            ("reference_speed", (batch, agents)),
            ("frame", (batch, 3)),
        ):
            given = getattr(self, name)
            if given is not None and given.shape != shape:
                raise ValueError(f"scene.{name} has shape {list(given.shape)}; this history takes {list(shape)}")
        if self.lanes is not None and (self.lanes.dim() != 4 or len(self.lanes) != batch or self.lanes.shape[-1] != 4):
            raise ValueError(f"scene.lanes has shape {list(self.lanes.shape)}; this history takes [{batch}, L, V, 4]")
        for name, of in (
            ("goal_mask", "goal_candidates"),
            ("goal_reference", "goal_candidates"),
            ("lane_mask", "lanes"),
        ):
            given, owner = getattr(self, name), getattr(self, of)
            if given is not None and (owner is None or given.shape != owner.shape[:-1]):
                takes = "None" if owner is None else f"of shape {list(owner.shape)}"
                raise ValueError(f"scene.{name} has shape {list(given.shape)}, but scene.{of} is {takes}")
        lines = self.references
        if lines is not None and (
            lines.dim() != 5 or lines.shape[:2] != (batch, agents) or lines.shape[3] < 2 or lines.shape[4] != 2
        ):
            expected = f"[{batch}, {agents}, R, Q, 2] with Q of at least 2 points"
            raise ValueError(f"scene.references has shape {list(lines.shape)}; this history takes {expected}")
        if self.reference_mask is not None:
            if lines is None:
                raise ValueError("scene.reference_mask says which of scene.references exist, which is None")
            if self.reference_mask.shape != lines.shape[:3]:
                given = list(self.reference_mask.shape)
                raise ValueError(
                    f"scene.reference_mask has shape {given}; these references take {list(lines.shape[:3])}"
                )

        def default(name: str, shape: torch.Size) -> None:
            if getattr(self, name) is None:
                object.__setattr__(self, name, torch.ones(shape, dtype=torch.bool, device=self.history.device))

        default("history_mask", self.history.shape[:-1])
        default("agent_mask", self.history.shape[:2])
        if self.future is not None:
            default("future_mask", self.future.shape[:-1])
        if self.goal_candidates is not None:
            default("goal_mask", self.goal_candidates.shape[:-1])
        if self.lanes is not None:
            default("lane_mask", self.lanes.shape[:-1])
        if lines is not None:
            default("reference_mask", lines.shape[:-2])

    @property
    def current(self) -> Float[Tensor, "B N 4"]:
        """The states at t0."""
        return self.history[:, :, -1]

    @property
    def finite(self) -> Bool[Tensor, " B"]:
        """Which scenes hold finite numbers wherever their masks say that an entry is real."""

        def sound(values: Tensor | None, mask: Tensor | None) -> Tensor:
            if values is None:
                return torch.ones(len(self.history), dtype=torch.bool, device=self.history.device)
            bad = ~values.isfinite().all(-1)
            bad &= self.agent_mask.view(*self.agent_mask.shape, *[1] * (bad.dim() - 2))
            return ~(bad if mask is None else bad & mask).flatten(1).any(1)

        return (
            sound(self.history, self.history_mask)
            & sound(self.future, self.future_mask)
            & sound(self.goal_candidates, self.goal_mask)
            & sound(self.size, None)
            & sound(None if self.references is None else self.references.flatten(3), self.reference_mask)
            & sound(None if self.reference_speed is None else self.reference_speed[..., None], None)
            & self._finite_lanes
        )

    @property
    def _finite_lanes(self) -> Bool[Tensor, " B"]:
        if self.lanes is None:
            return torch.ones(len(self.history), dtype=torch.bool, device=self.history.device)
        return (self.lanes.isfinite().all(-1) | ~self.lane_mask).flatten(1).all(1)  # type: ignore[operator]


@dataclass(frozen=True)
class GameParameters(_Batch):
    """The game that the network infers for every scene and mode (Section 4.2), p = (w, g), and where its solution starts.

    Attributes:
        own_weights: weight of each named feature of an agent; enters the energy squared.
        pair_weights: weight of each named feature of a pair i < j, in the order of ``torch.triu_indices(N, N, 1)``.
        goals: where each agent is heading [m]; None for energies without a goal feature.
        initial_controls: the strategies from which the solver starts, one for every mode; or between which it chooses, any
            number C of them.
        reference: index of the reference line that an agent follows, the one its goal lies on; None for energies without a
            lane feature.
        context: features z of the agents, for energies that are networks.
        order: +1 or -1 for every pair i < j, on which side of each other they pass or who goes first, for energies that are
            convex given the order.
    """

    own_weights: Mapping[str, Float[Tensor, "B M N"]]
    pair_weights: Mapping[str, Float[Tensor, "B M P"]]
    initial_controls: Float[Tensor, "B _ N K 2"]
    goals: Float[Tensor, "B M N 2"] | None = None
    reference: Int[Tensor, "B M N"] | None = None
    context: Float[Tensor, "B N D"] | None = None
    order: Float[Tensor, "B M P"] | None = None

    def for_modes(self, modes: int) -> GameParameters:
        """These games for M modes: one game becomes that of them all. Initial strategies stay as they are."""

        def widen(tensor: Tensor | None) -> Tensor | None:
            return None if tensor is None else tensor.expand(-1, modes, *tensor.shape[2:])

        return dataclasses.replace(
            self,
            own_weights={name: weight.expand(-1, modes, -1) for name, weight in self.own_weights.items()},
            pair_weights={name: weight.expand(-1, modes, -1) for name, weight in self.pair_weights.items()},
            goals=widen(self.goals),
            reference=widen(self.reference),
            order=widen(self.order),
        )


class Status(IntEnum):
    """How the minimisation of one scene and mode went."""

    SOLVED = 0
    """Every step was taken as the method defines it."""
    DAMPED = 1
    """A factorisation succeeded with more damping only, or steps were shortened."""
    STOPPED = 2
    """A step could not be taken and the last good iterate was kept; or an implicit gradient was asked for where the Hessian
    is not positive definite."""


@dataclass(frozen=True)
class Tables(_Batch):
    """Energies of C candidate strategies of every agent, and the density p(k) = exp(-E(k)) / Z over who takes which.

    Attributes:
        states: the candidates; agents' candidates of one number do not belong together.
        unary: E_i of every candidate.
        pair: E_ij of every two candidates, (k, l) for i's k-th and j's l-th, pairs in the order of ``torch.triu_indices``.
        log_marginals: log p(k_i), exact or as sum-product finds them; zero for absent agents' first candidate.
        log_partition: log Z, exact or Bethe's approximation.
    """

    states: Float[Tensor, "B C N K 4"]
    unary: Float[Tensor, "B N C"]
    pair: Float[Tensor, "B P C C"]
    log_marginals: Float[Tensor, "B N C"]
    log_partition: Float[Tensor, " B"]


@dataclass(frozen=True)
class Solution(_Batch):
    """Joint strategies that a solver found, and how well.

    Attributes:
        controls: joint strategies u.
        states: the states x_1 .. x_K that they lead to.
        initial_energy, energy: E at the initial strategies and at ``controls``.
        gradient_norm: Euclidean norm of dE/du at ``controls``.
        status: a :class:`Status` per scene and mode.
        iterates: u_0 .. u_S, when asked for.
        tables: of the candidates, for solvers that choose among some; the joint modes are then the most likely choices.
        assignment: which candidates these are, where the joint modes are choices among those of ``tables``.
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


@dataclass(frozen=True)
class Equilibrium(_Batch):
    """How close the most likely joint mode of a forecast is to an open-loop Nash equilibrium of its game.

    Attributes:
        initial, energy: E at the strategies from which the solver started, and at the forecast.
        optimum: E at the local minimum that a tightly converged descent from the forecast leads to; never above ``energy``.
            NaN where the energy, or the objective of one agent, was given up while it was still falling: energies that are
            networks need not have a minimum.
        gradient_norm: Euclidean norm of dE/du at the forecast; NaN where strategies are chosen among candidates.
        nash_gap: what each agent could gain by changing its strategy alone, to a local best response; zero where absent,
            NaN where ``optimum`` is.
        objective: J_i, what each agent minimises, at the forecast; zero where absent, NaN where it has no natural zero.
    """

    initial: Float[Tensor, " B"]
    energy: Float[Tensor, " B"]
    optimum: Float[Tensor, " B"]
    gradient_norm: Float[Tensor, " B"]
    nash_gap: Float[Tensor, "B N"]
    objective: Float[Tensor, "B N"]


@dataclass(frozen=True)
class JointForecast(_Batch):
    """M joint futures of all agents of a scene and their probabilities.

    Attributes:
        states: futures; agents of one mode belong together.
        probabilities: of the joint modes; sum to one, zero for modes that repeat an earlier one.
        agent_probabilities: of each agent's own modes, for forecasters that are marginal (per agent); the joint modes
            are then ordered so that mode m is everyone's m-th most likely one.
        controls: the strategies behind ``states``, where the forecaster has any.
        initial_states: the futures of the strategies from which the solver started.
        parameters: the inferred game.
        solution: how the game was solved.
        goal_probabilities: of each agent's goal candidates, for forecasters that choose among them.
        order_logits: of every pair's order being +1, zero where it does not matter; for forecasters whose modes are orders.
        own_energy: energy by feature and agent at the solution.
        pair_energy: energy by feature and pair at the solution.
        equilibrium: how close the most likely mode is to an equilibrium, where that was asked for.
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
