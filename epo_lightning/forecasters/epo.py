"""Energy-based potential games: the network infers a game, and the forecast minimises its energy (Sections 3, 4).

The paper's own method (+EPO, Algorithm 1) is one choice of four parts: energy, minimiser, derivative and objective. The
other methods of its Table 1, and combinations that have not been published, are other choices.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from epo_lightning.backbones.base import Backbone
from epo_lightning.checks import check_choice, check_number
from epo_lightning.decoders.goals import Goals
from epo_lightning.decoders.orders import DecodedOrders, Orders
from epo_lightning.decoders.probabilities import PROBABILITIES
from epo_lightning.decoders.weights import Margins
from epo_lightning.forecast import GameParameters, JointForecast, Solution, Status
from epo_lightning.forecasters.combination import Combination
from epo_lightning.forecasters.epo_decoders import (
    goals_decoder,
    own_weights_decoder,
    pair_weights_decoder,
    strategies_decoder,
)
from epo_lightning.forecasters.epo_settings import (
    WEIGHTS,
    check_calibration,
    check_gate,
    check_horizon,
    check_initial,
    check_margin,
    check_modes,
    check_needs,
    check_pair_start,
    check_start,
    decodes_probabilities,
)
from epo_lightning.forecasters.game_forecaster import GameForecaster
from epo_lightning.forecasters.repeats import repeats_joined, without_repeated_choices
from epo_lightning.game.energy import FEATURES, RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.objectives.base import Objective
from epo_lightning.optimizers import Adam
from epo_lightning.registry import build, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.backward import Backward
from epo_lightning.solvers.base import SAMPLES, TABLES, Minimiser
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium
from epo_lightning.task import Task

EXAMINED = 512
"""Number of test scenes, spread evenly, in which the Nash gap is measured if this is slow.

It is fast for energies of features, unless one is a function of whole trajectories, and for solutions with tables of
candidates; then it is measured in all scenes."""


@register("forecaster", "epo")
class EPO(GameForecaster):
    """Forecaster whose network infers a game (weights, goals, initial strategies), and whose solver minimises its energy.

    Goals: a single candidate is a given goal, the same in all modes. If there are several candidates, and the energy has a
    term for goals or lanes, an agent's goal in mode m is its m-th most likely candidate, and the agent follows the reference
    line of that candidate.

    Modes: most minimisers solve one game per mode. A minimiser that chooses among candidate strategies solves one game, and
    its M best joint choices are the modes.

    Args:
        backbone: the observation encoder phi_glob.
        energy: the energy, which the decoded weights parametrise.
        solver: the minimiser of the energy.
        backward: the derivative of the solution.
        objective: the training objective.
        modes: number M of joint modes.
        own_start: own weights at a network output of zero; the weight is own_start * (1 + network output). One number
            for all features, or numbers by feature name; features that are not named have 1. On highways ``vel``, which
            pulls speeds towards zero, has to start small.
        pair_start: pair weight at a network output of zero; positive where pair weights are.
        symmetric_pairs: whether pair weights are the same in both orders of two agents, so that forecasts do not depend on
            the order of agents.
        initial: ``decoded``, ``zero`` or ``motions``.
        control_scale: initial control at a network output of one.
        motions: largest ``acceleration`` [m/s^2] and ``curvature`` [1/m] of initial motions.
        game_horizon: number of steps of the game, of which the forecast is the first K; None for K. A game that ends with
            the forecast cannot explain agents that act for a later goal. If it is above K,
            ``Scene.game_steps`` may end a scene's game earlier. Initial strategies have ``game_horizon`` steps.
        one_game: whether the modes are equilibria of one game, found from the initial strategies; its pair weights are
            positive. Modes that end at the same equilibrium are one outcome (:mod:`~epo_lightning.forecasters.repeats`).
            With an energy of orders (which agent of a pair is ahead), modes differ in orders and goals (TGL).
            Otherwise every mode has a game of its own, as in the paper.
        own_weights: ``decoded`` for each agent by the network, or ``shared`` by all agents, modes and scenes.
        pair_weights: the same for pairs; shared ones are positive.
        calibration: settings of a :class:`~epo_lightning.forecasters.calibration.Calibration`, which corrects the
            inferred pair weights so that the game explains the history; None for no correction.
        probabilities: decoder of the modes' probabilities, ``linear`` (the paper's) or ``pairwise``
            (:mod:`~epo_lightning.decoders.probabilities`).
        margin: ``largest`` margin [m] of pair features with a decoded margin, and the margin before training, ``start``;
            2 m and 0.5 m by default. Margins that the energy fixes are not decoded.
        gate: name and settings of a :class:`~epo_lightning.decoders.gates.Gate`, which chooses the pairs of agents that
            interact; None for all pairs.

    Raises:
        ConfigError: parts that do not work together, with the changes that would work; or a value out of its range.
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        backbone: Backbone,
        energy: Energy,
        solver: Minimiser,
        backward: Backward,
        objective: Objective,
        modes: int,
        own_start: float | Mapping[str, float] = 1.0,
        pair_start: float = 3.0,
        symmetric_pairs: bool = False,
        initial: str = "decoded",
        control_scale: float = 0.3,
        motions: Mapping[str, float] | None = None,
        game_horizon: int | None = None,
        calibration: Mapping[str, float | Sequence[float]] | None = None,
        own_weights: str = "decoded",
        pair_weights: str = "decoded",
        one_game: bool = False,
        probabilities: str = "linear",
        margin: Mapping[str, float] | None = None,
        gate: Mapping[str, Any] | None = None,
    ) -> None:
        Combination.of(energy=energy, solver=solver, backward=backward, objective=objective).check()
        check_needs(energy, task)
        self.calibration = check_calibration(calibration, energy, solver)
        self.one_game = one_game
        self.game_horizon = task.horizon if game_horizon is None else game_horizon
        check_horizon(self.game_horizon, energy, objective, task)
        check_modes(modes, one_game, solver)
        check_initial(initial, modes, one_game, energy, solver)
        check_choice("forecaster.own_weights", own_weights, WEIGHTS)
        check_choice("forecaster.pair_weights", pair_weights, WEIGHTS)
        check_gate(gate, energy)
        decoded = decodes_probabilities(probabilities, energy, solver)
        check_pair_start(pair_start, positive=one_game or pair_weights == "shared")
        check_number("forecaster.control_scale", control_scale)
        super().__init__(task, optimizer)
        self.backbone, self.energy, self.solver, self.modes = backbone, energy, solver.for_modes(modes), modes
        self.reads_goal_headings = "goal_headings" in energy.needs
        self.longest_game = self.game_horizon if self.game_horizon > task.horizon else None
        self.differentiable_solve, self.objective = backward, objective
        # M games, one per mode; or one game for all modes, which solvers that choose among candidates always have.
        games = 1 if one_game else solver.games(modes)
        # M initial strategies, one per mode; for solvers that choose, C candidates.
        strategies = solver.strategies(modes)
        width, scale, horizon = backbone.width, task.scale, self.game_horizon
        own_names, pair_names = energy.weighted
        start = check_start(own_start, own_names, energy.own)
        # Do not change the order: every module draws its initial weights from the same sequence of random numbers.
        self.own_weights = own_weights_decoder(own_weights, width, games, own_names, start)
        self.pair_weights = pair_weights_decoder(
            pair_weights, width, games, pair_names, pair_start, symmetric_pairs, positive=one_game
        )
        self.strategies = strategies_decoder(initial, width, strategies, horizon, control_scale, motions)
        order = energy.pair_order
        # Orders and goals of the modes are variants of one game, unless the solver chooses the modes itself.
        variants = games if order is None or TABLES in solver.provides else modes
        self.goals = goals_decoder(energy, task, width, variants)
        self.orders = None if order is None else Orders(width, variants, order.symmetric)
        self.probabilities = PROBABILITIES[probabilities](width, modes, task.horizon, scale) if decoded else None
        # Built last: decoders of margins and gates must not change the initial weights of the networks above.
        limits = check_margin(margin)
        names = energy.decoded_margins
        self.margins = Margins(width, games, names, **limits, symmetric=symmetric_pairs) if names else None
        ahead = task.horizon * task.dt
        self.gate = None if gate is None else build("gate", gate, ahead=ahead, width=width, scale=scale)

    def forward(self, scene: Scene) -> JointForecast:
        """Features, goals, game parameters, solution, probabilities: the order of the paper's Fig. 3."""
        z = self.backbone(scene)
        goals = self.goals(z, scene)
        solved_scene = self.game_scene(scene)
        orders = self._decode_orders(z, scene)
        parameters = self._infer_game(z, scene, goals, orders)
        if self.calibration is not None and not self.training:
            parameters = self.calibration(self.solver, self.energy, solved_scene, parameters)
        if TABLES not in self.solver.provides:
            parameters = parameters.for_every_mode(self.modes)
        solution = self.differentiable_solve(self.minimiser, self.energy, solved_scene, parameters)
        settled = self._without_noise(solution, solved_scene, parameters)
        logits = self._mode_logits(z, scene, goals, orders, settled)
        if self.one_game and self.probabilities is not None:
            # The solver may find one equilibrium of the game from several starts.
            settled, logits = repeats_joined(settled, logits, self.task.horizon, scene.agent_mask)
        return JointForecast(
            states=settled.states[..., : self.task.horizon, :],
            probabilities=logits.softmax(1),
            controls=settled.controls[..., : self.task.horizon, :],
            initial_states=self._states_of_initial_strategies(scene, parameters),
            parameters=parameters,
            solution=solution if SAMPLES in self.minimiser.provides else settled,
            goal_probabilities=goals.probabilities,
            order_logits=None if orders is None else orders.logits,
            logits=logits,
            goal_logits=goals.logits,
        )

    def game_scene(self, scene: Scene) -> Scene:
        """The scene as the solver sees it.

        If ``game_horizon`` is longer than the forecast, games end at their own ends, or at ``game_horizon`` if that is
        earlier. Otherwise ``game_steps`` is removed, so that all games end with the forecast.
        """
        steps = scene.game_steps
        if steps is None:
            return scene
        longer = self.game_horizon > self.task.horizon
        return dataclasses.replace(scene, game_steps=steps.clamp_max(self.game_horizon) if longer else None)

    def _decode_orders(self, z: Tensor, scene: Scene) -> DecodedOrders | None:
        """The most likely orders of the pairs; None for energies without orders.

        During training, objectives that imitate take the observed orders where they are known, in all modes, because
        no decoded order may be the observed one. Modes then differ in their goals alone. The decoder learns by the cross
        entropy of its logits.
        """
        order = self.energy.pair_order
        if self.orders is None or order is None:
            return None
        decoded = self.orders(z, scene.agent_mask, order.matters(scene, self.task.horizon))
        if not (self.training and self.objective.observed_orders and scene.future is not None):
            return decoded
        observed, known = order.observed(scene)
        return decoded._replace(order=torch.where(known[:, None], observed[:, None].to(decoded.order), decoded.order))

    def _infer_game(self, z: Tensor, scene: Scene, goals: Goals, orders: DecodedOrders | None) -> GameParameters:
        """The game of every mode: decoded weights and initial strategies, with its goals and orders.

        Raises:
            ValueError: the scene lacks the reference lines or the goal headings that the energy asks for.
        """
        if "reference" in self.energy.needs and goals.reference is None:
            raise ValueError("the energy follows reference lines, but scene.goal_reference [B, N, G] is None")
        if "goal_headings" in self.energy.needs and goals.headings is None:
            raise ValueError(
                "the energy has a feature of the headings wanted at goals, but scene.goal_headings [B, N, G] is None: give "
                "the scene a heading [rad] for every goal candidate; or, to train on data without goal headings, leave the "
                "feature out of energy.own"
            )
        own_weights, (pair_weights, margins) = self.own_weights(z, scene.agent_mask), self._of_pairs(z, scene)
        if orders is not None:
            # One set of weights may be that of all orders.
            variants = orders.order.shape[1]
            own_weights, pair_weights = (
                {name: weight.expand(-1, variants, -1) for name, weight in weights.items()}
                for weights in (own_weights, pair_weights)
            )
        # Agents without a goal have the position (0, 0) for it: zero goal weights keep it from attracting them.
        for name in self.energy.goal_terms & own_weights.keys():
            own_weights[name] = own_weights[name].where(goals.exist[:, None], 0.0)
        strategies = self.strategies(z, scene)
        return GameParameters(
            own_weights=own_weights,
            pair_weights=pair_weights,
            initial_controls=strategies,
            goals=goals.positions,
            reference=goals.reference,
            context=z if "context" in self.energy.needs else None,
            order=None if orders is None else orders.order,
            goal_headings=goals.headings,
            margins=margins,
            reference_controls=strategies if "reference_controls" in self.energy.needs else None,
        )

    def _of_pairs(self, z: Tensor, scene: Scene) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Weights and margins by pair feature; weights are zero for pairs that the gate leaves out."""
        if self.gate is None:
            return self.pair_weights(z), {} if self.margins is None else self.margins(z)
        chosen, factor = self.gate(z, scene)
        weights = self.pair_weights(z, chosen)
        if factor is not None:
            weights = {name: weight * factor[:, None] for name, weight in weights.items()}
        return weights, {} if self.margins is None else self.margins(z, chosen)

    def _without_noise(self, solution: Solution, scene: Scene, parameters: GameParameters) -> Solution:
        """The solution that is the forecast. A sampling solver is run again without noise, also in training.

        So probabilities are learned on forecasts like those outside training.
        """
        if SAMPLES not in self.minimiser.provides:
            return solution
        with torch.no_grad():
            return self.solver.for_test()(self.energy, scene, parameters)

    def _mode_logits(
        self, z: Tensor, scene: Scene, goals: Goals, orders: DecodedOrders | None, solution: Solution
    ) -> Tensor:
        """Unnormalised log-probabilities of the joint modes, [B, M].

        The logit of a choice among candidates is -E. The logit of a mode with orders is the log-probability of its orders
        and goals. In all other cases the network decodes the logits.
        """
        if solution.assignment is not None:
            stopped = (solution.status == Status.STOPPED).any(1, keepdim=True)
            return without_repeated_choices(-torch.where(stopped, 0.0, solution.energy), solution.assignment)
        if orders is not None:
            choices = orders.order if goals.chosen is None else torch.cat((orders.order.long(), goals.chosen), -1)
            return without_repeated_choices(orders.log_probability + goals.log_probability, choices)
        assert self.probabilities is not None
        current = scene.current_or_zero
        positions = solution.states[..., : self.task.horizon, :2]
        return self.probabilities(z, positions, current, scene.agent_mask)

    def _states_of_initial_strategies(self, scene: Scene, parameters: GameParameters) -> Tensor | None:
        """The states of the initial strategies, [B, M, N, K, 4]; None for solvers that choose among candidates.

        If gradients reach the initial strategies through the solution (``backward=unrolled``), the loss term ``initial`` is
        not used: their states have no gradient, and in training, where nothing else reads them, they are None.
        """
        taught = self.differentiable_solve.teaches_start
        if TABLES in self.solver.provides or (taught and self.training):
            return None
        controls = parameters.initial_controls[..., : self.task.horizon, :]
        controls = controls.detach() if taught else controls
        states = self.energy.dynamics.rollout(self.energy.current_states(scene), controls, scene.dt)
        return states.expand(-1, self.modes, -1, -1, -1)

    @torch.no_grad()
    def examine(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        """The forecast with its distance from an equilibrium, and with the solutions of its games without pair terms.

        Games with hard constraints have no such distance (:func:`.equilibrium.equilibrium`).
        """
        forecast = dataclasses.replace(forecast, states_without_pairs=self._states_without_pairs(scene, forecast))
        assert forecast.solution is not None
        slow = isinstance(self.energy, FeatureEnergy) and self.energy.of_trajectories
        cheap = (FEATURES in self.energy.offers and not slow) or forecast.solution.tables is not None
        scenes = len(scene.history)
        stride = 1 if cheap else max(1, self._batches * scenes // EXAMINED)
        chosen = torch.arange(0, scenes, stride, device=scene.history.device)
        report = equilibrium(self.energy, self.game_scene(scene)[chosen], forecast[chosen])
        if report is None:
            return forecast
        if RESIDUALS not in self.energy.offers:
            # The zero of such an energy is arbitrary, so a gap relative to the objective means nothing.
            report = dataclasses.replace(report, objective=torch.full_like(report.objective, torch.nan))
        whole = report.map(lambda t: t.new_full((scenes, *t.shape[1:]), torch.nan).index_copy(0, chosen, t))
        return dataclasses.replace(forecast, equilibrium=whole)

    def _states_without_pairs(self, scene: Scene, forecast: JointForecast) -> Tensor | None:
        """States of the same games' solutions from the same start, but with pair weights of zero; [B, M, N, K, 4].

        None for games without pair terms, for energies with other interaction than named features, and for choices among
        candidates.
        """
        parameters = forecast.parameters
        if (
            parameters is None
            or not parameters.pair_weights
            or FEATURES not in self.energy.offers
            or TABLES in self.solver.provides
        ):
            return None
        return self.solve(scene, parameters.without_pairs()).states[..., : self.task.horizon, :]

    def solve(self, scene: Scene, parameters: GameParameters) -> Solution:
        """The solution of a given game of a scene, for example an inferred one with other weights or goals."""
        return self.differentiable_solve(self.minimiser, self.energy, self.game_scene(scene), parameters)

    @property
    def _batches(self) -> int:
        """Number of test batches; 1 outside a Trainer."""
        counts = self._trainer.num_test_batches if self._trainer is not None else [1]
        return int(sum(counts)) or 1
