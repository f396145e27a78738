"""Learning the density exp(-E) / Z without sampling: where the energy is a parabola, Z is a determinant.

With g and H the gradient and the curvature of E at the demonstrated controls u, of which there are d,

    -log p(u) = 1/2 g^T H^-1 g - 1/2 log det H + d/2 log 2 pi,

exactly so for quadratic energies, and Laplace's approximation for others. The first term draws the minimum towards what was
observed, the second makes it as narrow there as the data allow. H is the Gauss-Newton matrix J^T J + eps I of the residuals'
Jacobian J.

Controls that were not observed are integrated out. With g_B and H_B the rows of those, the density of the others has

    -log p(u_A) = (1/2 g^T H^-1 g - 1/2 log det H) - (1/2 g_B^T H_B^-1 g_B - 1/2 log det H_B) + d_A/2 log 2 pi.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning import losses
from epo_lightning.game.circles import separation
from epo_lightning.game.energy import RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy, along
from epo_lightning.game.features import Source, foot, signal, signal_change
from epo_lightning.game.pairs import pair_mask, pairs
from epo_lightning.game.selection import evaluated
from epo_lightning.game.tracking import demonstrated, observed_controls
from epo_lightning.objectives.base import Objective, Terms, checked_weights
from epo_lightning.objectives.terms import goal_term, observed_future
from epo_lightning.registry import register
from epo_lightning.scene import ACCELERATION, GameParameters, JointForecast, Scene
from epo_lightning.solvers.base import PATH, SAMPLES, STATIONARY
from epo_lightning.solvers.general import dense

_LINEAR = (Source.CONTROL, Source.RATE, Source.SPEED)
"""What features read that is linear in the controls of one channel."""


@register("objective", "laplace")
class Laplace(Objective):
    """Negative log-likelihood of the demonstration under a mixture of Gaussians, one around every mode's game.

    L = -log sum_m pi_m p_m(u) / d with the forecast's probabilities pi; which mode answers for which scene, and how likely
    it was, is learned along with the energies. Controls have no common unit: the likelihood is per control, of m/s^2 and
    rad/s, and may be negative. The controls that were observed are found by tracking
    (:mod:`~epo_lightning.game.tracking`); an agent's after its last observed step are integrated out.

    Besides the weighted terms, ``tracking`` is logged, the distance [m] between observed positions and those of the controls
    that stand for them; and ``flat``, the share of games without a density, because their H is singular or no number: these
    are left out of the mixture, and scenes without any game teach nothing.

    Args:
        weights: lambda of ``density``; of ``initial``, minSADE of the initial strategies, which no likelihood teaches; and
            of ``goal`` (idle where no goal is decoded).
        damping: eps; keeps H positive definite where no feature looks at a control.
    """

    terms = ("density", "initial", "goal")
    needs = frozenset({PATH, STATIONARY, SAMPLES})  # a game for every mode, and strategies to start from
    of_energy = frozenset({RESIDUALS})

    def __init__(self, weights: Mapping[str, float], damping: float = 1e-3) -> None:
        if not 0 <= damping < float("inf"):
            raise ValueError(f"damping must be 0 or more, and finite, not {damping}")
        self.weights = checked_weights(weights, self.terms)
        self.damping = damping

    def __call__(self, scene: Scene, forecast: JointForecast, energy: Energy, step: int = 0) -> Terms:
        future, mask = observed_future(scene)
        assert forecast.parameters is not None
        assert forecast.initial_states is not None
        controls, missed = observed_controls(energy.dynamics, scene)
        modes = forecast.probabilities.shape[1]
        log_density, sound = log_densities(
            energy, scene, forecast.parameters, controls[:, None].expand(-1, modes, -1, -1, -1), self.damping
        )
        joint = forecast.log_probabilities + torch.where(sound, log_density, -torch.inf)
        known = (joint != -torch.inf).any(1)
        joint = torch.where(known[:, None], joint, 0.0)
        count = 2 * demonstrated(scene).sum((1, 2)).clamp_min(1)
        density = torch.where(known, -joint.logsumexp(1) / count, 0.0).mean()
        distance = losses.distances(forecast.initial_states[..., :2], future, mask)
        initial, _ = losses.scene_imitation(distance, mask)
        followed = mask.any(-1)
        return {
            "density": (self.weights["density"], density),
            "initial": (self.weights["initial"], initial),
            **goal_term(scene, forecast, self.weights["goal"]),
            "tracking": (0.0, missed.sum() / followed.sum().clamp_min(1)),
            "flat": (0.0, (~sound).to(density.dtype).mean()),
        }


def log_densities(
    energy: Energy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    damping: float,
) -> tuple[Float[Tensor, "B M"], Bool[Tensor, "B M"]]:
    """log p of the demonstrated ones among the controls of present agents, and where there is one; zero elsewhere."""

    def linearised(*game: Any) -> tuple[Tensor, Tensor]:
        return _linearised(energy, damping, *game)

    slope, matrix = linearised(scene, parameters, controls)
    # What is no number anywhere in J is none on the diagonal of J^T J.
    finite = (slope + matrix.diagonal(dim1=-2, dim2=-1)).isfinite().all(-1)
    if not finite.all():
        slope, matrix = evaluated(linearised, scene, parameters, controls, finite)
    value, sound = _Parabola.apply(slope, matrix)
    told = demonstrated(scene)
    present = scene.agent_mask[..., None].expand_as(told)
    if not (told | ~present).all():
        # Rows that are demonstrated become unit rows, like those of absent agents, which are worth nothing.
        rest = _by_channel((present & ~told)[:, None, ..., None].expand(-1, -1, -1, -1, 2)).to(slope)
        both = rest[..., None] * rest[..., None, :]
        value_of_rest, known = _Parabola.apply(slope * rest, matrix * both + (1.0 - rest).diag_embed())
        value, sound = value - value_of_rest, sound & known
    value = value + math.log(2.0 * math.pi) * told.sum((1, 2))[:, None]
    sound = sound & finite
    return -torch.where(sound, value, 0.0).to(controls.dtype), sound


def _by_channel(values: Shaped[Tensor, "B M N K 2"]) -> Shaped[Tensor, "B M n"]:
    """In the order of rows of matrices: agent by agent, all accelerations before all turn rates."""
    return values.mT.flatten(2)


class _Parabola(torch.autograd.Function):
    """1/2 g^T H^-1 g - 1/2 log det H, zero and without gradient where H has no Cholesky factor. The upper half of H is read.

    With a = H^-1 g the gradient by g is a, and that by H is -1/2 (a a^T + H^-1): cheaper and steadier than to differentiate
    the factorisation.
    """

    @staticmethod
    def forward(ctx: Any, slope: Float[Tensor, "B M n"], matrix: Float[Tensor, "B M n n"]) -> tuple[Tensor, Tensor]:
        factor, info = torch.linalg.cholesky_ex(matrix.mT)  # the layout that LAPACK takes
        sound = info == 0
        if not sound.all():
            identity = torch.eye(slope.shape[-1], dtype=slope.dtype, device=slope.device)
            factor = torch.where(sound[..., None, None], factor, identity)
        half = torch.linalg.solve_triangular(factor, slope[..., None], upper=False)
        value = 0.5 * half.square().sum((-2, -1)) - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        ctx.save_for_backward(half, factor, sound)
        ctx.mark_non_differentiable(sound)
        return torch.where(sound, value, 0.0), sound

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Float[Tensor, "B M"], _: Tensor) -> tuple[Tensor, Tensor]:
        half, factor, sound = ctx.saved_tensors
        cotangent = torch.where(sound, cotangent, 0.0)[..., None]
        solved = torch.linalg.solve_triangular(factor.mT, half, upper=True)
        by_matrix = torch.cholesky_inverse(factor).mT  # symmetric, and rows are contiguous
        by_matrix = by_matrix.addcmul_(solved, solved.mT).mul_(-0.5 * cotangent[..., None])
        return cotangent * solved[..., 0], by_matrix


class _Assembly(torch.autograd.Function):
    """The gradient J^T r and the upper half of J^T J, from rows of single agents and rows of pairs.

    An agent's rows change with its own controls alone, and a pair's with those of its two ends: what is multiplied is one
    block of D = 2 K controls at a time. With cotangents a of the gradient and the symmetric A of the matrix, that of r is
    J a, and that of J is r a^T + 2 J A: half the products that automatic differentiation would take.

    Args:
        diagonal: what is added to that of the matrix.
        slope, blocks: what linear features give, the latter to blocks on the diagonal.
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
        end_rows: Float[Tensor, "B M Q S"],
        end_changes: Float[Tensor, "B M Q D S"],
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
    """A view of the blocks on the diagonal."""
    return matrix.diagonal(dim1=2, dim2=4).movedim(-1, 2)


def _linearised(
    energy: Energy, damping: float, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> tuple[Float[Tensor, "B M n"], Float[Tensor, "B M n n"]]:
    """The gradient J^T r and the upper half of H = J^T J + eps I, differentiable, in double precision, by channel.

    Absent agents have unit rows. In single precision, matrices of highways may have no Cholesky factor. Energies whose
    features are not known take the dense way.
    """
    present = _by_channel(scene.agent_mask[:, None, :, None, None].expand(-1, 1, *controls.shape[2:]))
    if not isinstance(energy, FeatureEnergy):
        controls = controls.contiguous()  # what is expanded takes no tangents
        _, slope = dense.gradient(energy, scene, parameters, controls)
        matrix = dense.gauss_newton(energy, scene, parameters, controls).double()
        order = _by_channel(torch.arange(controls.shape[2:].numel(), device=controls.device).view_as(controls[:1, :1]))
        matrix = matrix[..., order[0, 0, :, None], order[0, 0]]
        return _by_channel(slope).double(), matrix + (damping * present.to(matrix)).diag_embed()
    energy.validate(scene, parameters, controls)
    steps = controls.shape[3]
    controls = torch.where(scene.agent_mask[:, None, :, None, None], controls, 0.0)
    states = energy.dynamics.rollout(energy.initial(scene), controls, scene.dt)
    # Every agent's own 2 K unit directions, all of acceleration before all of turn rate.
    unit = torch.eye(2 * steps, dtype=controls.dtype, device=controls.device).view(-1, 2, steps).mT[:, None, None, None]
    directions = unit.expand(-1, *controls.shape)
    moved = energy.dynamics.tangent(states, directions, scene.dt)
    return _Assembly.apply(
        torch.where(present, damping, 1.0).double(),
        *_of_agents(energy, scene, parameters, (states, controls), (moved, directions)),
        *_of_pairs(energy, scene, parameters, states, moved),
    )


def _of_agents(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    at: tuple[Tensor, Tensor],
    along_: tuple[Tensor, Tensor],
) -> tuple[Float[Tensor, "B M N D"], Float[Tensor, "B M N D D"], Float[Tensor, "B M N R"], Float[Tensor, "B M N D R"]]:
    """What own features give to the gradient and to the blocks of the matrix on its diagonal, and rows that give more.

    Controls, their rates and speeds change with the controls of one channel, always in the same way A: they give
    A^T diag((w c')^2) A, and all features that read the same of these share one product. Others give theirs row by row.
    The nearest point of a line slides as an agent moves along it: how far agents get says nothing about how well they keep
    to their lane. (Minimisers hold it, which makes steps shorter and changes no solution; a density would be changed.)
    """
    states, controls = at
    steps = controls.shape[3]
    around = energy.surroundings(scene, parameters)
    linear: dict[tuple[Source, int], list[tuple[Tensor, Tensor]]] = {}
    rows, changes = [states.new_zeros(*states.shape[:3], 0)], [states.new_zeros(2 * steps, *states.shape[:3], 0)]
    for name, feature in energy.own_features.items():
        weight = energy.own_weight(scene, parameters, name)[..., None]
        if feature.source is Source.TRAJECTORY:
            assert feature.function is not None
            value, change = along(feature.function, at, along_)
            present = scene.agent_mask[:, None, :, None]
            value, change = torch.where(present, value, 0.0), torch.where(present, change, 0.0)
        elif feature.source is Source.POSITION:
            assert around.line is not None
            position, ahead = states[..., :2], along_[0][..., :2]
            nearest, tangent = foot(position, around.line)
            value = (position - nearest).flatten(-2)
            change = (ahead - (ahead * tangent).sum(-1, keepdim=True) * tangent).flatten(-2)
        else:
            value, steepness = energy.shape(feature, signal(feature, *at, around))
            if feature.source in _LINEAR:
                channel = ACCELERATION if feature.source is Source.SPEED else feature.channel
                force, stiffness = weight.square() * steepness * value, (weight * steepness).square()
                linear.setdefault((feature.source, channel), []).append((force, stiffness))
                continue
            change = steepness * signal_change(feature, *at, *along_, around)
        rows.append(weight * value)
        changes.append(weight * change)

    slope = states.new_zeros(*states.shape[:3], 2 * steps, dtype=torch.float64)
    forces = list(slope.unflatten(-1, (2, steps)).unbind(-2))
    blocks = [slope.new_zeros(*states.shape[:3], steps, steps) for _ in range(2)]
    unit = torch.eye(steps, dtype=slope.dtype, device=slope.device)
    for (source, channel), parts in linear.items():
        reads = unit  # A [R, K]
        if source is Source.RATE:
            reads = unit.diff(dim=0) / scene.dt
        elif source is Source.SPEED:
            reads = scene.dt * unit.cumsum(0)
        force, stiffness = (sum(several).double() for several in zip(*parts, strict=True))
        forces[channel] = forces[channel] + force @ reads
        outer = (reads[:, :, None] * reads[:, None, :]).flatten(1)
        blocks[channel] = blocks[channel] + (stiffness @ outer).unflatten(-1, (steps, steps))
    pad = torch.nn.functional.pad
    matrix = torch.cat((pad(blocks[0], (0, steps)), pad(blocks[1], (steps, 0))), -2)
    return torch.cat(forces, -1), matrix, torch.cat(rows, -1), torch.cat(changes, -1).movedim(0, -2)


def _of_pairs(
    energy: FeatureEnergy, scene: Scene, parameters: GameParameters, states: Tensor, moved: Tensor
) -> tuple[Float[Tensor, "B M Q R"], Float[Tensor, "B M Q D R"]]:
    """Residuals of pairs, and how they change with the controls of their Q = 2 P ends: all first agents, then all second.

    The residuals stand there twice.
    """
    first, second = pairs(states.shape[2], states.device)
    ends = torch.cat((first, second))
    both = [energy.at_pair_steps(states[:, :, members]) for members in (first, second)]
    distance, normal = separation(both[0][..., :2], both[1][..., :2])
    exists = pair_mask(scene)[:, None, :, None]
    rows, changes = [distance[..., :0]], [moved.new_zeros(*moved.shape[:3], len(ends), 0)]
    for name, pair in energy.pair_features.items():
        weight = energy.pair_weight(scene, parameters, name)[..., None]
        if pair.source is Source.TRAJECTORY:
            sizes = [energy.size(scene)[:, None, members, None] for members in (first, second) if pair.needs]
            by_first, by_second = (energy.at_pair_steps(moved[:, :, :, members]) for members in (first, second))
            still = torch.zeros_like(by_first)
            value, change = along(pair.function, (both[0], both[1]), (by_first, still), *sizes)
            _, by_second = along(pair.function, (both[0], both[1]), (still, by_second), *sizes)
            change = weight.repeat(1, 1, 2, 1) * torch.where(
                exists.repeat(1, 1, 2, 1), torch.cat((change, by_second), 3), 0.0
            )
        else:
            value, steepness = energy.pair_shape(pair, distance, energy.reach(scene)[:, None, :, None])
            force = weight * torch.where(exists, steepness, 0.0)
            apart = energy.at_pair_steps(moved[..., :2][:, :, :, ends])
            change = torch.cat((force, -force), 2) * (torch.cat((normal, normal), 2) * apart).sum(-1)
        rows.append(weight * torch.where(exists, value, 0.0))
        changes.append(change)
    return torch.cat(rows, -1).repeat(1, 1, 2, 1), torch.cat(changes, -1).movedim(0, -2)
