"""Agent history encoders: one feature vector from the observed states of an agent."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from epo_lightning.scene import Scene

VECTOR = 5
"""Entries of a history vector: start and end position (x, y each) and time of its end."""


def history_vectors(scene: Scene, scale: float = 1.0) -> tuple[Float[Tensor, "B N V 5"], Bool[Tensor, "B N V"]]:
    """Every agent's history as V = H - 1 vectors, oldest first, and the mask of vectors whose both ends were observed.

    A vector holds the 2-D positions at which a step starts and ends, in units of ``scale`` metres, and the time [s] of its
    end, as in VectorNet. An agent observed only at t0 has one vector of length zero.

    Raises:
        ValueError: a history of a single state, which contains no motion.
    """
    if scene.history.shape[2] < 2:
        raise ValueError("scene.history has H = 1 state per agent; this network needs at least 2")
    seen = scene.history_mask & scene.agent_mask[..., None]
    position = torch.where(seen[..., None], scene.history[..., :2], 0.0) / scale
    batch, agents, steps = seen.shape
    start, end = position[..., :-1, :], position[..., 1:, :]
    observed = seen[..., :-1] & seen[..., 1:]
    newest = torch.arange(2 - steps, 1, device=seen.device) == 0
    alone = ~observed.any(-1, keepdim=True) & newest
    time = scene.dt * torch.arange(2 - steps, 1, dtype=position.dtype, device=position.device)
    time = time[:, None].expand(batch, agents, steps - 1, 1)
    return torch.cat((torch.where(alone[..., None], end, start), end, time), -1), observed | alone


class LSTMHistory(nn.Module):
    """LSTM over the vectors of an agent's history, oldest first (Appendix E.1, "Agent History Encoder").

    Vectors of unobserved steps are skipped, so that padding does not change the feature.

    Args:
        width: size of the hidden state.
        depth: number of stacked LSTM layers.
        scale: metres that an input of one stands for.
    """

    def __init__(self, width: int = 64, depth: int = 3, scale: float = 1.0) -> None:
        super().__init__()
        self.width, self.scale = width, scale
        self.lstm = nn.LSTM(VECTOR, width, num_layers=depth, batch_first=True)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """The feature of every agent; for absent agents its value has no meaning.

        Raises:
            ValueError: a history of a single state.
        """
        vectors, observed = (part.flatten(0, 1) for part in history_vectors(scene, self.scale))
        # A stable sort moves the observed vectors to the front. The LSTM is causal, so the vectors after them do not matter.
        steps = torch.arange(observed.shape[1], device=observed.device)
        order = torch.where(observed, steps, steps + observed.shape[1]).argsort(dim=1)
        states, _ = self.lstm(vectors.gather(1, order[..., None].expand_as(vectors)))
        last = observed.sum(1) - 1
        return states[torch.arange(last.shape[0], device=last.device), last].view(*scene.agent_mask.shape, self.width)


class TransformerHistory(nn.Module):
    """Transformer over the vectors of an agent's history (Appendix E.1, after HiVT's temporal encoder).

    A sinusoidal encoding of its age is added to each vector, and attention is masked to observed vectors, so that padding
    has no effect. The output is the feature of the newest observed vector.

    Args:
        width: size of the tokens and of the feature.
        depth: number of layers.
        heads: number of attention heads; ``width`` must be a multiple of 2 * heads.
        scale: metres that an input of one stands for.

    Raises:
        ValueError: a width that is not a multiple of twice the heads, or no layer.
    """

    def __init__(self, width: int = 64, depth: int = 3, heads: int = 4, scale: float = 1.0) -> None:
        super().__init__()
        if heads < 1 or width % (2 * heads):
            raise ValueError(f"history_width must be a multiple of twice the number of heads ({heads}), not {width}")
        if depth < 1:
            raise ValueError(f"history_depth must be 1 or more, not {depth}")
        self.width, self.scale = width, scale
        self.embed = nn.Linear(VECTOR, width)
        self.layers = nn.ModuleList(_TransformerLayer(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width)

    def forward(self, scene: Scene) -> Float[Tensor, "B N {self.width}"]:
        """The feature of every agent; for absent agents its value has no meaning.

        Raises:
            ValueError: a history of a single state.
        """
        vectors, observed = (part.flatten(0, 1) for part in history_vectors(scene, self.scale))
        age = torch.arange(vectors.shape[1] - 1, -1, -1, device=vectors.device)
        tokens = self.embed(vectors) + _sinusoids(age, self.width).to(vectors)
        newest = torch.where(observed, age, len(age)).argmin(1)
        for layer in self.layers[:-1]:
            tokens = layer(tokens, tokens, observed)
        # Only the newest token of the last layer is read.
        reader = tokens[torch.arange(newest.shape[0], device=newest.device), newest][:, None]
        return self.norm(self.layers[-1](reader, tokens, observed)).view(*scene.agent_mask.shape, self.width)


class _TransformerLayer(nn.Module):
    """Multi-head attention and a perceptron, each after a layer normalisation and around a residual connection."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.read_norm, self.think_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query = nn.Linear(width, width, bias=False)
        self.key_value = nn.Linear(width, 2 * width, bias=False)
        self.mix = nn.Linear(width, width)
        self.think = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))

    def forward(
        self, readers: Float[Tensor, "A R D"], tokens: Float[Tensor, "A V D"], observed: Bool[Tensor, "A V"]
    ) -> Float[Tensor, "A R D"]:
        """Features of the readers, which are some of the tokens, after attention to the observed tokens."""
        query = self.query(self.read_norm(readers)).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        key, value = self.key_value(self.read_norm(tokens)).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        scores = query @ key.mT / math.sqrt(query.shape[-1])
        read = scores.masked_fill(~observed[:, None, None], -1e9).softmax(-1) @ value
        readers = readers + self.mix(read.transpose(1, 2).flatten(2))
        return readers + self.think(self.think_norm(readers))


def _sinusoids(age: Tensor, width: int) -> Float[Tensor, "V {width}"]:
    """Sines and cosines of an age in steps, with wavelengths from 2 pi to 20000 pi (Vaswani et al. 2017, Section 3.5)."""
    rate = torch.exp(-math.log(1e4) * torch.arange(0, width, 2, device=age.device) / width)
    angle = age[:, None] * rate
    return torch.cat((angle.sin(), angle.cos()), -1)
