"""Initial strategies: joint controls at which the solver starts; for +SC, the controls of the forecast itself."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP
from epo_lightning.scene import Scene


class InitialStrategies(nn.Module):
    """phi_init: controls U_i of all modes from the agent's feature z_i, one network for all agents.

    Args:
        width: size of the agent features.
        modes: number M of joint modes.
        horizon: number K of future steps.
        scale: control [m/s^2, rad/s] at a network output of one.
    """

    def __init__(self, width: int, modes: int, horizon: int, scale: float = 0.3) -> None:
        super().__init__()
        if modes < 1:
            raise ValueError(f"modes must be 1 or more, not {modes}")
        self.modes, self.horizon, self.scale = modes, horizon, scale
        self.mlp = MLP(width, 64, modes * horizon * 2, norm="layer")

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B M N K 2"]:
        """Controls: acceleration [m/s^2] and turn rate [rad/s]."""
        controls = self.scale * self.mlp(z)
        return controls.unflatten(-1, (self.modes, self.horizon, 2)).transpose(1, 2)


class ZeroStrategies(nn.Module):
    """Controls of zero in all modes (the paper's ablation "no init"); nothing is learned.

    Args:
        modes: number M of joint modes.
        horizon: number K of future steps.
    """

    def __init__(self, modes: int, horizon: int) -> None:
        super().__init__()
        self.modes, self.horizon = modes, horizon

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B M N K 2"]:
        """Controls of zero."""
        return z.new_zeros(len(z), self.modes, z.shape[1], self.horizon, 2)
