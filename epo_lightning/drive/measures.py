"""Measures of episodes, with intervals over episodes.

All worlds of one seed have the same episodes, so two planners are compared by the differences of the same episodes.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import stats
from torch import Tensor

from epo_lightning.drive.episodes import Episodes
from epo_lightning.drive.world import EGO, Outcome, World
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.metrics.functional.overlap import overlaps_with
from epo_lightning.scene import ACCELERATION, SPEED, TURN_RATE, velocities

SOON = 5.0
"""Longest time to collision [s] that is looked for; episodes without a shorter one count with it."""
_STEP, _MANY = 0.1, 4096
STILL = 0.05
"""Speed [m/s] below which an agent stands."""
RESAMPLES, CONFIDENCE = 2000, 0.95
RATES = ("collision", "deadlock", "fallback")
"""Measures that are 0 or 1 in an episode."""
UNITS: Mapping[str, str] = {
    "collision": "%",
    "deadlock": "%",
    "fallback": "%",
    "distance": "m",
    "time_to_collision": "s",
    "progress": "m",
    "jerk": "m/s³",
    "lateral": "m/s²",
    "speed": "m/s",
}
"""Units of measures. Costs have none."""


def measure(episodes: Episodes, world: World) -> dict[str, Float[Tensor, " B"]]:
    """Measures of every episode.

    - ``collision``: whether the bodies of the planned agent and another one overlap at any step.
    - ``distance``: smallest distance [m] between the centres of the planned agent and another one.
    - ``time_to_collision``: smallest time [s] until bodies would overlap if all agents kept their velocities, at most
      :data:`SOON`; zero if they do overlap.
    - ``progress``: how far the planned agent comes [m].
    - ``jerk``, ``lateral``: mean absolute change of acceleration per second, and mean absolute lateral acceleration, the
      speed times the turn rate.
    - ``deadlock``: whether the planned agent stands for ``world.patience`` although its progress is below ``world.arrived``.
    - ``fallback``: whether no plan was found at any step, so that an earlier plan was followed.
    - the measures of the world.

    Args:
        episodes: what happened.
        world: the world in which it happened.
    """
    controls, dt, happened = episodes.controls, episodes.dt, episodes.outcome
    speed = happened.states[:, EGO, :, SPEED]
    still = (speed.abs() < STILL) & (happened.progress < world.arrived) & happened.agent_mask[:, EGO]
    window = round(world.patience / dt) + 1  # states at both ends
    stood = still.unfold(1, window, 1).all(-1).any(1) if window <= still.shape[1] else torch.zeros_like(still[:, 0])
    with_ego = happened.agent_mask & happened.agent_mask[:, EGO, None]
    offset = (happened.states[:, 1:, :, :2] - happened.states[:, :1, :, :2]).norm(dim=-1)
    offset = offset.where(with_ego[:, 1:], torch.inf)
    return {
        "collision": touching(happened, world.shape).any(1).double(),
        "distance": offset.amin((1, 2)),
        "time_to_collision": _time_to_collision(happened, world.shape),
        "progress": happened.progress[:, -1],
        "jerk": _mean(controls[..., ACCELERATION].diff(dim=1).abs()) / dt,
        "lateral": _mean((speed[:, :-1] * controls[..., TURN_RATE]).abs()),
        "deadlock": stood.double(),
        "fallback": (~episodes.found).any(1).double(),
        **happened.measures,
    }


def _mean(values: Float[Tensor, "B T"]) -> Float[Tensor, " B"]:
    """Mean over time, until the end of each episode; zero for an episode without steps."""
    return values.nanmean(1).nan_to_num(0.0)


def touching(happened: Outcome, shape: str) -> Bool[Tensor, "B T+1"]:
    """Steps at which the body of the planned agent, ``disc`` or ``box``, overlaps that of another one."""
    batch, agents, steps = happened.agent_mask.shape
    states = happened.states.transpose(1, 2).reshape(batch * steps, agents, 1, 4)
    mask = happened.agent_mask.transpose(1, 2).reshape(batch * steps, agents)
    touch = overlaps_with(EGO, states, happened.size.repeat_interleave(steps, 0), mask, shape)
    return touch.flatten(1).any(1).view(batch, steps)


def _time_to_collision(happened: Outcome, shape: str) -> Float[Tensor, " B"]:
    """Smallest time [s] to an overlap at constant velocities over all steps, found in steps of a tenth of a second."""
    states = happened.states
    least = torch.full((len(states),), SOON, dtype=states.dtype)
    episode, t, other = _approaching(happened).nonzero(as_tuple=True)
    now = torch.stack((states[episode, EGO, t], states[episode, other, t]), 1)
    size = torch.stack((happened.size[episode, EGO], happened.size[episode, other]), 1)
    standing = torch.zeros(round(SOON / _STEP), 2, dtype=states.dtype)
    for some in torch.arange(len(episode)).split(_MANY):
        ahead = Unicycle().rollout(now[some], standing.expand(len(some), 2, -1, -1), _STEP)
        ahead = torch.cat((now[some][:, :, None], ahead), 2)
        there = torch.ones(len(some), 2, dtype=torch.bool)
        touch = overlaps_with(EGO, ahead, size[some], there, shape)[:, 0]
        first = torch.where(touch.any(1), touch.to(torch.int8).argmax(1) * _STEP, SOON)
        least = least.scatter_reduce(0, episode[some], first.to(least), "amin")
    return least


def _approaching(happened: Outcome) -> Bool[Tensor, "B T+1 N"]:
    """Mask of the agents whose centre would come so near to that of the planned agent, within :data:`SOON` at constant
    velocities, that bodies may overlap."""
    states = happened.states.transpose(1, 2)
    velocity = velocities(states)
    offset = states[..., :2] - states[:, :, EGO, None, :2]
    closing = velocity - velocity[:, :, EGO, None]
    slowest = torch.finfo(closing.dtype).tiny
    time = (-(offset * closing).sum(-1) / closing.square().sum(-1).clamp_min(slowest)).clamp(0.0, SOON)
    gap = (offset + time[..., None] * closing).norm(dim=-1)
    reach = happened.size.norm(dim=-1) / 2
    there = (happened.agent_mask & happened.agent_mask[:, EGO, None]).transpose(1, 2)
    others = torch.arange(states.shape[2]) != EGO
    return there & others & (gap <= (reach + reach[:, EGO, None])[:, None])


@dataclass(frozen=True)
class Estimate:
    """A mean over episodes with its 95 % interval."""

    mean: float
    low: float
    high: float


def estimate(values: Float[Tensor, " B"], rate: bool = False) -> Estimate:
    """Mean over episodes: Wilson's interval for values of 0 and 1, else the bootstrap's percentiles.

    Args:
        values: the values of the episodes.
        rate: whether the values are 0 and 1.
    """
    mean, count = float(values.mean()), len(values)
    if rate and bool(((values == 0) | (values == 1)).all()):
        interval = stats.binomtest(int(values.sum()), count).proportion_ci(CONFIDENCE, method="wilson")
        return Estimate(mean, float(interval.low), float(interval.high))
    draws = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    means = values.numpy()[draws].mean(1)
    # Nothing can be interpolated between infinite means; the distance is infinite in episodes without other agents.
    method: Literal["linear", "nearest"] = "linear" if np.isfinite(means).all() else "nearest"
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method=method)
    return Estimate(mean, float(low), float(high))


def estimates(measures: Mapping[str, Float[Tensor, " B"]], rates: Container[str] = RATES) -> dict[str, Estimate]:
    """The estimate of every measure, of which ``rates`` are 0 or 1."""
    return {name: estimate(values, name in rates) for name, values in measures.items()}


def differences(
    one: Mapping[str, Float[Tensor, " B"]], other: Mapping[str, Float[Tensor, " B"]]
) -> dict[str, Estimate]:
    """The mean of one minus other over the same episodes, for every measure; equal infinite values differ by zero."""
    return {
        name: estimate(torch.where(values == other[name], 0.0, values - other[name])) for name, values in one.items()
    }
