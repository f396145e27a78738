"""Agent history encoders: from what an agent did to one feature vector."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from epo_lightning.scene import Scene

VECTOR = 5
"""Features of a history vector: where it starts, where it ends (x, y each) and when it ends."""


class LSTMHistory(nn.Module):
    """Reads an agent's history as a polyline of vectors, oldest first (Appendix C.1, "Agent History Encoder").

    A vector holds the 2-D positions in which a step starts and ends and the time at which it ends, as in VectorNet.
    Vectors of unobserved steps are left out: the others close ranks, so that any padding gives the same feature.

    Args:
        width: size of the hidden state.
        depth: number of stacked LSTM layers.
    """

    def __init__(self, width: int = 64, depth: int = 3) -> None:
        super().__init__()
        self.width = width
        self.lstm = nn.LSTM(VECTOR, width, num_layers=depth, batch_first=True)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """The feature of every agent; what it holds for absent agents is of no meaning.

        Raises:
            ValueError: a history of a single state, which shows no motion.
        """
        if scene.history.shape[2] < 2:
            raise ValueError("scene.history holds H = 1 state per agent; reading a motion takes at least 2")
        observed = scene.history_mask & scene.agent_mask[..., None]
        position = torch.where(observed[..., None], scene.history[..., :2], 0.0)
        batch, agents, steps = observed.shape
        time = scene.dt * torch.arange(2 - steps, 1, dtype=position.dtype, device=position.device)
        time = time[:, None].expand(batch, agents, steps - 1, 1)
        vectors = torch.cat((position[..., :-1, :], position[..., 1:, :], time), -1).flatten(0, 1)
        valid = (observed[..., :-1] & observed[..., 1:]).flatten(0, 1)
        # A stable sort moves the observed vectors to the front. The LSTM is causal: what stands behind them cannot matter.
        order = (~valid).to(torch.uint8).argsort(dim=1, stable=True)
        states, _ = self.lstm(vectors.gather(1, order[..., None].expand_as(vectors)))
        last = (valid.sum(1) - 1).clamp_min(0)
        return states[torch.arange(len(last), device=last.device), last].view(batch, agents, self.width)
