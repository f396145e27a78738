"""The paper's own forecaster: the network infers a game, and the forecast is its solution (+EPO, Algorithm 1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from torch import Tensor

from epo_lightning import losses
from epo_lightning.backbones.base import Backbone
from epo_lightning.decoders.goals import NO_CANDIDATE, GoalDecoder, choose, given_goals, goal_candidates, most_likely
from epo_lightning.decoders.probabilities import SceneProbabilities
from epo_lightning.decoders.strategies import InitialStrategies
from epo_lightning.decoders.weights import OwnWeights, PairWeights
from epo_lightning.forecasters.base import Forecaster, Task, observed_future, weights_of
from epo_lightning.forecasters.scene_consistent import joint_losses
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.optimizers import Adam
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import GameParameters, JointForecast, Scene
from epo_lightning.solvers.levenberg_marquardt import LevenbergMarquardt

INITIAL = ("decoded", "zero")
"""Where solutions start: at strategies of the network's, or (the paper's ablation "no init") at controls of zero."""


@register("forecaster", "epo")
class EPO(Forecaster):
    """Weights, goals and initial strategies from the network; joint strategies from the energy's minimisation.

    Where the data has several goal candidates and the energy a goal or a lane, mode m of an agent heads for its m-th most
    likely candidate, along the line on which that lies. A single candidate is a given goal, of all modes.

    Args:
        backbone: the observation encoder phi_glob.
        energy: what the network's parameters weigh.
        solver: what minimises the energy.
        modes: number M of joint modes.
        loss_weights: lambda of ``imitation``, ``goal`` (idle where no goal is decoded) and ``probability``.
        own_start: own weights that a network output of zero stands for, which scale it as well: one number, or some by the
            feature's name while the others are 1. ``vel`` pulls speeds towards zero and has to start small on highways.
        pair_start: pair weight that a network output of zero stands for.
        symmetric_pairs: whether pair weights ignore which agent comes first, so that forecasts do not depend on the order of
            agents.
        initial: ``decoded`` or ``zero``.
        control_scale: initial control that a network output of one stands for.
        relaxation, relaxation_steps: see :class:`~epo_lightning.losses.Relaxation`.
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        backbone: Backbone,
        energy: FeatureEnergy,
        solver: LevenbergMarquardt,
        modes: int,
        loss_weights: Mapping[str, float],
        own_start: float | Mapping[str, float] = 1.0,
        pair_start: float = 3.0,
        symmetric_pairs: bool = False,
        initial: str = "decoded",
        control_scale: float = 0.3,
        relaxation: float = 0.0,
        relaxation_steps: int = 1000,
    ) -> None:
        known = {"size"} | ({"goals"} if task.candidates else set())
        lacking = energy.needs - known - ({"reference", "reference_speed"} if task.candidates > 1 else set())
        if lacking:
            raise ConfigError(
                f"features of energy.own need {', '.join(sorted(lacking))}, which this data does not give: leave them out, "
                "or choose data with a map"
            )
        if initial not in INITIAL:
            raise ConfigError(f"unknown forecaster.initial {initial!r}: {nearest(str(initial), INITIAL)}")
        super().__init__(task, optimizer)
        self.backbone, self.energy, self.solver, self.modes = backbone, energy, solver, modes
        width, scale = backbone.width, task.scale
        decodes_goals = task.candidates > 1 and bool(energy.needs & {"goals", "reference"})
        if decodes_goals:
            self.loss_weights = weights_of(loss_weights, ("imitation", "goal", "probability"))
        else:
            self.loss_weights = weights_of(loss_weights, ("imitation", "probability"), idle=("goal",))
        self.relaxation = losses.Relaxation(relaxation, relaxation_steps)
        self.own_weights = OwnWeights(width, modes, energy.own, _checked(own_start, energy.own))
        self.pair_weights = PairWeights(width, modes, energy.pair, pair_start, symmetric_pairs)
        decodes_strategies = initial == "decoded"
        self.strategies = InitialStrategies(width, modes, task.horizon, control_scale) if decodes_strategies else None
        self.probabilities = SceneProbabilities(width, modes, task.horizon, scale)
        self.goals = GoalDecoder(width, scale) if decodes_goals else None

    def forward(self, scene: Scene) -> JointForecast:
        z = self.backbone(scene)
        logits = None if self.goals is None else self.goals(z, scene)
        parameters = self.infer(scene, z, logits)
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
            goal_probabilities=None if logits is None else logits.softmax(-1).where(logits > NO_CANDIDATE, 0.0),
        )

    def infer(self, scene: Scene, z: Tensor, logits: Tensor | None = None) -> GameParameters:
        """The game of every mode: decoded weights and initial strategies, and goals, given or chosen by their ``logits``.

        Raises:
            ValueError: the scene lacks the goals or the reference lines that the energy asks for.
        """
        own_weights = self.own_weights(z, scene.agent_mask)
        goals = reference = None
        if logits is not None:
            goals, reference = choose(scene, most_likely(logits, self.modes))
            if "reference" in self.energy.needs and reference is None:
                raise ValueError("the energy follows reference lines, but scene.goal_reference [B, N, G] is None")
            # Who has no candidate heads nowhere, not for the origin.
            heads = (logits > NO_CANDIDATE).any(-1)[:, None]
            for name, feature in self.energy.own_features.items():
                if feature.needs in ("goals", "reference"):
                    own_weights[name] = own_weights[name].where(heads, 0.0)
        elif self.energy.needs_goals:
            goals = given_goals(scene)[:, None].expand(-1, self.modes, -1, -1)
        if self.strategies is None:
            batch, agents, _ = z.shape
            initial_controls = z.new_zeros(batch, self.modes, agents, self.task.horizon, 2)
        else:
            initial_controls = self.strategies(z)
        return GameParameters(
            own_weights=own_weights,
            pair_weights=self.pair_weights(z),
            initial_controls=initial_controls,
            goals=goals,
            reference=reference,
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
        terms = joint_losses(scene, forecast, self.loss_weights, self.relaxation.at(self.global_step))
        if forecast.goal_probabilities is not None:
            future, mask = observed_future(scene)
            final, observed = future[:, :, -1, :2], mask[:, :, -1]
            goal = losses.goal(forecast.goal_probabilities, *goal_candidates(scene), final, observed)
            terms["goal"] = (self.loss_weights["goal"], goal)
        return terms


def _checked(start: float | Mapping[str, float], features: Sequence[str]) -> float | Mapping[str, float]:
    """The weights that own features start from.

    Raises:
        ConfigError: the name of a feature that the energy does not have, or a weight that is not positive.
    """
    named = start if isinstance(start, Mapping) else dict.fromkeys(features, start)
    for name, value in named.items():
        if name not in features:
            raise ConfigError(f"unknown feature forecaster.own_start.{name}: {nearest(name, features)}")
        if not value > 0:
            raise ConfigError(f"forecaster.own_start must be positive, but {name} would start at {value}")
    return start
