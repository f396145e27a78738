"""The scene-consistent baselines, which decode joint controls without a game (+SC)."""

from __future__ import annotations

from collections.abc import Mapping

from epo_lightning.backbones.base import Backbone
from epo_lightning.checks import check_choice
from epo_lightning.decoders.probabilities import PROBABILITIES
from epo_lightning.decoders.strategies import InitialStrategies
from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.objectives.base import Terms, checked_weights
from epo_lightning.objectives.terms import imitation_terms
from epo_lightning.optimizers import Adam
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.schedules import Annealing, ImitationSchedule, Relaxation
from epo_lightning.task import Task


@register("forecaster", "scene_consistent")
class SceneConsistent(Forecaster):
    """Forecaster of the controls of all agents, trained by minSADE and scene probability loss (Section 5, "Baselines").

    Args:
        backbone: the observation encoder.
        dynamics: the model that turns controls into states.
        modes: number M of joint modes.
        loss_weights: lambda of ``imitation`` and ``probability``.
        control_scale: control at a network output of one.
        relaxation, relaxation_steps: see :class:`~epo_lightning.schedules.Relaxation`.
        annealing, annealing_steps: temperature [m] and duration of an :class:`~epo_lightning.schedules.Annealing`.
        power: 1 for Euclidean distances; above, exponent of each coordinate's error; see
            :func:`~epo_lightning.losses.distances`.
        probabilities: decoder of the modes' probabilities, ``linear`` (the paper's) or ``pairwise``
            (:mod:`~epo_lightning.decoders.probabilities`).
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        backbone: Backbone,
        dynamics: Unicycle,
        modes: int,
        loss_weights: Mapping[str, float],
        control_scale: float = 0.3,
        relaxation: float = 0.0,
        relaxation_steps: int = 1000,
        annealing: float = 0.0,
        annealing_steps: int = 2000,
        power: float = 1.0,
        probabilities: str = "linear",
    ) -> None:
        check_choice("forecaster.probabilities", probabilities, PROBABILITIES)
        super().__init__(task, optimizer)
        self.backbone = backbone
        self.dynamics = dynamics
        self.loss_weights = checked_weights(loss_weights, ("imitation", "probability"), "forecaster.loss_weights")
        self.schedule = ImitationSchedule(
            power, Relaxation(relaxation, relaxation_steps), Annealing(annealing, annealing_steps)
        )
        self.strategies = InitialStrategies(backbone.width, modes, task.horizon, control_scale)
        self.probabilities = PROBABILITIES[probabilities](backbone.width, modes, task.horizon, task.scale)

    def forward(self, scene: Scene) -> JointForecast:
        z = self.backbone(scene)
        controls = self.strategies(z, scene)
        current = scene.current_or_zero
        states = self.dynamics.rollout(current[:, None], controls, scene.dt)
        logits = self.probabilities(z, states[..., :2], current, scene.agent_mask)
        return JointForecast(states, logits.softmax(1), controls=controls, logits=logits)

    def losses(self, scene: Scene, forecast: JointForecast) -> Terms:
        return imitation_terms(scene, forecast, self.loss_weights, self.schedule.at(self.global_step))
