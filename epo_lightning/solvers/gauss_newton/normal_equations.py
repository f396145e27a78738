"""The normal equations of a feature energy as dense matrices: J^T r and J^T J, differentiable by the game's parameters.

The solver's own factorisation (:mod:`~epo_lightning.solvers.gauss_newton.blocks`) never forms J^T J and has no
differentiable determinant. This module is for objectives that need both (:mod:`epo_lightning.objectives.laplace`).
Residuals of an agent depend on its own controls only, and those of a pair on the controls of its two agents, so the matrix
consists of small blocks.

Rows are ordered by channel: agent by agent, all accelerations before all turn rates.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import separation
from epo_lightning.game.feature_derivatives import (
    linear_signal,
    own_derivatives,
    pair_derivatives,
    signal_and_change,
    undeclared_change_by_agent,
)
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.features import OwnFeature, Source
from epo_lightning.game.game_end import free_controls
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import ACCELERATION, Scene


def by_channel(values: Shaped[Tensor, "B M N K 2"]) -> Shaped[Tensor, "B M n"]:
    """Values of controls in the order of the matrix's rows."""
    return values.mT.flatten(2)


def normal_equations(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    damping: float,
) -> tuple[Float[Tensor, "B M n"], Float[Tensor, "B M n n"]]:
    """The gradient J^T r and the upper half of H = J^T J + eps I, in double precision.

    Both are differentiable with respect to the parameters. Absent agents, and controls after the end of a game, have rows of
    the unit matrix. For lines, the exact derivative is used (``slide`` of
    :func:`~epo_lightning.game.feature_derivatives.signal_and_change`), so that motion along a line has no cost. (Solvers
    hold the nearest point fixed, which changes no solution but would change a density.)

    Args:
        energy, scene, parameters, controls: the game, and where to expand it.
        damping: eps.
    """
    energy.validate(scene, parameters, controls)
    steps = controls.shape[3]
    present = by_channel(free_controls(scene, steps)[:, None, ..., None].expand(-1, -1, -1, -1, 2))
    controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
    states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
    # The 2 K unit directions of every agent, all of acceleration before all of turn rate.
    unit = torch.eye(2 * steps, dtype=controls.dtype, device=controls.device).view(-1, 2, steps).mT[:, None, None, None]
    directions = unit.expand(-1, *controls.shape)
    moved = energy.dynamics.tangent(states, directions, scene.dt)
    return _Assembly.apply(
        torch.where(present, damping, 1.0).double(),
        *_of_agents(energy, scene, parameters, (states, controls), (moved, directions)),
        *_of_pairs(energy, scene, parameters, states, moved),
    )


class _Assembly(torch.autograd.Function):
    """The gradient J^T r and the upper half of J^T J, from residuals of single agents and residuals of pairs.

    Products are taken for one block of D = 2 K controls at a time. With cotangents a of the gradient and the symmetric A of
    the matrix, the cotangent of r is J a, and that of J is r a^T + 2 J A: half the products that automatic differentiation
    would take.

    Args:
        diagonal: added to the diagonal of the matrix.
        slope, blocks: contributions of linear features to the gradient, and to the blocks on the diagonal.
        rows, changes: residuals r of agents and their J^T.
        end_rows, end_changes: the same of the Q = 2 P ends of pairs: all first agents, then all second.
    """

    @staticmethod
    def forward(
        ctx: Any,
        diagonal: Float[Tensor, "B 1 n"],
        slope: Float[Tensor, "B M N D"],
        blocks: Float[Tensor, "B M N D D"],
        rows: Float[Tensor, "B M N R"],
        changes: Float[Tensor, "B M N D R"],
        end_rows: Float[Tensor, "B M Q size"],
        end_changes: Float[Tensor, "B M Q D size"],
    ) -> tuple[Tensor, Tensor]:
        ctx.dtype = rows.dtype
        rows, changes, end_rows, end_changes = (
            part.to(torch.float64, memory_format=torch.contiguous_format)
            for part in (rows, changes, end_rows, end_changes)
        )
        ctx.save_for_backward(rows, changes, end_rows, end_changes)
        batch, modes, agents, count = slope.shape
        first, second = pairs(agents, slope.device)
        ends = torch.cat((first, second))
        slope = slope + (changes @ rows[..., None])[..., 0]
        slope = slope.index_add(2, ends, (end_changes @ end_rows[..., None])[..., 0])
        blocks = (changes @ changes.mT).add_(blocks).index_add_(2, ends, end_changes @ end_changes.mT)
        matrix = slope.new_zeros(batch, modes, agents, count, agents, count)
        _on_diagonal(matrix).copy_(blocks)
        one, other = end_changes.chunk(2, 2)
        matrix.transpose(3, 4)[:, :, first, second] = one @ other.mT
        matrix = matrix.view(batch, modes, agents * count, agents * count)
        matrix.diagonal(dim1=-2, dim2=-1).add_(diagonal)
        return slope.flatten(2), matrix

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_slope: Float[Tensor, "B M n"], by_matrix: Float[Tensor, "B M n n"]
    ) -> tuple[Tensor | None, ...]:
        rows, changes, end_rows, end_changes = ctx.saved_tensors
        agents, count = changes.shape[2:4]
        first, second = pairs(agents, changes.device)
        ends = torch.cat((first, second))
        slope = by_slope.unflatten(-1, (agents, count))
        matrix = by_matrix.unflatten(-1, (agents, count)).unflatten(-3, (agents, count))
        blocks, between = _on_diagonal(matrix).contiguous(), matrix.transpose(3, 4)[:, :, first, second]
        one, other = end_changes.chunk(2, 2)
        end_slope = slope[:, :, ends]
        by_changes = (blocks @ changes).mul_(2.0).addcmul_(slope[..., None], rows[..., None, :])
        by_end_changes = torch.cat((between @ other, between.mT @ one), 2).add_(blocks[:, :, ends] @ end_changes)
        by_end_changes = by_end_changes.mul_(2.0).addcmul_(end_slope[..., None], end_rows[..., None, :])
        by_rows = (slope[..., None, :] @ changes)[..., 0, :]
        by_end_rows = (end_slope[..., None, :] @ end_changes)[..., 0, :]
        given = (by_rows, by_changes, by_end_rows, by_end_changes)
        return None, slope, blocks, *(part.to(ctx.dtype) for part in given)


def _on_diagonal(matrix: Float[Tensor, "B M N D N D"]) -> Float[Tensor, "B M N D D"]:
    """View of the blocks on the diagonal."""
    return matrix.diagonal(dim1=2, dim2=4).movedim(-1, 2)


def _of_agents(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    at: tuple[Tensor, Tensor],
    moved: tuple[Tensor, Tensor],
) -> tuple[Float[Tensor, "B M N D"], Float[Tensor, "B M N D D"], Float[Tensor, "B M N R"], Float[Tensor, "B M N D R"]]:
    """Contributions of linear own features to gradient and diagonal blocks, and residuals with J^T of the others.

    A linear signal z = A u of one channel contributes A^T diag((w c')^2) A; features of the same signal share this product.
    """
    states, controls = at
    steps = controls.shape[3]
    around = energy.surroundings(scene, parameters)
    linear: dict[OwnFeature, list[tuple[Tensor, Tensor]]] = {}
    rows, changes = [states.new_zeros(*states.shape[:3], 0)], [states.new_zeros(2 * steps, *states.shape[:3], 0)]
    still = moved[0][:0], moved[1][:0]
    for name, feature in energy.own_features.items():
        if not feature.linear:
            row, change = energy.own_residual(name, scene, parameters, around, at, moved, slide=True)
            rows.append(row)
            changes.append(change)
            continue
        weight = energy.own_weight(scene, parameters, name)[..., None]
        signal, _ = signal_and_change(feature, *at, *still, around)
        value, first, _ = own_derivatives(feature, signal, around.bounds).within(
            energy.residual_mask(scene, feature, steps)
        )
        first = torch.ones_like(value) if first is None else first
        force, stiffness = weight.square() * first * value, (weight * first).square()
        linear.setdefault(_signal_of(feature), []).append((force, stiffness))

    slope = states.new_zeros(*states.shape[:3], 2 * steps, dtype=torch.float64)
    forces = list(slope.unflatten(-1, (2, steps)).unbind(-2))
    blocks = [slope.new_zeros(*states.shape[:3], steps, steps) for _ in range(2)]
    unit = torch.eye(steps, dtype=slope.dtype, device=slope.device)
    for feature, parts in linear.items():
        speed = scene.dt * unit.cumsum(-1)
        matrix = linear_signal(feature, unit[..., None].expand(-1, -1, 2), speed, scene.dt).mT.contiguous()  # A [R, K]
        force, stiffness = (sum(several).double() for several in zip(*parts, strict=True))
        forces[feature.channel] = forces[feature.channel] + force @ matrix
        outer = (matrix[:, :, None] * matrix[:, None, :]).flatten(1)
        blocks[feature.channel] = blocks[feature.channel] + (stiffness @ outer).unflatten(-1, (steps, steps))
    pad = torch.nn.functional.pad
    both = torch.cat((pad(blocks[0], (0, steps)), pad(blocks[1], (steps, 0))), -2)
    return torch.cat(forces, -1), both, torch.cat(rows, -1), torch.cat(changes, -1).movedim(0, -2)


def _signal_of(feature: OwnFeature) -> OwnFeature:
    """The feature of the bare linear signal, equal for all features of the same signal."""
    channel = ACCELERATION if feature.source is Source.SPEED else feature.channel
    return OwnFeature(feature.source, "", channel)


def _of_pairs(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, states: Tensor, moved: Tensor
) -> tuple[Float[Tensor, "B M Q R"], Float[Tensor, "B M Q D R"]]:
    """Residuals and J^T of pairs, by the controls of their Q = 2 P ends: all first agents, then all second.

    Residuals are repeated for both ends.
    """
    first, second = pairs(states.shape[2], states.device)
    ends = torch.cat((first, second))
    both = [energy.at_pair_steps(states[:, :, members]) for members in (first, second)]
    distance, normal = separation(both[0][..., :2], both[1][..., :2])
    ends_of_games = energy.evaluated(scene)
    rows, changes = [distance[..., :0]], [moved.new_zeros(*moved.shape[:3], len(ends), 0)]
    for name, pair in energy.pair_features.items():
        weight = energy.pair_weight(scene, parameters, name)[..., None]
        exists = energy.pair_exists(scene, pair, distance.shape[-1])
        if pair.declared:
            value, slope, _ = pair_derivatives(pair, distance, energy.reach(scene, parameters, name))
            assert slope is not None
            force = weight * torch.where(exists, slope, 0.0)
            apart = energy.at_pair_steps(moved[..., :2][:, :, :, ends])
            change = torch.cat((force, -force), 2) * (torch.cat((normal, normal), 2) * apart).sum(-1)
        else:
            others = [energy.size(scene)[:, None, members, None] for members in (first, second) if pair.needs]
            others += [energy.margin(scene, parameters, name)[..., None]] if pair.margin else []
            ends_moved = [energy.at_pair_steps(moved[:, :, :, members]) for members in (first, second)]
            value, *by_ends = undeclared_change_by_agent(
                pair, (both[0], both[1]), (ends_moved[0], ends_moved[1]), *others, ends=ends_of_games
            )
            change = weight.repeat(1, 1, 2, 1) * torch.where(exists.repeat(1, 1, 2, 1), torch.cat(by_ends, 3), 0.0)
        rows.append(weight * torch.where(exists, value, 0.0))
        changes.append(change)
    return torch.cat(rows, -1).repeat(1, 1, 2, 1), torch.cat(changes, -1).movedim(0, -2)
