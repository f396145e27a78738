"""The Gauss-Newton model of an energy around a joint strategy: g = J^T r and J^T J."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.energy import Energy
from epo_lightning.scene import GameParameters, Scene


def normal_equations(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> tuple[Float[Tensor, "B M N K 2"], Float[Tensor, "B M n n"]]:
    """Gradient g = J^T r and Gauss-Newton matrix J^T J of the energy, n = N K 2 unknowns in the order of ``controls``."""
    unknowns = controls[0, 0].numel()
    directions = torch.eye(unknowns, dtype=controls.dtype, device=controls.device)
    directions = directions.view(unknowns, 1, 1, *controls.shape[2:]).expand(-1, *controls.shape)
    residuals, changes = energy.linearisation(scene, parameters, controls, directions)
    jacobian = changes.permute(1, 2, 0, 3)
    return (jacobian @ residuals[..., None]).view_as(controls), jacobian @ jacobian.mT
