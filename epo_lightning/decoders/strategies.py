"""Initial strategy decoding: joint controls from which the game is solved, or which are the forecast (+SC)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP


class InitialStrategies(nn.Module):
    """phi_init: controls U_i of all modes from the agent's feature z_i, shared by all agents.

    Args:
        width: size of the agent features.
        modes: number M of joint modes.
        horizon: number K of future steps.
        scale: control [m/s^2, rad/s] that a network output of one stands for.
    """

    def __init__(self, width: int, modes: int, horizon: int, scale: float = 0.3) -> None:
        super().__init__()
        if modes < 1:
            raise ValueError(f"modes must be 1 or more, not {modes}")
        self.modes, self.horizon, self.scale = modes, horizon, scale
        self.mlp = MLP(width, 64, modes * horizon * 2, norm="layer")

    def forward(self, z: Float[Tensor, "B N D"]) -> Float[Tensor, "B M N K 2"]:
        """Controls: acceleration [m/s^2] and turn rate [rad/s]."""
        controls = self.scale * self.mlp(z)
        return controls.unflatten(-1, (self.modes, self.horizon, 2)).transpose(1, 2)
