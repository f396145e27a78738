"""Derivatives of any energy as dense arrays, by automatic differentiation: for energies whose structure no solver knows."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.energy import Energy
from epo_lightning.scene import GameParameters, Scene


def gradient(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B M N K 2"]]:
    """E and dE/du, both differentiable if gradients are recorded; zero for absent agents."""
    taped = torch.is_grad_enabled()
    with torch.enable_grad():
        if not controls.requires_grad:
            controls = controls.detach().requires_grad_()
        value = energy(scene, parameters, controls)
        (slope,) = torch.autograd.grad(value.sum(), controls, create_graph=taped)
    return (value, slope) if taped else (value.detach(), slope)
