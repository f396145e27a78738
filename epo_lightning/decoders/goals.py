"""Goal decoding: where agents are heading."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from epo_lightning.scene import Scene


def given_goals(scene: Scene) -> Float[Tensor, "B N 2"]:
    """The one goal that a scene gives for each agent, zero for absent agents (RPI: "the goal is given and not predicted").

    Raises:
        ValueError: the scene gives no goal, or several candidates of which one would have to be chosen.
    """
    if scene.goal_candidates is None:
        raise ValueError("this forecaster is told the agents' goals, but scene.goal_candidates is None")
    if scene.goal_candidates.shape[2] != 1:
        raise ValueError(
            f"this forecaster takes one given goal per agent, but scene.goal_candidates holds "
            f"{scene.goal_candidates.shape[2]}: give it shape [B, N, 1, 2]"
        )
    return scene.goal_candidates[:, :, 0].where(scene.agent_mask[..., None], 0.0)
