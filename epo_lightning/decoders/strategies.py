"""Initial strategies: joint controls at which the solver starts; for +SC, the controls of the forecast itself."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.decoders.mlp import MLP
from epo_lightning.scene import Scene


class InitialStrategies(nn.Module):
    """phi_init: controls U_i, for every mode, from the agent's feature z_i, one network for all agents.

    Args:
        width: size of the agent features.
        count: number M of strategies per agent.
        horizon: number K of steps of the game, or of the forecast for forecasters without a game.
        scale: control [m/s^2, rad/s] at a network output of one.
    """

    def __init__(self, width: int, count: int, horizon: int, scale: float = 0.3) -> None:
        super().__init__()
        if count < 1:
            raise ValueError(f"modes must be 1 or more, not {count}")
        self.count, self.horizon, self.scale = count, horizon, scale
        self.mlp = MLP(width, 64, count * horizon * 2, norm="layer")

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B M N K 2"]:
        """Controls: acceleration [m/s^2] and turn rate [rad/s]."""
        controls = self.scale * self.mlp(z)
        return controls.unflatten(-1, (self.count, self.horizon, 2)).transpose(1, 2)


class ZeroStrategies(nn.Module):
    """Controls of zero in all modes (the paper's ablation "no init"); nothing is learned.

    Args:
        count: number M of strategies per agent.
        horizon: number K of steps of the game, or of the forecast for forecasters without a game.
    """

    def __init__(self, count: int, horizon: int) -> None:
        super().__init__()
        self.count, self.horizon = count, horizon

    def forward(self, z: Float[Tensor, "B N D"], scene: Scene) -> Float[Tensor, "B M N K 2"]:
        """Controls of zero."""
        return z.new_zeros(z.shape[0], self.count, z.shape[1], self.horizon, 2)
