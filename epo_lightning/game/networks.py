"""Building blocks of network energies: trajectories in an agent's own frame, encounters, and small networks.

All are smooth in the states, except for the step at which two agents are nearest, which is held constant: second
derivatives exist, as implicit differentiation needs them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from epo_lightning.game.circles import length_of
from epo_lightning.scene import HEADING, SPEED, rotated

MOTION, ENCOUNTER = 5, 6
"""Number of values that describe an agent's state at one step, and the encounter of two agents."""


def motion(
    states: Float[Tensor, "*batch K 4"], initial: Float[Tensor, "*#batch 4"], scale: float
) -> Float[Tensor, "*batch K 5"]:
    """An agent's states in its own frame at t0: position (x, y), cosine and sine of the heading, and speed.

    Heading and speed are included because the last position does not depend on the last controls (explicit Euler).

    Args:
        states: x_1 .. x_K.
        initial: x_0, whose position and heading define the frame.
        scale: metres, and metres per second, per unit of the values.
    """
    start = initial[..., None, :]
    place = rotated(states[..., :2] - start[..., :2], -start[..., HEADING]) / scale
    heading = states[..., HEADING] - start[..., HEADING]
    return torch.cat((place, torch.stack((heading.cos(), heading.sin(), states[..., SPEED] / scale), -1)), -1)


@torch.no_grad()
def squared_distances(
    first: Float[Tensor, "*#batch K 4"], second: Float[Tensor, "*#batch K 4"]
) -> Iterator[Float[Tensor, "..."]]:
    """Squared distances of two agents [m^2], step by step, without a gradient.

    They are computed one step at a time, so that the memory is one number per pair of candidates, not one per step.
    """
    (ours_x, ours_y), (theirs_x, theirs_y) = (states[..., :2].unbind(-1) for states in (first, second))
    for k in range(first.shape[-2]):
        x, y = ours_x[..., k] - theirs_x[..., k], ours_y[..., k] - theirs_y[..., k]
        yield x.mul_(x).addcmul_(y, y)


@torch.no_grad()
def nearest(first: Float[Tensor, "*#batch K 4"], second: Float[Tensor, "*#batch K 4"]) -> Int[Tensor, "*batch"]:
    """The step at which two agents are nearest to each other, the first one on a tie, without a gradient."""
    distances = squared_distances(first, second)
    least = next(distances)
    step = torch.zeros_like(least, dtype=torch.int64)
    for k, squared in enumerate(distances, 1):
        step, least = torch.where(squared < least, k, step), torch.minimum(least, squared)
    return step


def encounter(
    first: Float[Tensor, "*#batch K 4"], second: Float[Tensor, "*#batch K 4"], scale: float
) -> Float[Tensor, "*batch 6"]:
    """The encounter g_ij of two agents, in the frame of the first agent's last state.

    Its entries are x and y of the second agent's last position, the least distance, the time of the least distance as a
    fraction of the horizon, and cosine and sine of the second agent's last heading. Where the agents coincide, the distance
    has a gradient of zero.
    """
    step = nearest(first, second)
    shape = step.shape
    at = step[..., None, None]
    ours, theirs = (
        torch.take_along_dim(states[..., :2].expand(*shape, *states.shape[-2:-1], 2), at, -2)[..., 0, :]
        for states in (first, second)
    )
    last, their_last = (states[..., -1, :].expand(*shape, 4) for states in (first, second))
    heading = their_last[..., HEADING] - last[..., HEADING]
    place = rotated(their_last[..., :2] - last[..., :2], -last[..., HEADING]) / scale
    time = (step + 1).to(first.dtype) / first.shape[-2]
    distance = length_of(ours - theirs) / scale
    return torch.cat((place, torch.stack((distance, time, heading.cos(), heading.sin()), -1)), -1)


class Layers(nn.Module):
    """Two linear layers, each followed by SiLU; the first takes several inputs.

    Every input is mapped on its own before the results are broadcast and added, so that an input shared by many rows is
    mapped once. The layer on top needs no bias, because adding a constant to an energy has no effect.

    Args:
        inputs: sizes of the inputs.
        width: size of the features.
    """

    def __init__(self, inputs: Sequence[int], width: int) -> None:
        super().__init__()
        self.first = nn.ModuleList(nn.Linear(size, width, bias=number == 0) for number, size in enumerate(inputs))
        self.second = nn.Linear(width, width)
        self.activation = nn.SiLU()

    def forward(self, *inputs: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Features of all inputs together [.., width]; the inputs [.., size] broadcast."""
        features = self.first[0](inputs[0])
        for linear, values in zip(list(self.first)[1:], inputs[1:], strict=True):
            features = features + linear(values)
        return self.activation(self.second(self.activation(features)))
