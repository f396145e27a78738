"""The paper's own forecaster: the network infers a game, and the forecast is its solution (+EPO, Algorithm 1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from torch import Tensor

from epo_lightning.backbones.base import Backbone
from epo_lightning.decoders.goals import given_goals
from epo_lightning.decoders.probabilities import SceneProbabilities
from epo_lightning.decoders.strategies import InitialStrategies
from epo_lightning.decoders.weights import OwnWeights, PairWeights
from epo_lightning.forecasters.base import Forecaster, Task, weights_of
from epo_lightning.forecasters.scene_consistent import joint_losses
from epo_lightning.game.energy import Energy
from epo_lightning.losses import Relaxation
from epo_lightning.optimizers import Adam
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import GameParameters, JointForecast, Scene
from epo_lightning.solvers.levenberg_marquardt import LevenbergMarquardt


@register("forecaster", "epo")
class EPO(Forecaster):
    """Weights, goals and initial strategies from the network; joint strategies from the energy's minimisation.

    Args:
        backbone: the observation encoder phi_glob.
        energy: what the network's parameters weigh.
        solver: what minimises the energy.
        modes: number M of joint modes.
        loss_weights: lambda of ``imitation`` and ``probability``; the goal is given, so L_goal has no term here.
        own_start, pair_start: weights that a network output of zero stands for.
        control_scale: initial control that a network output of one stands for.
        relaxation, relaxation_steps: see :class:`~epo_lightning.losses.Relaxation`.
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        backbone: Backbone,
        energy: Energy,
        solver: LevenbergMarquardt,
        modes: int,
        loss_weights: Mapping[str, float],
        own_start: float = 1.0,
        pair_start: float = 3.0,
        control_scale: float = 0.3,
        relaxation: float = 0.0,
        relaxation_steps: int = 1000,
    ) -> None:
        lacking = energy.needs - {"goals", "size"}
        if lacking:
            raise ConfigError(
                f"features of energy.own need {', '.join(sorted(lacking))}, which neither the data nor this forecaster "
                "provide: leave them out, or give them to the layer yourself (docs/solver.md)"
            )
        super().__init__(task, optimizer)
        self.backbone, self.energy, self.solver, self.modes = backbone, energy, solver, modes
        self.loss_weights = weights_of(loss_weights, ("imitation", "probability"))
        self.relaxation = Relaxation(relaxation, relaxation_steps)
        self.own_weights = OwnWeights(backbone.width, modes, energy.own, own_start)
        self.pair_weights = PairWeights(backbone.width, modes, energy.pair, pair_start)
        self.strategies = InitialStrategies(backbone.width, modes, task.horizon, control_scale)
        self.probabilities = SceneProbabilities(backbone.width, modes, task.horizon)

    def forward(self, scene: Scene) -> JointForecast:
        z = self.backbone(scene)
        parameters = self.infer(scene, z)
        solver = self.solver if self.training else self.solver.for_test()
        solution = solver(self.energy, scene, parameters)
        current = scene.current.where(scene.agent_mask[..., None], 0.0)
        initial_states = self.energy.dynamics.rollout(current[:, None], parameters.initial_controls, scene.dt)
        return JointForecast(
            states=solution.states,
            probabilities=self.probabilities(z, solution.states[..., :2], current[..., :2], scene.agent_mask),
            controls=solution.controls,
            initial_states=initial_states,
            parameters=parameters,
            solution=solution,
        )

    def infer(self, scene: Scene, z: Tensor) -> GameParameters:
        """The game of every mode: decoded weights and initial strategies, and the given goals."""
        goals = None
        if self.energy.needs_goals:
            given = given_goals(scene)[:, None]
            goals = given.expand(-1, self.modes, -1, -1)
        return GameParameters(
            own_weights=self.own_weights(z, scene.agent_mask),
            pair_weights=self.pair_weights(z),
            initial_controls=self.strategies(z),
            goals=goals,
        )

    def explain(self, scene: Scene, forecast: JointForecast) -> JointForecast:
        assert forecast.parameters is not None
        assert forecast.controls is not None
        terms = self.energy.terms(scene, forecast.parameters, forecast.controls)
        return dataclasses.replace(
            forecast,
            own_energy={name: terms[name] for name in self.energy.own},
            pair_energy={name: terms[name] for name in self.energy.pair},
        )

    def losses(self, scene: Scene, forecast: JointForecast) -> dict[str, tuple[float, Tensor]]:
        return joint_losses(scene, forecast, self.loss_weights, self.relaxation.at(self.global_step))
