"""The inferred game, its solution and the joint forecast: what is computed from a scene, in that order.

The letters of shapes are those of :mod:`epo_lightning.scene`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.batch import Batch


@dataclass(frozen=True, repr=False)
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

    def __post_init__(self) -> None:
        # Types alone, so that a first mistake on plain tensors has a message; energies check shapes and names.
        for field in dataclasses.fields(self):
            value, name = getattr(self, field.name), f"parameters.{field.name}"
            if field.name in ("own_weights", "pair_weights", "margins"):
                if not hasattr(value, "items"):
                    raise TypeError(f"{name} is a {type(value).__name__}; it takes a tensor for each feature")
                if not isinstance(value, Mapping):  # such as a ParameterDict of PyTorch
                    object.__setattr__(self, field.name, dict(value.items()))
                for feature, tensor in value.items():
                    _check_tensor(f"{name}[{feature!r}]", tensor)
            elif value is not None or field.default is dataclasses.MISSING:
                _check_tensor(name, value)

    def without_pairs(self) -> GameParameters:
        """The same games with pair weights of zero, in which no agent reacts to another one."""
        alone = {name: torch.zeros_like(weight) for name, weight in self.pair_weights.items()}
        return dataclasses.replace(self, pair_weights=alone)

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


def _check_tensor(name: str, value: Any) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is a {type(value).__name__}; it takes a tensor: convert it with torch.as_tensor")


class Status(IntEnum):
    """Outcome of the minimisation of one scene and mode."""

    COMPLETED = 0
    """All steps were taken, with the configured damping and step size. It does not mean that the solver has converged."""
    DAMPED = 1
    """A factorisation succeeded only with more damping, or steps were shortened; or the LQ games of ``solver=feedback`` have
    not converged, so that the solution has no derivative."""
    STOPPED = 2
    """A step could not be taken and the last good iterate was kept; or an implicit gradient was requested where the Hessian
    is not positive definite."""


@dataclass(frozen=True, repr=False)
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


@dataclass(frozen=True, repr=False)
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


@dataclass(frozen=True, repr=False)
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

    def continued_by(self, last: Solution) -> Solution:
        """This solution after further steps, which begin at its controls and end at ``last``.

        A problem that was STOPPED before and moved in these steps is DAMPED.
        """
        return dataclasses.replace(
            last,
            initial_energy=self.initial_energy,
            status=torch.maximum(self.status.clamp_max(Status.DAMPED), last.status),
            iterates=(*self.iterates, *last.iterates[1:]) if self.iterates and last.iterates else None,
        )


@dataclass(frozen=True, repr=False)
class Equilibrium(Batch):
    """Distance of a forecast's most likely joint mode from an open-loop Nash equilibrium of its game.

    Attributes:
        initial_energy, energy: E at the strategies from which the solver started, and at the forecast.
        optimum: E at the local minimum that a descent from the forecast reaches; never above ``energy``. NaN if the
            energy, or one agent's objective, was still falling when its descent ended: energies that are networks may
            have no minimum.
        gradient_norm: Euclidean norm of dE/du at the forecast; NaN where strategies are chosen among candidates.
        nash_gap: decrease of J_i when agent i alone changes to a local best response; zero for absent agents, NaN where
            ``optimum`` is NaN.
        objective: J_i, the agent's own objective, at the forecast; zero for absent agents. NaN for energies that are not
            sums of squares: their zero is arbitrary, so a gap relative to it means nothing.
    """

    initial_energy: Float[Tensor, " B"]
    energy: Float[Tensor, " B"]
    optimum: Float[Tensor, " B"]
    gradient_norm: Float[Tensor, " B"]
    nash_gap: Float[Tensor, "B N"]
    objective: Float[Tensor, "B N"]


@dataclass(frozen=True, repr=False)
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


DISTINCT = 0.1
"""Distance [m] from which on two joint motions are different: that of some agent's positions at some step."""


def same_motion(states: Float[Tensor, "B M N K _"]) -> Bool[Tensor, "B M M"]:
    """Whether two joint motions of a scene are the same, to less than :data:`DISTINCT`.

    Args:
        states: motions, x and y [m] first; a motion that is not finite is the same as no other one.
    """
    positions = states[..., :2]
    apart = (positions[:, :, None] - positions[:, None]).norm(dim=-1)
    return (apart < DISTINCT).flatten(3).all(-1)
