"""Games that the kernels know, both the compiled and the fused ones: types of numbers, integrators, features and agents."""

from __future__ import annotations

import torch

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, PAIR


def unknown(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, most_agents: int, kernel: str
) -> str | None:
    """Reason why a kernel does not know a game; None if it does.

    Args:
        energy, scene, parameters: the game.
        most_agents: largest number of agents of the kernel's games.
        kernel: the subject of the reason, such as "the compiled layer".
    """
    dtype, agents = parameters.initial_controls.dtype, scene.agent_mask.shape[1]
    if dtype not in (torch.float32, torch.float64):
        return f"{kernel} takes float32 and float64, not {dtype}"
    if energy.dynamics.integrator != "euler":
        return f"{kernel} integrates by euler, not {energy.dynamics.integrator}"
    for name in (*energy.own, *energy.pair):
        if name not in (*OWN, *PAIR):
            return f"{kernel} does not know the feature {name!r}"
    if energy.bounded_by_kind:
        return f"{kernel} takes bounds of all agents, not bounds of {energy.bounded_by_kind[0]!r} by kind"
    if agents > most_agents:
        return f"{kernel} takes up to {most_agents} agents, not {agents}"
    return None
