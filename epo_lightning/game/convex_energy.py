"""An energy that is convex in the controls given the order of the agents: one solution for every order (TGL).

Geiger and Straehle (AAAI 2021) divide the strategies of two merging vehicles into subspaces, one for each order of merging,
such that the game has a single equilibrium in each. Here an order is a sign s_ij for every pair, and a decoder predicts the
likely orders (:mod:`epo_lightning.decoders.orders`). Differences from their game:

- Their order and forward motion are hard constraints, by a monotone parametrisation. Here the order is a penalty, a hinge
  that is zero where the order is kept by a distance, and driving backwards is possible.
- They have two vehicles in the frame of a lane. Here N agents move in the plane, and the distance of a pair is measured
  along a direction that the present states fix.
- Their distance term acts from the time of the merge on, which they predict. Here, with a ``lane`` width, it acts at the
  steps at which both agents would be in one lane if they went straight to the lateral positions of their goals.
- Their distance term -alpha / (0.1 + d^2) and smooth maximum at the end of the lane are left out, their desired speed is the
  scene's reference speed, and their lane centre is the line through the goal along the present heading.
- Their weights are made positive by elu(.) + 1 + 1e-5; here weights enter squared, accelerations across have a floor of
  1e-3, and the weight of accelerations along is held at 1, because the minimum does not depend on a common scale of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.checks import check_choice, check_number
from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import disc
from epo_lightning.game.double_integrator import DoubleIntegrator
from epo_lightning.game.energy import GRADIENT, RESIDUALS, Energy, check_names
from epo_lightning.game.pair_order import ALONG, DIRECTIONS, PairOrder
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import HEADING, SPEED, Scene, rotated

FLOOR = 1e-3
"""Added to the squared weight of lateral accelerations, so that the Hessian is positive definite also in float32."""


@dataclass(frozen=True)
class _Motion:
    """Inputs of the own residuals, along and across the heading at t0.

    Attributes:
        controls, velocity: accelerations, and the velocities that they lead to.
        to_goal: the offset from the goal; None without terms of goals.
        reference_speed: desired speed; None without a term of it.
    """

    controls: Float[Tensor, "B C N K 2"]
    velocity: Float[Tensor, "B C N K 2"]
    dt: float
    to_goal: Float[Tensor, "B C N K 2"] | None
    reference_speed: Float[Tensor, "B 1 N"] | None


def _goal(motion: _Motion) -> Tensor:
    assert motion.to_goal is not None
    return motion.to_goal[..., -1, :]


def _lateral(motion: _Motion) -> Tensor:
    assert motion.to_goal is not None
    return motion.to_goal[..., 1]


def _velref(motion: _Motion) -> Tensor:
    assert motion.reference_speed is not None
    return motion.velocity[..., 0] - motion.reference_speed[..., None]


_OWN: Mapping[str, tuple[Callable[[_Motion], Tensor], str | None]] = {
    "goal": (_goal, "goals"),
    "lateral": (_lateral, "goals"),
    "velref": (_velref, "reference_speed"),
    "lat_vel": (lambda motion: motion.velocity[..., 1], None),
    "acc": (lambda motion: motion.controls[..., 0], None),
    "lat_acc": (lambda motion: motion.controls[..., 1], None),
    "jerk": (lambda motion: motion.controls[..., 0].diff(dim=-1) / motion.dt, None),
    "lat_jerk": (lambda motion: motion.controls[..., 1].diff(dim=-1) / motion.dt, None),
}
"""Residuals [B, C, N, R] by name, with the input that they need."""


@dataclass(frozen=True)
class _Moves:
    """Matrices from K controls of one direction to controls, their rates, velocities and positions at all steps."""

    control: Float[Tensor, "K K"]
    rate: Float[Tensor, "_ K"]
    velocity: Float[Tensor, "K K"]
    position: Float[Tensor, "K K"]

    @staticmethod
    def of(dt: float, controls: Float[Tensor, "B M N K 2"]) -> _Moves:
        """The matrices of :class:`~epo_lightning.game.double_integrator.DoubleIntegrator`."""
        control = torch.eye(controls.shape[3], dtype=controls.dtype, device=controls.device)
        velocity = dt * control.cumsum(0)
        position = dt * (velocity.cumsum(0) - velocity)  # explicit Euler: a step's velocity moves the next one
        return _Moves(control, control.diff(dim=0) / dt, velocity, position)


def _curvature(
    ahead: Callable[[_Moves], Tensor] | None, aside: Callable[[_Moves], Tensor] | None
) -> Callable[[_Moves], Tensor]:
    """Second derivatives [2, K, K] of half the squares of linear residuals, by controls along and across."""

    def both(moves: _Moves) -> Tensor:
        rows = [torch.zeros_like(moves.control[:1]) if of is None else of(moves) for of in (ahead, aside)]
        return torch.stack([row.mT @ row for row in rows])

    return both


_CURVATURE: Mapping[str, Callable[[_Moves], Tensor]] = {
    "goal": _curvature(lambda moves: moves.position[-1:], lambda moves: moves.position[-1:]),
    "lateral": _curvature(None, lambda moves: moves.position),
    "velref": _curvature(lambda moves: moves.velocity, None),
    "lat_vel": _curvature(None, lambda moves: moves.velocity),
    "acc": _curvature(lambda moves: moves.control, None),
    "lat_acc": _curvature(None, lambda moves: moves.control),
    "jerk": _curvature(lambda moves: moves.rate, None),
    "lat_jerk": _curvature(None, lambda moves: moves.rate),
}
"""Second derivatives of own terms of weight one, by name."""


@register("energy", "convex")
@dataclass(frozen=True)
class ConvexEnergy(Energy):
    """Half the sum of squares of residuals that are linear in the controls, or hinges of linear residuals.

        E = 1/2 sum_i |w_i c(u_i)|^2 + 1/2 sum_{i<j} w_ij^2 sum_t a_t max(0, d_ij - s_ij n_ij . (p_i - p_j))^2

    Own terms: ``goal``, the offset of the last position from the goal [m]; ``lateral``, the offset from the goal across the
    heading at t0 at every step [m]; ``velref``, the velocity along this heading minus the reference speed [m/s];
    ``lat_vel``, the velocity across it [m/s]; ``acc`` and ``lat_acc``, the accelerations along and across it [m/s^2];
    ``jerk`` and ``lat_jerk``, their rates [m/s^3].

    The pair term ``order`` keeps a distance d_ij, half the sum of both lengths plus a gap, on one side: with s_ij = +1 agent
    i should be ahead of agent j in the direction n_ij, with -1 behind (:class:`~epo_lightning.game.pair_order.PairOrder`
    defines n_ij). a_t is 1 for the steps at which both agents would be near each other at constant velocity, and 0 for the
    others, because the order of agents that are far apart does not matter. With ``lane``, a_t is also 0 while the agents are
    farther apart than this across n_ij, on straight lines from their positions at t0 to their goals. a_t does not depend on
    the controls, so the energy stays convex.

    Attributes:
        own: names as above. ``acc`` (weight 1, not decoded) and ``lat_acc`` are mandatory: they make the energy strictly
            convex in every control, so that there is one solution.
        pair: ``["order"]``, or empty.
        gap: distance [m] to be kept in addition to half the lengths.
        direction: ``along`` or ``across``, the meaning of an order.
        within: distance [m] up to which agents are near each other.
        dynamics: a :class:`~epo_lightning.game.double_integrator.DoubleIntegrator`.
        lane: lateral distance [m] up to which agents are in one lane; None for no such condition. It needs goals.
    """

    offers = frozenset({GRADIENT, RESIDUALS})

    own: Sequence[str]
    pair: Sequence[str] = ("order",)
    gap: float = 1.0
    direction: str = ALONG
    within: float = 20.0
    dynamics: Any = field(default_factory=DoubleIntegrator)  # Any, so that others are refused below with a reason
    lane: float | None = None

    def __post_init__(self) -> None:
        check_names("own", self.own, _OWN, "term")
        check_names("pair", self.pair, ("order",), "term")
        if not {"acc", "lat_acc"} <= set(self.own):
            raise ConfigError(
                "energy.own of energy=convex must name acc and lat_acc: without them the solution is not unique"
            )
        check_choice("energy.direction", self.direction, DIRECTIONS)
        check_number("energy.gap [m]", self.gap, zero=True)
        check_number("energy.within [m]", self.within, finite=False)
        if self.lane is not None:
            check_number("energy.lane [m]", self.lane)
            if not self.goal_terms:
                raise ConfigError(
                    "energy.lane needs goals: name goal or lateral in energy.own, or set energy.lane to null"
                )
        if not isinstance(self.dynamics, DoubleIntegrator):
            raise ConfigError(
                f"energy=convex is convex only for linear dynamics: it needs dynamics=double_integrator, "
                f"not {type(self.dynamics).__name__}"
            )

    @property
    def weighted(self) -> tuple[Sequence[str], Sequence[str]]:
        return [name for name in self.own if name != "acc"], self.pair

    @cached_property
    def needs(self) -> set[str]:
        of_agents = {what for name in self.own if (what := _OWN[name][1])}
        return of_agents | ({"size", "order"} if self.pair else set())

    @property
    def goal_terms(self) -> set[str]:
        """Names of the terms of goals."""
        return {name for name in self.own if _OWN[name][1] == "goals"}

    @cached_property
    def pair_order(self) -> PairOrder | None:
        """The order that pairs keep; None without the pair term."""
        return PairOrder(self.direction, self.within) if self.pair else None

    def residuals(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> dict[str, Float[Tensor, "B M _ _"]]:
        """Weighted residuals by term: [B, M, N, R] for agents, R being K, K - 1 or 2, and [B, M, P, K] for pairs.

        Absent agents have residuals of zero.

        Raises:
            ValueError: shapes or names of scene, parameters and controls that do not fit together.
        """
        self.validate(scene, parameters, controls)
        controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
        states = self.dynamics.rollout(self.current_states(scene), controls, scene.dt)
        first, second = pairs(controls.shape[2], controls.device)
        of_agents = dict(self._of_agents(scene, parameters, states, controls))
        return of_agents | dict(self._of_pairs(scene, parameters, states[:, :, first], states[:, :, second]))

    def hessian(
        self, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
    ) -> Float[Tensor, "B M n n"]:
        """d2E/du2 in closed form, n = 2 N K, in the order of ``controls.flatten(2)``; zero for absent agents.

        Residuals are linear in the controls, so the Hessian equals J^T J and depends on the controls only through the set of
        active hinges. An own term contributes a constant block for one agent and one direction (along or across), times its
        squared weight. A pair contributes to the blocks of both agents a and b

            w_ij^2 sum_t g_a g_b P_t^T P_t,

        a sum over the steps with an active hinge, where g is n_ij in the agent's frame (negative for agent j), and P_t the
        derivative of a position at step t by the controls of one direction. Differentiable with respect to weights; where a
        hinge becomes active, the Hessian jumps, which has no derivative.

        Raises:
            ValueError: shapes or names of scene, parameters and controls that do not fit together.
        """
        self.validate(scene, parameters, controls)
        batch, modes, agents, steps, _ = controls.shape
        motions = _Moves.of(scene.dt, controls)
        curvatures = torch.stack([_CURVATURE[name](motions) for name in self.own]).flatten(1)
        named = torch.broadcast_tensors(*(self._own_weight(scene, parameters, name) for name in self.own))
        weights = torch.stack(named, -1)
        own = (weights.square() @ curvatures).unflatten(-1, (2, steps, steps))  # [B, M, N, 2, K, K]
        shape = batch, 2 * agents, 2 * agents, modes, steps, steps
        first, second = pairs(agents, controls.device)
        if self.pair and len(first):
            present = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
            states = self.dynamics.rollout(self.current_states(scene), present, scene.dt)
            active = self._short(scene, parameters, states[:, :, first], states[:, :, second]) > 0
            count = torch.where(active, self._order_weight(scene, parameters).square()[..., None], 0.0)
            between = (motions.position.mT * count.transpose(1, 2)[..., None, :]) @ motions.position  # [B, P, M, K, K]
            heading = self.current_states(scene)[:, 0, :, HEADING]
            assert self.pair_order is not None
            line = self.pair_order.directions(scene)
            ends = [rotated(line, -heading[:, which]) for which in (first, second)]
            signed = torch.nn.functional.one_hot(torch.stack((first, second)), agents).to(controls.dtype)
            sides = signed[0][..., None] * ends[0][:, :, None] - signed[1][..., None] * ends[1][:, :, None]
            sides = sides.flatten(2)  # [B, P, 2 N]
            products = (sides[..., :, None] * sides[..., None, :]).flatten(2).mT
            matrix = (products @ between.flatten(2)).view(shape)
        else:
            matrix = controls.new_zeros(shape)
        matrix.diagonal(dim1=1, dim2=2).add_(own.flatten(2, 3).movedim(2, -1))
        matrix = matrix.unflatten(2, (agents, 2)).unflatten(1, (agents, 2)).permute(0, 5, 1, 6, 2, 3, 7, 4)
        matrix = torch.stack(matrix.unbind(-1), -1)  # far faster than reordering all at once
        return matrix.view(batch, modes, 2 * agents * steps, 2 * agents * steps)

    def own_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        states: Float[Tensor, "B C N K 4"],
        controls: Float[Tensor, "B C N K 2"],
    ) -> dict[str, Float[Tensor, "B C N"]]:
        """1/2 |w c|^2 by own term."""
        named = self._of_agents(scene, parameters, states, controls)
        return {name: 0.5 * residual.square().sum(-1) for name, residual in named}

    def pair_terms(
        self,
        scene: Scene,
        parameters: GameParameters,
        first: Float[Tensor, "B C P K 4"],
        second: Float[Tensor, "B C P K 4"],
    ) -> dict[str, Float[Tensor, "B C P"]]:
        """Half the squared hinges of the order."""
        named = self._of_pairs(scene, parameters, first, second)
        return {name: 0.5 * residual.square().sum(-1) for name, residual in named}

    def _of_agents(
        self, scene: Scene, parameters: GameParameters, states: Tensor, controls: Tensor
    ) -> Iterator[tuple[str, Tensor]]:
        initial, present = self.current_states(scene), scene.agent_mask[:, None]
        to_goal = reference_speed = None
        if "goals" in self.needs:
            assert parameters.goals is not None
            goals = torch.where(present[..., None], parameters.goals, 0.0)
            to_goal = rotated(states[..., :2] - goals[..., None, :], -initial[..., None, HEADING])
        if "reference_speed" in self.needs:
            assert scene.reference_speed is not None
            reference_speed = torch.where(present, scene.reference_speed[:, None], 0.0)
        before = torch.stack((initial[..., SPEED], torch.zeros_like(initial[..., SPEED])), -1)
        velocity = before[..., None, :] + scene.dt * controls.cumsum(-2)
        motion = _Motion(controls, velocity, scene.dt, to_goal, reference_speed)
        for name in self.own:
            yield name, self._own_weight(scene, parameters, name)[..., None] * _OWN[name][0](motion)

    def _own_weight(self, scene: Scene, parameters: GameParameters, name: str) -> Float[Tensor, "B M N"]:
        """Weights of an own term, zero for absent agents."""
        present = scene.agent_mask[:, None]
        if name == "acc":
            return present.to(parameters.initial_controls.dtype)
        weight = torch.where(present, parameters.own_weights[name], 0.0)
        return torch.where(present, (weight.square() + FLOOR).sqrt(), 0.0) if name == "lat_acc" else weight

    def _of_pairs(
        self, scene: Scene, parameters: GameParameters, first: Tensor, second: Tensor
    ) -> Iterator[tuple[str, Tensor]]:
        if not self.pair:
            return
        yield "order", self._order_weight(scene, parameters)[..., None] * self._short(scene, parameters, first, second)

    def _order_weight(self, scene: Scene, parameters: GameParameters) -> Float[Tensor, "B M P"]:
        """Weights of the order, zero where an agent is absent."""
        return torch.where(pair_mask(scene)[:, None], parameters.pair_weights["order"], 0.0)

    def _short(
        self, scene: Scene, parameters: GameParameters, first: Tensor, second: Tensor
    ) -> Float[Tensor, "B M P K"]:
        """The hinges: missing distance [m], zero at steps that do not count and where an agent is absent."""
        assert parameters.order is not None
        assert self.pair_order is not None
        exists = pair_mask(scene)[:, None]
        order = torch.where(exists, parameters.order, 1.0)[..., None]
        ahead = (self.pair_order.directions(scene)[:, None, :, None] * (first - second)[..., :2]).sum(-1)
        short = torch.relu(self.distance(scene)[:, None, :, None] - order * ahead)
        counts = (self.pair_order.near(scene, first.shape[3]) & exists[:, 0, :, None])[:, None]
        if self.lane is not None:
            assert parameters.goals is not None
            counts = counts & self.pair_order.in_one_lane(scene, parameters.goals, first.shape[3], self.lane)
        return torch.where(counts, short, 0.0)

    def distance(self, scene: Scene) -> Float[Tensor, "B P"]:
        """Distances d_ij to be kept: the radii of both discs, which are half the lengths, and the gap."""
        radius = disc(self.size(scene))
        first, second = pairs(radius.shape[1], radius.device)
        return radius[:, first] + radius[:, second] + self.gap

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Check that scene, parameters and controls fit together.

        Raises:
            ValueError: a wrong shape, a missing weight, missing goals, orders, reference speeds or sizes. The message names
                the tensor and the expected shape.
        """
        super().validate(scene, parameters, controls)
        batch, agents = scene.agent_mask.shape
        count = agents * (agents - 1) // 2
        own, pair = self.weighted
        given: list[tuple[str, Tensor | None, list[int]]] = []
        for part, names, weights, entries in (
            ("own_weights", own, parameters.own_weights, agents),
            ("pair_weights", pair, parameters.pair_weights, count),
        ):
            for name in names:
                if name not in weights:
                    raise ValueError(f"{part} lacks the term {name!r}; it has {sorted(weights)}")
                given.append((f"{part}[{name!r}]", weights[name], [entries]))
        if "goals" in self.needs:
            given.append(("parameters.goals", parameters.goals, [agents, 2]))
        if self.pair:
            given.append(("parameters.order", parameters.order, [count]))
        modes = controls.shape[1]
        for what, tensor, rest in given:
            if tensor is None:
                raise ValueError(f"{what} is None; this energy takes {[batch, modes, *rest]}")
            if list(tensor.shape) not in ([batch, modes, *rest], [batch, 1, *rest]):
                raise ValueError(f"{what} has shape {list(tensor.shape)}; these controls take {[batch, modes, *rest]}")
        if "reference_speed" in self.needs and scene.reference_speed is None:
            raise ValueError("the energy has the term 'velref', but scene.reference_speed [B, N] is None")
        if self.pair and scene.size is None:
            raise ValueError("the pair term 'order' takes the agents' sizes from scene.size [B, N, 2], which is None")
