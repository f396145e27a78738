"""Planners: the motion of one agent, planned anew at every step over a receding horizon.

- :class:`ForecastPlanner`: the planned agent's part of a joint mode that a forecaster finds, so the forecaster decides on
  what the others do and on how the planned agent answers, at once.
- :class:`ResponsePlanner`: the planned agent knows its own costs, and responds to a forecast of the others.
- :class:`GamePlanner`: the planned agent knows the costs of all agents, and solves the game or iterates best responses.

A plan that is not finite, or whose solver stopped, is replaced by the rest of the last one (:meth:`Plan.or_else`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from epo_lightning.batch import Batch
from epo_lightning.drive.world import EGO, Search
from epo_lightning.forecast import GameParameters, JointForecast, Solution, Status
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.forecasters.epo import EPO
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.refinement.game import NOISE, track
from epo_lightning.registry import ConfigError
from epo_lightning.scene import FIELDS, HEADING, SPEED, Scene, rotated
from epo_lightning.solvers.base import TABLES
from epo_lightning.solvers.diagnostics.equilibrium import descend_features
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

BRAKING = 2.0
"""Deceleration [m/s^2] of the plan that is followed where there is no earlier plan to fall back to."""


@dataclass(frozen=True, repr=False)
class Plan(Batch):
    """The planned motion of one agent in B episodes, and the joint future that it belongs to.

    Attributes:
        controls: controls of the planned agent, of which the first ones are executed.
        states: the joint future.
        found: whether a plan was found; False where it is the rest of an earlier one.
        joint: joint strategies of all modes, for the next warm start; None for planners without strategies.
    """

    controls: Float[Tensor, "B K 2"]
    states: Float[Tensor, "B N K 4"]
    found: Bool[Tensor, " B"]
    joint: Float[Tensor, "B M N L 2"] | None = None

    def or_else(self, previous: Plan | None, scene: Scene) -> Plan:
        """This plan where it was found; elsewhere the rest of the previous one, or a stop if there is none."""
        if bool(self.found.all()):
            return self
        controls, states = previous.rest(self.controls.shape[1]) if previous else _stop(scene, self)
        joint = self.joint
        if joint is not None:
            joint = torch.where(joint.isfinite(), joint, 0.0)
        return Plan(
            controls=torch.where(self.found[:, None, None], self.controls, controls.to(self.controls)),
            states=torch.where(self.found[:, None, None, None], self.states, states.to(self.states)),
            found=self.found,
            joint=joint,
        )

    def seen_from(self, before: Scene, now: Scene) -> Plan:
        """This plan in the frame of the next scene, for scenes whose frames move with their agents."""
        if before.frame is None or now.frame is None:
            return self
        (here, there), like = (frame.double() for frame in (before.frame, now.frame)), self.states
        turn = here[:, 2] - there[:, 2]
        shift = rotated(here[:, :2] - there[:, :2], -there[:, 2]).to(like)
        position = rotated(self.states[..., :2], turn.to(like)[:, None, None]) + shift[:, None, None]
        heading = self.states[..., HEADING] + turn.to(like)[:, None, None]
        return dataclasses.replace(
            self, states=torch.cat((position, heading[..., None], self.states[..., SPEED, None]), -1)
        )

    def rest(self, steps: int) -> tuple[Float[Tensor, "B K 2"], Float[Tensor, "B N K 4"]]:
        """Controls and joint states of this plan one step later, with controls of zero at the end."""
        states = torch.cat((self.states[:, :, 1:], self.states[:, :, -1:].expand(-1, -1, steps, -1)), 2)[:, :, :steps]
        return shifted(self.controls, steps), states


def shifted(controls: Float[Tensor, "*batch K 2"], steps: int) -> Float[Tensor, "*batch steps 2"]:
    """Strategies one step later: the first controls are dropped, and controls of zero are added or the end is cut."""
    return resized(controls[..., 1:, :], steps)


def resized(controls: Float[Tensor, "*batch K 2"], steps: int) -> Float[Tensor, "*batch steps 2"]:
    """Controls over a number of steps: controls of zero are added at the end, or the end is cut."""
    return F.pad(controls, (0, 0, 0, max(0, steps - controls.shape[-2])))[..., :steps, :]


def constant(speed: Float[Tensor, " B"], acceleration: float, steps: int, dt: float) -> Float[Tensor, "B K 2"]:
    """Controls of agents that accelerate constantly, or brake until they stand."""
    change = acceleration * dt * torch.arange(steps + 1)
    left = speed[:, None].abs() + change.to(speed)
    along = left.clamp_min(0.0) * torch.where(speed < 0, -1.0, 1.0)[:, None]
    rate = along.diff(dim=1) / dt
    return torch.stack((rate, torch.zeros_like(rate)), -1)


def _stop(scene: Scene, plan: Plan) -> tuple[Tensor, Tensor]:
    """A plan that brakes until the agent stands, with the agents of the plan drawn where they are."""
    agents, steps = plan.states.shape[1:3]
    braking = constant(scene.current[:, EGO, SPEED], -BRAKING, steps, scene.dt)
    return braking, scene.current[:, :agents, None].expand(-1, -1, steps, -1)


class Planner(Protocol):
    """The interface of a planner: a function from scenes to plans."""

    def __call__(self, scene: Scene, previous: Plan | None) -> Plan:
        """The plan at a step, given the plan of the step before; None at the first step."""
        ...


class ForecastPlanner:
    """The planned agent's part of a forecaster's joint mode.

    Forecasts without controls are tracked with the unicycle (:func:`~epo_lightning.refinement.game.track`).

    Where games are solved again (``warm``, ``pair_terms=False``), modes keep the probabilities of the forecast, which were
    decoded from its own solutions.

    Args:
        forecaster: any forecaster.
        agents: number of agents that it is shown, the first ones of each scene; None for all.
        pair_terms: False to switch the pair terms of the inferred games off, for forecasters with such a game.
        warm: whether the solver starts at the shifted strategies of the last step instead of the decoded ones.
        keep: whether the mode is the one whose plan is nearest to the last plan, instead of the most likely one.

    Raises:
        ConfigError: options of a game for a forecaster without one, or for one that chooses among fixed candidates.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        agents: int | None = None,
        pair_terms: bool = True,
        warm: bool = False,
        keep: bool = False,
    ) -> None:
        self.forecaster, self.agents = forecaster.eval(), agents
        self.pair_terms, self.warm, self.keep = pair_terms, warm, keep
        self._game = isinstance(forecaster, EPO) and TABLES not in forecaster.solver.provides
        if (warm or not pair_terms) and not self._game:
            raise ConfigError(
                f"{type(forecaster).__name__} solves no game from initial strategies: warm=true and pair_terms=false take "
                "a run of forecaster=epo with a solver that computes strategies"
            )

    @torch.no_grad()
    def __call__(self, scene: Scene, previous: Plan | None) -> Plan:
        scene = self.forecaster.as_input(first_agents(scene, self.agents))
        forecast: JointForecast = self.forecaster(scene)
        states, controls, joint = forecast.states, _controls(forecast, scene), None
        found = states.isfinite().flatten(2).all(2)
        if self._game:
            solution = self._solution(scene, forecast, previous)
            steps = states.shape[-2]
            states, controls, joint = solution.states[..., :steps, :], solution.controls, solution.controls
            found = states.isfinite().flatten(2).all(2) & (solution.status != Status.STOPPED)
        mode = self._mode(forecast, states, previous)
        rows = torch.arange(len(mode))
        plan = controls[rows, mode, EGO, : states.shape[-2]]
        return Plan(plan, states[rows, mode], found[rows, mode], joint)

    @torch.no_grad()
    def controls_of_all(self, scene: Scene) -> Float[Tensor, "B n K 2"]:
        """Controls of all agents that the forecaster is shown, in the most likely joint mode."""
        scene = self.forecaster.as_input(first_agents(scene, self.agents))
        forecast: JointForecast = self.forecaster(scene)
        return _controls(forecast, scene)[torch.arange(len(scene.history)), forecast.probabilities.argmax(1)]

    def _solution(self, scene: Scene, forecast: JointForecast, previous: Plan | None) -> Solution:
        """The solution of the inferred game; solved again for a warm start or without pair terms."""
        assert isinstance(self.forecaster, EPO)
        assert forecast.parameters is not None
        assert forecast.solution is not None
        game = forecast.parameters if self.pair_terms else forecast.parameters.without_pairs()
        if self.warm and previous is not None and previous.joint is not None:
            start = shifted(previous.joint, forecast.solution.controls.shape[-2])
            game = dataclasses.replace(game, initial_controls=start.to(forecast.solution.controls))
        return forecast.solution if game is forecast.parameters else self.forecaster.solve(scene, game)

    def _mode(self, forecast: JointForecast, states: Tensor, previous: Plan | None) -> Int[Tensor, " B"]:
        if not self.keep or previous is None:
            return forecast.probabilities.argmax(1)
        last = previous.rest(states.shape[-2])[1][:, EGO, :, :2].to(states)
        return (states[:, :, EGO, :, :2] - last[:, None]).norm(dim=-1).mean(-1).nan_to_num(torch.inf).argmin(1)


def first_agents(scene: Scene, count: int | None) -> Scene:
    """The scene with its first agents alone; all of them for None."""
    if count is None or count >= scene.agent_mask.shape[1]:
        return scene
    of_agents = [name for name, (_, shape, _) in FIELDS.items() if shape[1:2] == ("N",)]
    cut = {name: tensor[:, :count] for name in of_agents if (tensor := getattr(scene, name)) is not None}
    return dataclasses.replace(scene, **cut)


def _controls(forecast: JointForecast, scene: Scene) -> Float[Tensor, "B M N K 2"]:
    """Controls of a forecast; those that track its futures if it has none."""
    return track(forecast.states, scene, Unicycle(), NOISE) if forecast.controls is None else forecast.controls


class _OfGame:
    """Common part of planners that minimise known costs.

    Args:
        energy: the energy of the games.
        game: the game of a scene; its initial strategies are those of the first step.
        search: how minima are searched.
    """

    def __init__(
        self, energy: FeatureEnergy, game: Callable[[Scene], GameParameters], search: Search | None = None
    ) -> None:
        self.energy, self.game, self.search = energy, game, search or Search()

    def _start(self, scene: Scene, previous: Plan | None) -> tuple[GameParameters, Float[Tensor, "B 1 N K 2"]]:
        """The game, and its warm start: the strategies of the last step, shifted."""
        game = self.game(scene)
        if previous is None or previous.joint is None:
            return game, game.initial_controls.clone()
        return game, shifted(previous.joint, game.initial_controls.shape[-2]).to(game.initial_controls)

    def _descend(
        self, scene: Scene, game: GameParameters, start: Tensor, agent: int | None
    ) -> tuple[Float[Tensor, "B 1 N K 2"], Bool[Tensor, " B"]]:
        """Strategies after the minimisation over those of one agent, or of all; and whether a minimum was found."""
        if self.search.steps is not None:
            return self._descend_shortly(scene, game, start, agent, self.search.steps)
        moves = None if agent is None else torch.full((len(start),), agent)
        result = descend_features(self.energy, scene, dataclasses.replace(game, initial_controls=start), moves)
        return result.controls, result.found

    def _descend_shortly(
        self, scene: Scene, game: GameParameters, start: Tensor, agent: int | None, steps: int
    ) -> tuple[Float[Tensor, "B 1 N K 2"], Bool[Tensor, " B"]]:
        """The same by a fixed number of steps of the layer, from several starts in one call."""
        held = torch.zeros(start.shape[2], dtype=torch.bool)
        if agent is not None:
            held = torch.arange(len(held)) != agent
        starts = [start]
        for acceleration in () if held[EGO] else self.search.accelerations:
            other = start.clone()
            other[:, 0, EGO] = constant(scene.current[:, EGO, SPEED], acceleration, start.shape[-2], scene.dt).to(start)
            starts.append(other)
        game = dataclasses.replace(game, initial_controls=torch.cat(starts, 1))
        damping = start.new_ones(len(start), len(starts), len(held)).masked_fill(held, torch.inf)
        solver = LevenbergMarquardt(step_size=1.0, adaptive=True)
        solution, _ = solver.run(self.energy, scene, game, steps, damping)
        found = solution.energy.isfinite() & (solution.status != Status.STOPPED)
        best, rows = solution.energy.masked_fill(~found, torch.inf).argmin(1), torch.arange(len(start))
        controls = solution.controls[rows, best][:, None]
        return torch.where(held[:, None, None], start, controls), found[rows, best]

    def _plan(self, scene: Scene, controls: Float[Tensor, "B 1 N K 2"], found: Bool[Tensor, " B"]) -> Plan:
        states = self.energy.dynamics.rollout(self.energy.current_states(scene), controls, scene.dt)[:, 0]
        return Plan(controls[:, 0, EGO], states, found & states.isfinite().flatten(1).all(1), controls)


class ResponsePlanner(_OfGame):
    """Predict, then plan: the others are expected to do what a forecaster says, and the planned agent responds to that.

    Args:
        energy, game: the planned agent's costs.
        forecaster: forecast of the others, by its most likely joint mode; after its horizon they keep their velocity.
            None for others that keep going from the start, as the game's ``reference_controls`` say, or straight on.
        search: how minima are searched.
        agents: number of agents that the forecaster is shown, the first ones of each scene; None for all. The others keep
            going.
    """

    def __init__(
        self,
        energy: FeatureEnergy,
        game: Callable[[Scene], GameParameters],
        forecaster: Forecaster | None = None,
        search: Search | None = None,
        agents: int | None = None,
    ) -> None:
        super().__init__(energy, game, search)
        self.forecast = None if forecaster is None else ForecastPlanner(forecaster, agents)

    @torch.no_grad()
    def __call__(self, scene: Scene, previous: Plan | None) -> Plan:
        scene = scene.to(torch.float64)
        game, controls = self._start(scene, previous)
        others = torch.arange(controls.shape[2]) != EGO
        controls[:, :, others] = self.expected(scene, game)[:, :, others]
        return self._plan(scene, *self._descend(scene, game, controls, EGO))

    def expected(self, scene: Scene, game: GameParameters) -> Float[Tensor, "B 1 N K 2"]:
        """Controls that the others are expected to take; those of the planned agent are without meaning."""
        usual = game.reference_controls
        controls = (torch.zeros_like(game.initial_controls) if usual is None else usual).clone()
        if self.forecast is None:
            return controls
        forecast = resized(self.forecast.controls_of_all(scene), controls.shape[-2])
        controls[:, 0, : forecast.shape[1]] = forecast.nan_to_num(0.0).to(controls)
        return controls


class GamePlanner(_OfGame):
    """The planned agent solves the game with the known costs of all agents.

    Args:
        energy, game: the game.
        rounds: number of best responses of every agent in turn (iterated best response); None for the joint minimum of the
            potential, which is a Nash equilibrium.
        search: how minima are searched.
    """

    def __init__(
        self,
        energy: FeatureEnergy,
        game: Callable[[Scene], GameParameters],
        rounds: int | None = None,
        search: Search | None = None,
    ) -> None:
        super().__init__(energy, game, search)
        self.rounds = rounds

    @torch.no_grad()
    def __call__(self, scene: Scene, previous: Plan | None) -> Plan:
        scene = scene.to(torch.float64)
        game, controls = self._start(scene, previous)
        if self.rounds is None:
            return self._plan(scene, *self._descend(scene, game, controls, None))
        found = torch.ones(len(controls), dtype=torch.bool)
        for _ in range(self.rounds):
            for agent in reversed(range(controls.shape[2])):
                controls, fine = self._descend(scene, game, controls, agent)
                found &= fine
        return self._plan(scene, controls, found)
