"""The marginal baselines, which predict every agent independently of the others (V-LSTM, VIBES, HiVT-M)."""

from __future__ import annotations

from collections.abc import Mapping

from torch.nn import functional as F

from epo_lightning import losses
from epo_lightning.backbones.base import Backbone
from epo_lightning.decoders.trajectories import Trajectories
from epo_lightning.forecast import JointForecast, log_probabilities
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.game.tracking import with_motion
from epo_lightning.metrics.functional import marginal_to_joint
from epo_lightning.objectives.base import Terms, checked_weights
from epo_lightning.optimizers import Adam
from epo_lightning.registry import register
from epo_lightning.scene import Scene, observed_future
from epo_lightning.schedules import Annealing, ImitationSchedule, Relaxation
from epo_lightning.task import Task


@register("forecaster", "marginal")
class Marginal(Forecaster):
    """Forecaster of trajectories per agent, trained by minADE and a classification loss (Section 5, "Baselines").

    Joint futures are combined afterwards: each agent's modes are ordered by probability, and joint mode m consists of the
    m-th most likely mode of every agent. The network predicts positions; headings and speeds are those of the motion
    (:func:`~epo_lightning.game.tracking.with_motion`), and zero in training.

    Args:
        backbone: the observation encoder.
        modes: number M of modes.
        loss_weights: lambda of ``imitation`` and ``probability``.
        relaxation, relaxation_steps: see :class:`~epo_lightning.schedules.Relaxation`.
        annealing, annealing_steps: temperature [m] and duration of an :class:`~epo_lightning.schedules.Annealing`.
        power: 1 for Euclidean distances; above, exponent of each coordinate's error; see
            :func:`~epo_lightning.losses.distances`.
    """

    def __init__(
        self,
        task: Task,
        optimizer: Adam,
        backbone: Backbone,
        modes: int,
        loss_weights: Mapping[str, float],
        relaxation: float = 0.0,
        relaxation_steps: int = 1000,
        annealing: float = 0.0,
        annealing_steps: int = 2000,
        power: float = 1.0,
    ) -> None:
        super().__init__(task, optimizer)
        self.backbone = backbone
        self.loss_weights = checked_weights(loss_weights, ("imitation", "probability"), "forecaster.loss_weights")
        self.schedule = ImitationSchedule(
            power, Relaxation(relaxation, relaxation_steps), Annealing(annealing, annealing_steps)
        )
        self.decoder = Trajectories(backbone.width, modes, task.horizon, task.scale)

    def forward(self, scene: Scene) -> JointForecast:
        current = scene.current_or_zero
        positions, probabilities, logits = self.decoder(self.backbone(scene), current[..., :2])
        if self.training:  # no loss reads headings and speeds
            states = F.pad(positions, (0, 2))
        else:
            states = with_motion(positions, current[:, None].expand(*positions.shape[:3], 4), scene.dt)
        states, probabilities, logits = marginal_to_joint(states, probabilities, logits)
        # The product of probabilities, as a sum of logarithms: for many agents the product would underflow in float32.
        of_agents = log_probabilities(probabilities, logits, 1)
        joint = of_agents.where(scene.agent_mask[:, None], 0.0).sum(-1)
        return JointForecast(
            states=states,
            probabilities=joint.softmax(1),
            agent_probabilities=probabilities,
            logits=joint,
            agent_logits=logits,
        )

    def losses(self, scene: Scene, forecast: JointForecast) -> Terms:
        future, mask = observed_future(scene)
        power, relaxation, temperature = self.schedule.at(self.global_step)
        distance = losses.distances(forecast.states[..., :2], future, mask, power)
        imitation, mode = losses.marginal_imitation(distance, mask, relaxation, temperature)
        assert forecast.agent_log_probabilities is not None
        probability = losses.marginal_probability(forecast.agent_log_probabilities, mode, mask)
        return {
            "imitation": (self.loss_weights["imitation"], imitation),
            "probability": (self.loss_weights["probability"], probability),
        }
