"""Two cars whose paths cross, and an agent without others."""

from __future__ import annotations

import math

import torch

from epo_lightning import Scene, Unicycle

DT, K = 0.2, 20


def crossing(dtype: torch.dtype = torch.float32) -> tuple[Scene, torch.Tensor]:
    """Two cars at 10 m/s whose straight paths cross; one is there 0.2 s before the other."""
    start = torch.tensor([[[-20.0, 0.0, 0.0, 10.0]], [[0.0, -18.0, math.pi / 2, 10.0]]], dtype=dtype)
    scene = Scene(start[None], dt=DT, size=torch.tensor([[[4.5, 1.9], [4.5, 1.9]]], dtype=dtype))
    states = Unicycle().rollout(scene.current[:, None], torch.zeros(1, 1, 2, K, 2, dtype=dtype), DT)
    return scene, states


def alone(scene: Scene, absent: int = 0, sized: bool = False) -> Scene:
    """The first agent of a scene, with absent ones, and without sizes."""
    agents = 1 + absent
    return Scene(
        scene.history[:, :agents],
        dt=scene.dt,
        agent_mask=torch.arange(agents)[None] < 1,
        size=scene.size[:, :agents] if sized else None,
    )
