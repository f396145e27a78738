"""The kinematic baseline: every agent keeps its speed and heading."""

from __future__ import annotations

import torch
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.optimizers import Adam
from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.task import Task


@register("forecaster", "constant_velocity")
class ConstantVelocity(Forecaster):
    """Const. Vel.: one joint future with controls of zero (Section 5, "Baselines"). Nothing is learned."""

    reads_history = False

    def __init__(self, task: Task, optimizer: Adam, dynamics: Unicycle) -> None:
        super().__init__(task, optimizer)
        self.dynamics = dynamics

    def forward(self, scene: Scene) -> JointForecast:
        batch, agents = scene.agent_mask.shape
        controls = scene.history.new_zeros(batch, 1, agents, self.task.horizon, 2)
        return JointForecast(
            states=self.dynamics.rollout(scene.current_or_zero[:, None], controls, scene.dt),
            probabilities=scene.history.new_ones(batch, 1),
            controls=controls,
        )

    def losses(self, scene: Scene, forecast: JointForecast) -> dict[str, tuple[float, Tensor]]:
        return {"imitation": (1.0, torch.zeros((), device=scene.history.device))}
