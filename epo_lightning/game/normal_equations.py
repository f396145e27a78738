"""The Gauss-Newton model of an energy around a joint strategy: g = J^T r and J^T J, assembled from each feature's structure.

The Jacobian is never formed. A control feature adds to the diagonal, a rate to three diagonals, a speed term depends only
on the later of two steps, and positions enter through the closed-form sensitivities of the dynamics.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.game.energy import Energy, pairs
from epo_lightning.game.features import Source, signal
from epo_lightning.scene import ACCELERATION, GameParameters, Scene


def normal_equations(
    energy: Energy, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> tuple[Float[Tensor, "B M N K 2"], Float[Tensor, "B M n n"]]:
    """Gradient g = J^T r and Gauss-Newton matrix J^T J of the energy, n = N K 2 unknowns in the order of ``controls``."""
    batch, modes, agents, steps, _ = controls.shape
    dt = scene.dt
    controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
    initial = energy.initial(scene)
    states = energy.dynamics.rollout(initial, controls, dt)
    goals = energy.goals(scene, parameters)

    # Per agent and channel: gradient, and the K x K block of the matrix.
    gradient = torch.zeros_like(controls)
    block = controls.new_zeros(batch, modes, agents, 2, steps, steps)
    matrix = controls.new_zeros(batch, modes, agents, steps, 2, agents, steps, 2)
    sensitivity = None
    if energy.needs_goals or (energy.pair and agents > 1):
        sensitivity = energy.dynamics.position_sensitivity(states, initial, dt).flatten(-2)  # [B M N K 2 (K 2)]

    for name, feature in energy.own_features.items():
        value, slope = energy.shape(feature, signal(feature, states, controls, goals, dt))
        weight = energy.own_weight(scene, parameters, name)[..., None].square()
        pull, stiffness = weight * slope * value, weight * slope.square()
        channel = feature.channel
        match feature.source:
            case Source.CONTROL:
                gradient[..., channel] += pull
                block[..., channel, :, :].diagonal(dim1=-2, dim2=-1).add_(stiffness)
            case Source.RATE:
                pull, stiffness = pull / dt, stiffness / dt**2
                gradient[..., 1:, channel] += pull
                gradient[..., :-1, channel] -= pull
                of_channel = block[..., channel, :, :]
                of_channel[..., 1:, 1:].diagonal(dim1=-2, dim2=-1).add_(stiffness)
                of_channel[..., :-1, :-1].diagonal(dim1=-2, dim2=-1).add_(stiffness)
                of_channel.diagonal(offset=1, dim1=-2, dim2=-1).sub_(stiffness)
                of_channel.diagonal(offset=-1, dim1=-2, dim2=-1).sub_(stiffness)
            case Source.SPEED:
                # v_k moves by dt with every a_j, j < k: what two accelerations share begins after the later one.
                since = dt**2 * stiffness.flip(-1).cumsum(-1).flip(-1)
                step = torch.arange(steps, device=controls.device)
                gradient[..., ACCELERATION] += dt * pull.flip(-1).cumsum(-1).flip(-1)
                block[..., ACCELERATION, :, :] += since[..., torch.maximum(step[:, None], step)]
            case Source.FINAL_POSITION:
                assert sensitivity is not None
                last = sensitivity[..., -1, :, :]  # [B M N 2 (K 2)]
                gradient += (last.mT @ pull[..., None]).view_as(controls)
                scaled = stiffness.sqrt()[..., None] * last
                for agent in range(agents):
                    rows = scaled[:, :, agent]
                    matrix[:, :, agent, :, :, agent] += (rows.mT @ rows).view(batch, modes, steps, 2, steps, 2)

    for agent in range(agents):
        for channel in range(2):
            matrix[:, :, agent, :, channel, agent, :, channel] += block[:, :, agent, channel]

    if energy.pair and agents > 1:
        assert sensitivity is not None
        depth, normal, active = energy.closeness(scene, states)
        weight = sum(energy.pair_weight(scene, parameters, name).square() for name in energy.pair)
        assert isinstance(weight, Tensor)
        strength = weight.sqrt()[..., None] * active  # [B M P K]
        for pair, (i, j) in enumerate(zip(*(index.tolist() for index in pairs(agents)), strict=True)):
            # One row per step: how the overlap deepens with the controls of i and of j.
            towards = (strength[:, :, pair, :, None] * normal[:, :, pair])[..., None, :]  # [B M K 1 2]
            row_i = -(towards @ sensitivity[:, :, i]).squeeze(-2)  # [B M K (K 2)]
            row_j = (towards @ sensitivity[:, :, j]).squeeze(-2)
            residual = (strength[:, :, pair] * depth[:, :, pair])[..., None]
            for a, row_a in ((i, row_i), (j, row_j)):
                gradient[:, :, a] += (row_a.mT @ residual).view(batch, modes, steps, 2)
                for b, row_b in ((i, row_i), (j, row_j)):
                    matrix[:, :, a, :, :, b] += (row_a.mT @ row_b).view(batch, modes, steps, 2, steps, 2)

    size = agents * steps * 2
    return gradient, matrix.view(batch, modes, size, size)
