"""Overlaps of agents in the most likely joint prediction (Section 5, Metrics; OR in the tables).

Two definitions are in use, both for the most likely joint mode only:

``jfp``
    1 if any two agents overlap at any step, else 0 (JFP, MotionLM). A rate in [0, 1] when averaged over scenes.
``authors``
    the number of pairs that overlap at any step, divided by the number of agents, as the authors' code counts. With two
    agents this is half of ``jfp``.

and two shapes: ``disc`` (radius = half of the agent's length, the RPI environment) and ``box`` (oriented rectangles of
length times width). Agents that only touch share no area and do not overlap.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.checks import check_choice
from epo_lightning.scene import HEADING, SHAPES

DEFINITIONS = ("jfp", "authors")

TOUCH = 1e-6
"""Depth [m] up to which an overlap counts as touching (a rounding error)."""


def overlap_rate(
    states: Float[Tensor, "B M N K 4"],
    probabilities: Float[Tensor, "B M"],
    size: Float[Tensor, "B N 2"],
    agent_mask: Bool[Tensor, "B N"],
    definition: str = "jfp",
    shape: str = "disc",
) -> Float[Tensor, " B"]:
    """Overlap rate of the most likely joint mode of each scene.

    Args:
        states: predictions of all agents at all steps, observed later or not.
        probabilities: probabilities of the joint modes; if several are the largest, the first of these modes is taken.
        size: length and width [m].
        agent_mask: agents that exist.
        definition: ``jfp`` or ``authors``, see the module.
        shape: ``disc`` or ``box``.

    Returns:
        One value per scene; NaN for a scene without agents. If a predicted state is not finite, the value is infinite, so
        that a broken forecast is not mistaken for one without overlaps.

    Raises:
        ConfigError: an unknown definition or shape.

    Example:
        Two discs of 2 m diameter, 1 m apart:

        >>> states = torch.tensor([[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]).view(1, 1, 2, 1, 4)
        >>> one, size, present = torch.ones(1, 1), torch.full((1, 2, 2), 2.0), torch.ones(1, 2, dtype=torch.bool)
        >>> overlap_rate(states, one, size, present)
        tensor([1.])
        >>> overlap_rate(states, one, size, present, definition="authors")
        tensor([0.5000])
    """
    check_choice("definition", definition, DEFINITIONS, of="an overlap rate")
    jfp, authors = overlap_rates(states, probabilities, size, agent_mask, shape)
    return jfp if definition == "jfp" else authors


def overlap_rates(
    states: Float[Tensor, "B M N K 4"],
    probabilities: Float[Tensor, "B M"],
    size: Float[Tensor, "B N 2"],
    agent_mask: Bool[Tensor, "B N"],
    shape: str = "disc",
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """Overlap rates by both definitions, ``jfp`` and ``authors``; see :func:`overlap_rate`."""
    likely = probabilities.argmax(1)
    chosen = states[torch.arange(len(states), device=states.device), likely]
    pairs = overlapping_pairs(chosen, size, agent_mask, shape)
    agents = agent_mask.sum(-1)
    broken = (~chosen.isfinite().flatten(2).all(-1) & agent_mask).any(-1)

    def valid(rate: Tensor) -> Tensor:
        return rate.to(states.dtype).masked_fill(broken, torch.inf).masked_fill(agents == 0, torch.nan)

    return valid(pairs.any(-1)), valid(pairs.sum(-1).to(states.dtype) / agents)


def overlapping_pairs(
    states: Float[Tensor, "B N K 4"], size: Float[Tensor, "B N 2"], agent_mask: Bool[Tensor, "B N"], shape: str = "disc"
) -> Bool[Tensor, "B P"]:
    """Pairs i < j, in the order of ``torch.triu_indices(N, N, 1)``, that overlap at any step.

    Raises:
        ConfigError: an unknown shape.
    """
    return overlaps(states, size, agent_mask, shape).any(-1)


def overlaps(
    states: Float[Tensor, "B N K 4"], size: Float[Tensor, "B N 2"], agent_mask: Bool[Tensor, "B N"], shape: str = "disc"
) -> Bool[Tensor, "B P K"]:
    """Steps at which pairs i < j overlap; see :func:`overlapping_pairs`.

    Raises:
        ConfigError: an unknown shape.
    """
    overlap = _test_of(shape)
    first, second = torch.triu_indices(states.shape[1], states.shape[1], 1, device=states.device)
    at_step = overlap(states[:, first], states[:, second], size[:, first, None], size[:, second, None])
    return at_step & (agent_mask[:, first] & agent_mask[:, second])[..., None]


def overlaps_with(
    agent: int,
    states: Float[Tensor, "B N K 4"],
    size: Float[Tensor, "B N 2"],
    agent_mask: Bool[Tensor, "B N"],
    shape: str = "disc",
) -> Bool[Tensor, "B P K"]:
    """Steps at which one agent overlaps each of the others, P = N - 1; see :func:`overlapping_pairs`.

    Raises:
        ConfigError: an unknown shape.
    """
    overlap = _test_of(shape)
    others = torch.arange(states.shape[1], device=states.device) != agent
    one = states[:, agent, None].expand(-1, states.shape[1] - 1, -1, -1)
    size_of_one = size[:, agent, None, None].expand(-1, states.shape[1] - 1, -1, -1)
    at_step = overlap(one, states[:, others], size_of_one, size[:, others, None])
    return at_step & (agent_mask[:, others] & agent_mask[:, agent, None])[..., None]


def _test_of(shape: str) -> Callable[..., Tensor]:
    """The function that tests outlines of a shape."""
    check_choice("shape", shape, SHAPES, of="agents")
    return _discs_overlap if shape == "disc" else _boxes_overlap


def _discs_overlap(
    a: Float[Tensor, "B P K 4"],
    b: Float[Tensor, "B P K 4"],
    size_a: Float[Tensor, "B P 1 2"],
    size_b: Float[Tensor, "B P 1 2"],
) -> Bool[Tensor, "B P K"]:
    """Overlaps of discs: centres nearer than the sum of the radii."""
    distance = torch.linalg.vector_norm(a[..., :2] - b[..., :2], dim=-1)
    return distance < (size_a[..., 0] + size_b[..., 0]) / 2 - TOUCH


def _boxes_overlap(
    a: Float[Tensor, "B P K 4"],
    b: Float[Tensor, "B P K 4"],
    size_a: Float[Tensor, "B P 1 2"],
    size_b: Float[Tensor, "B P 1 2"],
) -> Bool[Tensor, "B P K"]:
    """Overlaps of rectangles, by separating axes: they are apart if and only if their projections on the direction of one
    of their sides are."""
    axes_a, axes_b = _axes(a[..., HEADING]), _axes(b[..., HEADING])
    directions = torch.cat([axes_a, axes_b], dim=-2)  # B P K 4 2
    offset = b[..., :2] - a[..., :2]
    between = torch.einsum("bpkdx,bpkx->bpkd", directions, offset).abs()
    extent_a = torch.einsum("bpkdx,bpkex,bpe->bpkde", directions, axes_a, size_a[:, :, 0] / 2).abs().sum(-1)
    extent_b = torch.einsum("bpkdx,bpkex,bpe->bpkde", directions, axes_b, size_b[:, :, 0] / 2).abs().sum(-1)
    return (between < extent_a + extent_b - TOUCH).all(-1)


def _axes(heading: Float[Tensor, "B P K"]) -> Float[Tensor, "B P K 2 2"]:
    """Unit vectors along and across an agent."""
    cos, sin = heading.cos(), heading.sin()
    return torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)
