"""Controls of a unicycle from its positions, in closed form: the tracking of forecasts, which has to be fast.

With explicit Euler steps, p_{k+1} = p_k + dt v_k e(theta_k): the displacements of a trajectory are its velocities, and the
changes of their direction and length are its controls (the unicycle is differentially flat). Forecast positions jitter, and
begin with another velocity than the observed one. So positions q are followed that are smooth and begin as observed,

    min_q  sum_k |q_k - p_k|^2 / noise^2 + sum_k |D^3 q_k|^2 / (J dt^3)^2,   q_0 = p_0,  q_1 = p_0 + dt v_0 e(theta_0),

with third differences D^3 and the jerk J of vehicles. The minimum is linear in p: one product with a small matrix.

:mod:`~epo_lightning.game.tracking` is for recordings, and for any dynamics; it is more accurate and slower.
"""

from __future__ import annotations

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.scene import HEADING, SPEED, velocities, wrapped

JERK = 5.0
"""J, the jerk [m/s^3] that counts as much as a difference of ``noise``."""
BRAKE = 10.0
"""Largest change of velocity [m/s^2] of an agent that comes to a stand and moves backwards in the next step."""
STILL = 1e-3
"""Least displacement [m] that tells a heading, also without noise."""


def followed_controls(
    positions: Float[Tensor, "*batch K 2"], current: Float[Tensor, "*batch 4"], dt: float, noise: float
) -> Float[Tensor, "*batch K 2"]:
    """Controls of the explicit Euler unicycle whose rollout from ``current`` follows the positions.

    The last control is zero, because it affects no position. An agent whose present speed is negative, or that stands and
    then moves against its heading, drives backwards: it keeps its heading.

    Args:
        positions: p_1 .. p_K [m].
        current: the state at t0.
        dt: length of a time step [s].
        noise: standard deviation [m] of the positions around a smooth motion; 0 to follow p_2 .. p_K exactly.
    """
    start = velocities(current)
    begin = torch.stack((current[..., :2], current[..., :2] + dt * start), -2)
    smooth = _smoothing(positions.shape[-2], noise / (JERK * dt**3)).to(positions)
    free = smooth @ torch.cat((begin, positions[..., 1:, :]), -2)
    velocity = torch.cat((begin, free), -2).diff(dim=-2) / dt  # at the nodes 0 .. K-1
    heading = torch.atan2(velocity[..., 1], velocity[..., 0])
    # Displacements shorter than the noise tell no heading: there it is that of the last node with a longer one, and
    # displacements across it are ignored. The first node has the observed direction of motion.
    backwards = current[..., SPEED, None] < 0
    observed = current[..., HEADING, None]
    heading = torch.cat((torch.where(backwards, observed + torch.pi, observed), heading[..., 1:]), -1)
    nodes = torch.arange(heading.shape[-1], device=heading.device)
    known = torch.where(dt * velocity.norm(dim=-1) > max(noise, STILL), nodes, 0).cummax(-1).values
    heading = heading.gather(-1, known)
    # Where an agent stands and then moves the other way, it keeps its heading and changes the sign of its speed.
    stands = (known[..., :-1] < nodes[:-1]) | (velocity.diff(dim=-2).norm(dim=-1) <= BRAKE * dt)
    switches = stands & (heading.diff(dim=-1).cos() < 0)
    backwards = torch.cat((backwards, backwards ^ (switches.cumsum(-1) % 2 == 1)), -1)
    heading = torch.where(backwards, heading - torch.pi, heading)
    speed = velocity[..., 0] * heading.cos() + velocity[..., 1] * heading.sin()
    speed = torch.cat((current[..., None, SPEED], speed[..., 1:]), -1)
    rates = torch.stack((speed.diff(dim=-1), wrapped(heading.diff(dim=-1))), -1) / dt
    return torch.cat((rates, torch.zeros_like(rates[..., :1, :])), -2)


@cache
def _smoothing(steps: int, ratio: float) -> Float[Tensor, "free nodes"]:
    """The matrix [K - 1, K + 1] from (q_0, q_1, p_2, .., p_K) to the smooth (q_2, .., q_K)."""
    identity = torch.eye(steps + 1, dtype=torch.float64)
    penalty = ratio**2 * identity.diff(n=3, dim=0).mT @ identity.diff(n=3, dim=0) if steps > 2 else 0.0 * identity
    normal = (penalty + identity)[2:]
    right = identity[2:].clone()
    right[:, :2] = -penalty[2:, :2]
    return torch.linalg.solve(normal[:, 2:], right)
