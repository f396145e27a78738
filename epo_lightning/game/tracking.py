"""Controls that reproduce an observed motion: the demonstrations from which energies learn.

Recordings have no controls. Where controls change speed and heading, the first guess are differences of the recorded ones.
Their rollout drifts away from the recorded positions, because recordings do not obey the dynamics. A few Gauss-Newton steps
remove the drift:

    min_c sum_k |p_k(u + c) - p_k|^2 + mu |D c|^2,

with differences D in time. The correction c is smooth, not the controls: the recording keeps its detail, and where the
rollout of the guess u already matches the recording, c is zero.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.scene import HEADING, SPEED, Scene

_SMOOTHNESS = 1e-2
"""mu relative to the mean of a channel's stiffness, the diagonal of J^T J, so that it has no unit."""


@runtime_checkable
class Rollout(Protocol):
    """The part of dynamics that tracking needs."""

    def rollout(
        self, initial: Float[Tensor, "*#batch 4"], controls: Float[Tensor, "*batch K 2"], dt: float
    ) -> Float[Tensor, "*batch K 4"]:
        """The states x_1 .. x_K that controls u_0 .. u_{K-1} lead to from x_0."""
        ...


def observed_controls(
    dynamics: Rollout, scene: Scene, steps: int = 2
) -> tuple[Float[Tensor, "B N K 2"], Float[Tensor, "B N"]]:
    """Controls whose rollout follows the observed future, and the mean distance [m] to it that remains.

    Exact for futures that a unicycle with the same integrator made. For other dynamics the first guess is zero. Steps that
    were not observed have no weight; controls after an agent's last observed step (:func:`demonstrated`) and those of absent
    agents are zero. Not differentiable.

    Args:
        steps: number of Gauss-Newton steps; for every agent, only steps that reduce its distance are kept.

    Raises:
        ValueError: the scene has no future.
    """
    if scene.future is None or scene.future_mask is None:
        raise ValueError("controls are derived from scene.future [B, N, K, 4], which is None")
    with torch.no_grad():
        present, dt = scene.agent_mask, scene.dt
        seen = scene.future_mask & present[..., None]
        start = torch.where(present[..., None], scene.current, 0.0)
        future = torch.where(seen[..., None], scene.future, 0.0)
        told = demonstrated(scene)
        if isinstance(dynamics, Unicycle):
            controls = _differences(start, future, seen, dt)
        else:
            controls = future.new_zeros(*seen.shape, 2)
        guess = controls
        states = dynamics.rollout(start, controls, dt)
        missed = torch.where(seen[..., None], future[..., :2] - states[..., :2], 0.0)
        for _ in range(steps):
            trial = controls + _step(
                _reach(dynamics, start, controls, states, dt), missed, controls - guess, seen, told
            )
            reached = dynamics.rollout(start, trial, dt)
            left = torch.where(seen[..., None], future[..., :2] - reached[..., :2], 0.0)
            closer = (left.square().sum((-2, -1)) < missed.square().sum((-2, -1)))[..., None, None]
            controls, states, missed = (
                torch.where(closer, new, old) for new, old in ((trial, controls), (reached, states), (left, missed))
            )
        error = missed.norm(dim=-1).sum(-1) / seen.sum(-1).clamp_min(1)
    return controls, error


def demonstrated(scene: Scene) -> Bool[Tensor, "B N K"]:
    """Mask of the controls that an observation determines: those up to an agent's last observed step.

    Raises:
        ValueError: the scene has no future.
    """
    if scene.future_mask is None:
        raise ValueError("controls are derived from scene.future [B, N, K, 4], which is None")
    seen = scene.future_mask & scene.agent_mask[..., None]
    return seen.flip(-1).cumsum(-1).flip(-1) > 0


def _differences(
    start: Float[Tensor, "B N 4"], future: Float[Tensor, "B N K 4"], seen: Bool[Tensor, "B N K"], dt: float
) -> Float[Tensor, "B N K 2"]:
    """Changes of speed and heading per second, constant between observed steps that are not neighbours."""
    steps = seen.shape[-1]
    node = torch.arange(steps + 1, device=seen.device)
    known = torch.cat((torch.ones_like(seen[..., :1]), seen), -1)  # x_0 .. x_K
    before = torch.where(known, node, 0).cummax(-1).values[..., :-1]
    after = torch.where(known, node, steps + 1).flip(-1).cummin(-1).values.flip(-1)[..., 1:]
    ends = after <= steps
    motion = torch.cat((start[..., None, :], future), -2)[..., [SPEED, HEADING]]

    def at(index: Tensor) -> Tensor:
        return motion.gather(-2, index.clamp_max(steps)[..., None].expand(*index.shape, 2))

    speed, heading = (at(after) - at(before)).unbind(-1)
    turn = torch.remainder(heading + torch.pi, 2.0 * torch.pi) - torch.pi
    time = dt * (after - before).to(motion.dtype)
    return torch.where(ends[..., None], torch.stack((speed, turn), -1) / time[..., None], 0.0)


def _reach(
    dynamics: Rollout,
    start: Float[Tensor, "B N 4"],
    controls: Float[Tensor, "B N K 2"],
    states: Float[Tensor, "B N K 4"],
    dt: float,
) -> Float[Tensor, "D B N K 2"]:
    """Derivatives of the positions by each of an agent's D = 2 K controls."""
    steps = controls.shape[-2]
    unit = torch.eye(2 * steps, dtype=controls.dtype, device=controls.device).view(-1, 1, 1, steps, 2)
    directions = unit.expand(-1, *controls.shape)
    if isinstance(dynamics, Unicycle):
        return dynamics.tangent(states, directions, dt)[..., :2]

    def positions(at: Tensor) -> Tensor:
        return dynamics.rollout(start, at, dt)[..., :2]

    return torch.func.vmap(lambda direction: torch.func.jvp(positions, (controls,), (direction,))[1])(directions)


def _step(
    moved: Float[Tensor, "D B N K 2"],
    missed: Float[Tensor, "B N K 2"],
    corrected: Float[Tensor, "B N K 2"],
    seen: Bool[Tensor, "B N K"],
    told: Bool[Tensor, "B N K"],
) -> Float[Tensor, "B N K 2"]:
    """One Gauss-Newton step: ``missed`` are the remaining offsets, ``corrected`` the correction so far."""
    batch, agents, steps = seen.shape
    jacobian = torch.where(seen[..., None], moved, 0.0).flatten(3).permute(1, 2, 0, 3)  # [B, N, 2 K, 2 K]
    matrix = jacobian @ jacobian.mT
    stiffness = matrix.diagonal(dim1=-2, dim2=-1).unflatten(-1, (steps, 2))
    mean = stiffness.sum(-2) / told.sum(-1, keepdim=True).clamp_min(1)  # [B, N, 2]
    # The smoothness term couples neighbouring controls that are both determined.
    link = told[..., 1:].to(missed)
    difference = torch.eye(steps, dtype=missed.dtype, device=missed.device).diff(dim=0)
    smooth = difference.mT @ (link[..., None] * difference)  # [B, N, K, K]
    block = matrix.view(batch, agents, steps, 2, steps, 2)
    force = (jacobian @ missed.flatten(2)[..., None]).view(batch, agents, steps, 2)
    for channel in range(2):
        bond = _SMOOTHNESS * mean[..., channel, None, None] * smooth
        block[..., channel, :, channel] += bond
        force[..., channel] -= (bond @ corrected[..., channel, None])[..., 0]
    # Controls without effect on any position (the turn rate of a standing agent) keep their value.
    most = mean.amax(-1)
    least = 10.0 * torch.finfo(most.dtype).eps * most + (most == 0)
    matrix.diagonal(dim1=-2, dim2=-1).add_(least[..., None])
    factor, _ = torch.linalg.cholesky_ex(matrix)
    return torch.cholesky_solve(force.flatten(2)[..., None], factor).view(batch, agents, steps, 2)
