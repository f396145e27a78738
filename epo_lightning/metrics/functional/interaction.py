"""Interactive scenes: two agents would collide if no agent reacted, and they do not.

Average scores hardly show whether a forecaster understands interaction, because in most scenes of traffic no agent has to
react to another one. Scores on interactive scenes apart show it.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.metrics.functional.overlap import overlapping_pairs
from epo_lightning.scene import HEADING, SPEED, Scene, heading_vector, wrapped

INTERACTIVE = "interactive"
SUBSETS = ("calm", INTERACTIVE)
"""Names of the two subsets of recorded data; ``Scene.subset`` is 1 for interactive scenes."""

ALERT = 1.0
"""Time to collision [s] below which two agents are in conflict."""
STEP = 0.1
"""Largest time [s] between two moments at which futures without a reaction are compared."""


def interactive_scenes(scene: Scene, shape: str = "disc") -> Bool[Tensor, " B"]:
    """Mask of the scenes in which two agents would collide if no agent reacted, and do not: an agent yields.

    Two agents i and j interact if both statements hold:

    - *Conflict.* If both kept their speed at t0, they would overlap, or have a time to collision below 1 s, at some
      moment of the horizon K dt. The time to collision of two agents that keep their velocities counts down evenly to their
      first overlap, so both conditions together say that they would overlap before K dt + 1 s.
    - *Resolution.* They do not overlap at t0 or in the recorded future, nor in the second after it if they keep their last
      velocities. Both statements speak about the same time span: otherwise two agents that approach each other until the
      end of the recording would count, although no agent has yielded yet.

    Agents that keep their speed move along the way that they really take where the scene has a map, and straight ahead at
    the end of it; without a map they move straight ahead from t0. On a road, straight lines from t0 leave the road in every
    bend and after every change of lane, and most conflicts that they find are of this kind. In open space there is no way to
    follow, and to leave the straight line is itself how pedestrians yield.

    Agents that are absent, or not observed in the whole future, do not count. Outlines are compared every 0.1 s at most in
    futures without a reaction, and at the recorded steps in the recorded future.

    Args:
        scene: scenes with futures and sizes.
        shape: outline of the agents, ``disc`` or ``box``; the one of the overlap rates.

    Raises:
        ValueError: the scene has no future or no sizes.
        ConfigError: an unknown shape.

    Example:
        A vehicle at 20 m/s, 30 m behind the rear of another one at 10 m/s, brakes to its speed at once or goes on:

        >>> from epo_lightning.metrics.functional import interactive_scenes
        >>> time = 0.5 * torch.arange(1, 9)
        >>> def road(x: Tensor, speed: float) -> Tensor:
        ...     zero = torch.zeros_like(x)
        ...     return torch.stack((x, zero, zero, torch.full_like(x, speed)), -1)
        >>> now = torch.stack((road(torch.tensor([0.0]), 20.0), road(torch.tensor([35.0]), 10.0)))
        >>> ahead = road(35.0 + 10.0 * time, 10.0)
        >>> braking, going_on = road(10.0 * time, 10.0), road(20.0 * time, 20.0)
        >>> future = torch.stack([torch.stack((braking, ahead)), torch.stack((going_on, ahead))])
        >>> size = torch.tensor([5.0, 2.0]).expand(2, 2, 2)
        >>> scene = Scene(now.expand(2, -1, -1, -1), dt=0.5, future=future, size=size)
        >>> interactive_scenes(scene, "box")
        tensor([ True, False])
    """
    return interacting_pairs(scene, shape).any(1)


def interacting_pairs(scene: Scene, shape: str = "disc") -> Bool[Tensor, "B P"]:
    """Mask of the pairs i < j, in the order of ``torch.triu_indices(N, N, 1)``, that interact; see
    :func:`interactive_scenes`."""
    if scene.future is None or scene.future_mask is None:
        raise ValueError("interactive scenes are found by scene.future [B, N, K, 4], which is None")
    if scene.size is None:
        raise ValueError("interactive scenes are found by scene.size [B, N, 2], which is None")
    observed = scene.agent_mask & scene.future_mask.all(-1)
    now, future = scene.current, scene.future
    span = future.shape[2] * scene.dt + ALERT
    steps = math.ceil(span / STEP - 1e-6)
    times = torch.arange(1, steps + 1, dtype=now.dtype, device=now.device) * (span / steps)
    way = torch.cat((now[:, :, None], future), 2)
    unchanged = straight_on(now, times) if scene.lanes is None else along(way, now[..., SPEED], times)
    conflict = _overlap(unchanged, scene.size, observed, shape)
    rest = math.ceil(ALERT / scene.dt - 1e-6)
    after = torch.arange(1, rest + 1, dtype=now.dtype, device=now.device) * (ALERT / rest)
    return conflict & ~_overlap(torch.cat((way, straight_on(future[:, :, -1], after)), 2), scene.size, observed, shape)


def straight_on(states: Float[Tensor, "*B 4"], times: Float[Tensor, " T"]) -> Float[Tensor, "*B T 4"]:
    """States of agents that keep their velocity for each of the times [s]."""
    ahead = heading_vector(states[..., HEADING])
    moved = states[..., None, :2] + (states[..., SPEED, None] * times)[..., None] * ahead[..., None, :]
    return torch.cat((moved, states[..., None, 2:].expand(*moved.shape[:-1], 2)), -1)


def along(
    way: Float[Tensor, "*B K 4"], speed: Float[Tensor, "*B"], times: Float[Tensor, " T"]
) -> Float[Tensor, "*B T 4"]:
    """States of agents that follow a way at a constant speed, and go straight on at its end.

    Args:
        way: states from the present one on; their speeds are not read.
        speed: speed of each agent [m/s]; agents that move backwards stand still.
        times: times [s].
    """
    length = torch.linalg.vector_norm(way[..., 1:, :2] - way[..., :-1, :2], dim=-1)
    arc = torch.cat((torch.zeros_like(length[..., :1]), length.cumsum(-1)), -1)
    speed = speed.clamp_min(0.0)
    target = speed[..., None] * times
    after = torch.searchsorted(arc.contiguous(), target.contiguous(), right=True).clamp_max(way.shape[-2] - 1)
    before = after - 1
    low, high = arc.gather(-1, before), arc.gather(-1, after)
    share = ((target - low) / (high - low).clamp_min(1e-9)).clamp(0.0, 1.0)[..., None]
    low, high = (way.gather(-2, at[..., None].expand(*at.shape, 4)) for at in (before, after))
    change = high - low
    heading = low[..., HEADING] + share[..., 0] * wrapped(change[..., HEADING])
    beyond = (target - arc[..., -1:]).clamp_min(0.0)
    ahead = heading_vector(heading)
    place = low[..., :2] + share * change[..., :2] + beyond[..., None] * ahead
    return torch.cat((place, heading[..., None], speed[..., None, None].expand_as(heading[..., None])), -1)


def _overlap(
    states: Float[Tensor, "B N T 4"], size: Float[Tensor, "B N 2"], present: Bool[Tensor, "B N"], shape: str
) -> Bool[Tensor, "B P"]:
    """Pairs that overlap at any time. Outlines are compared only where the circles around them overlap, which is rare."""
    first, second = torch.triu_indices(states.shape[1], states.shape[1], 1, device=states.device)
    reach = torch.linalg.vector_norm(size, dim=-1) / 2
    apart = torch.linalg.vector_norm(states[:, first, :, :2] - states[:, second, :, :2], dim=-1)
    # A disc's diameter is the agent's length, which is less than the diagonal.
    near = (apart < (reach[:, first] + reach[:, second])[..., None]) & (present[:, first] & present[:, second])[
        ..., None
    ]
    scene, pair, time = near.nonzero(as_tuple=True)
    members = torch.stack((first[pair], second[pair]), 1)
    both = states[scene[:, None], members, time[:, None]][:, :, None]
    sizes = size[scene[:, None], members]
    touching = overlapping_pairs(both, sizes, torch.ones_like(sizes[..., 0], dtype=torch.bool), shape)[:, 0]
    found = torch.zeros_like(near[..., 0])
    found[scene[touching], pair[touching]] = True
    return found
