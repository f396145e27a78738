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

    # Features that read the same signal pull together: add them up before any K x K block is touched.
    pulls: dict[tuple[Source, int], Tensor] = {}
    stiffnesses: dict[tuple[Source, int], Tensor] = {}
    for name, feature in energy.own_features.items():
        value, slope = energy.shape(feature, signal(feature, states, controls, goals, dt))
        weight = energy.own_weight(scene, parameters, name)[..., None].square()
        key = feature.source, feature.channel
        pulls[key] = pulls.get(key, 0.0) + weight * slope * value
        stiffnesses[key] = stiffnesses.get(key, 0.0) + weight * slope.square()

    gradient = torch.zeros_like(controls)
    matrix = controls.new_zeros(batch, modes, agents, steps, 2, agents, steps, 2)
    block = controls.new_zeros(batch, modes, agents, 2, steps, steps)  # what couples a control with itself over time
    tip, root = energy.dynamics.anchors(states, initial, dt)
    for (source, channel), pull in pulls.items():
        stiffness = stiffnesses[source, channel]
        own = block[..., channel, :, :]
        match source:
            case Source.CONTROL:
                gradient[..., channel] += pull
                own.diagonal(dim1=-2, dim2=-1).add_(stiffness)
            case Source.RATE:
                pull, stiffness = pull / dt, stiffness / dt**2
                gradient[..., 1:, channel] += pull
                gradient[..., :-1, channel] -= pull
                own[..., 1:, 1:].diagonal(dim1=-2, dim2=-1).add_(stiffness)
                own[..., :-1, :-1].diagonal(dim1=-2, dim2=-1).add_(stiffness)
                own.diagonal(offset=1, dim1=-2, dim2=-1).sub_(stiffness)
                own.diagonal(offset=-1, dim1=-2, dim2=-1).sub_(stiffness)
            case Source.SPEED:
                # v_k moves by dt with every a_j, j < k: what two accelerations share begins after the later one.
                since = dt**2 * stiffness.flip(-1).cumsum(-1).flip(-1)
                step = torch.arange(steps, device=controls.device)
                gradient[..., ACCELERATION] += dt * pull.flip(-1).cumsum(-1).flip(-1)
                own += since[..., torch.maximum(step[:, None], step)]
            case Source.FINAL_POSITION:
                jacobian = tip[..., -1:, :, :] - root  # [B M N K 2 xy]
                gradient += (jacobian * pull[..., None, None, :]).sum(-1)
                scaled = (jacobian * stiffness.sqrt()[..., None, None, :]).flatten(3, 4)
                for agent in range(agents):
                    product = scaled[:, :, agent] @ scaled[:, :, agent].mT
                    matrix[:, :, agent, :, :, agent] += product.view(batch, modes, steps, 2, steps, 2)

    for agent in range(agents):
        for channel in range(2):
            matrix[:, :, agent, :, channel, agent, :, channel] += block[:, :, agent, channel]

    if energy.pair:
        depth, normal, active = energy.closeness(scene, states)
        weight = torch.stack([energy.pair_weight(scene, parameters, name).square() for name in energy.pair]).sum(0)
        strength = weight.sqrt()[..., None] * active  # [B M P K]
        reached = torch.ones(steps, steps, dtype=controls.dtype, device=controls.device).tril()[..., None]
        near = active.any(-1).any(1).any(0).tolist()  # pairs that are apart in all scenes cost nothing
        for pair, both in enumerate(zip(*(index.tolist() for index in pairs(agents)), strict=True)):
            if not near[pair]:
                continue
            # One row per step: how the overlap of the pair deepens with the controls of both, [B M K, 2 agents, K, 2].
            away = strength[:, :, pair, :, None] * normal[:, :, pair]
            rows = []
            for agent, along in zip(both, (-away, away), strict=True):
                at_tip = (along[..., None, :] * tip[:, :, agent]).sum(-1)  # [B M K 2]
                at_root = along @ root[:, :, agent].flatten(2, 3).mT  # [B M K (K 2)]
                rows.append((at_tip[..., None, :] - at_root.view(*at_tip.shape[:3], steps, 2)) * reached)
            jacobian = torch.stack(rows, 3).flatten(3)
            residual = (strength[:, :, pair] * depth[:, :, pair])[..., None]
            pull = (jacobian.mT @ residual).view(batch, modes, 2, steps, 2)
            product = (jacobian.mT @ jacobian).view(batch, modes, 2, steps, 2, 2, steps, 2)
            for a, i in enumerate(both):
                gradient[:, :, i] += pull[:, :, a]
                for b, j in enumerate(both):
                    matrix[:, :, i, :, :, j] += product[:, :, a, :, :, b]

    size = agents * steps * 2
    return gradient, matrix.view(batch, modes, size, size)
