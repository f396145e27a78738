"""Maximum likelihood of the density exp(-E) / Z without sampling, by Laplace's approximation of Z.

With the gradient g and the Hessian H of E at the d demonstrated controls u,

    -log p(u) = 1/2 g^T H^-1 g - 1/2 log det H + d/2 log 2 pi,

which is exact for quadratic energies. The first term moves the minimum of E towards the observation; the second rewards
large weights (a narrow density). H is the Gauss-Newton matrix J^T J + eps I of the residuals' Jacobian J.

Let B be the controls that were not observed, and A the others. B is integrated out of the density; with the entries g_B of g
and the block H_B of H,

    -log p(u_A) = (1/2 g^T H^-1 g - 1/2 log det H) - (1/2 g_B^T H_B^-1 g_B - 1/2 log det H_B) + d_A/2 log 2 pi.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning import losses
from epo_lightning.checks import check_number
from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.game.energy import RESIDUALS, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.selection import evaluated
from epo_lightning.game.tracking import demonstrated, observed_controls
from epo_lightning.objectives.base import Objective, Terms, checked_weights
from epo_lightning.objectives.terms import goal_term
from epo_lightning.registry import register
from epo_lightning.scene import Scene, observed_future
from epo_lightning.schedules import Annealing
from epo_lightning.solvers.base import PATH, SAMPLES, STATIONARY
from epo_lightning.solvers.gauss_newton.normal_equations import by_channel, normal_equations
from epo_lightning.solvers.general import dense


@register("objective", "laplace")
class Laplace(Objective):
    """Negative log-likelihood of the demonstration under a mixture of Gaussians, one around every mode's game.

    L = -log sum_m pi_m p_m(u) / d with the forecast's probabilities pi; the assignment of scenes to modes is learned along
    with the energies. Controls have no common unit: the likelihood is per control, in m/s^2 and rad/s, and may be negative.
    Observed controls are found by tracking (:mod:`~epo_lightning.game.tracking`); an agent's controls after its last
    observed step are integrated out.

    Besides the weighted terms, ``tracking`` is logged, the distance [m] between observed positions and those reproduced by
    tracking; and ``flat``, the fraction of games without a density because H is singular or not finite. These are left out
    of the mixture, and scenes without any density contribute zero.

    Args:
        weights: lambda of ``density``; of ``initial``, minSADE of the initial strategies, which the likelihood does not
            train; and of ``goal`` (no effect where no goal is decoded).
        damping: eps, which keeps H positive definite if some controls have no effect on any feature.
        annealing, annealing_steps: temperature [m] and duration of an :class:`~epo_lightning.schedules.Annealing` of
            ``initial``. (``density`` trains every mode by its own share in the mixture.)
    """

    term_names = ("density", "initial", "goal")
    needs_from_solver = frozenset({PATH, STATIONARY, SAMPLES})  # a game for every mode, and strategies to start from
    needs_from_energy = frozenset({RESIDUALS})

    def __init__(
        self,
        weights: Mapping[str, float],
        damping: float = 1e-3,
        annealing: float = 0.0,
        annealing_steps: int = 2000,
    ) -> None:
        check_number("objective.damping", damping, zero=True)
        self.weights = checked_weights(weights, self.term_names)
        self.damping = damping
        self.annealing = Annealing(annealing, annealing_steps)

    def __call__(self, scene: Scene, forecast: JointForecast, energy: Energy, step: int = 0) -> Terms:
        future, mask = observed_future(scene)
        assert forecast.parameters is not None
        assert forecast.initial_states is not None
        controls, missed = observed_controls(energy.dynamics, scene)
        modes = forecast.probabilities.shape[1]
        log_density, exists = log_densities(
            energy, scene, forecast.parameters, controls[:, None].expand(-1, modes, -1, -1, -1), self.damping
        )
        joint = forecast.log_probabilities + torch.where(exists, log_density, -torch.inf)
        known = (joint != -torch.inf).any(1)
        joint = torch.where(known[:, None], joint, 0.0)
        count = 2 * demonstrated(scene).sum((1, 2)).clamp_min(1)
        density = torch.where(known, -joint.logsumexp(1) / count, 0.0).mean()
        distance = losses.distances(forecast.initial_states[..., :2], future, mask)
        initial, _ = losses.scene_imitation(distance, mask, temperature=self.annealing.at(step))
        followed = mask.any(-1)
        return {
            "density": (self.weights["density"], density),
            "initial": (self.weights["initial"], initial),
            **goal_term(scene, forecast, self.weights["goal"]),
            "tracking": (0.0, missed.sum() / followed.sum().clamp_min(1)),
            "flat": (0.0, (~exists).to(density.dtype).mean()),
        }


def log_densities(
    energy: Energy,
    scene: Scene,
    parameters: GameParameters,
    controls: Float[Tensor, "B M N K 2"],
    damping: float,
) -> tuple[Float[Tensor, "B M"], Bool[Tensor, "B M"]]:
    """log p of the demonstrated controls, and a mask of the games that have a density; log p is zero elsewhere."""
    linearised = partial(_linearised, energy, damping)
    slope, matrix = linearised(scene, parameters, controls)
    # A NaN anywhere in J reaches the diagonal of J^T J.
    finite = (slope + matrix.diagonal(dim1=-2, dim2=-1)).isfinite().all(-1)
    if not finite.all():
        slope, matrix = evaluated(linearised, scene, parameters, controls, finite)
    value, definite = _LogDensity.apply(slope, matrix)
    told = demonstrated(scene)
    present = scene.agent_mask[..., None].expand_as(told)
    if not (told | ~present).all():
        # Rows of demonstrated controls become unit rows with zero gradient, which contribute zero.
        rest = by_channel((present & ~told)[:, None, ..., None].expand(-1, -1, -1, -1, 2)).to(slope)
        both = rest[..., None] * rest[..., None, :]
        value_of_rest, rest_definite = _LogDensity.apply(slope * rest, matrix * both + (1.0 - rest).diag_embed())
        value, definite = value - value_of_rest, definite & rest_definite
    value = value + math.log(2.0 * math.pi) * told.sum((1, 2))[:, None]
    exists = definite & finite
    return -torch.where(exists, value, 0.0).to(controls.dtype), exists


class _LogDensity(torch.autograd.Function):
    """1/2 g^T H^-1 g - 1/2 log det H, zero and without gradient where H is not positive definite; reads H's upper half.

    With a = H^-1 g the gradient by g is a, and that by H is -1/2 (a a^T + H^-1), which is cheaper and numerically more
    stable than differentiating the factorisation.
    """

    @staticmethod
    def forward(ctx: Any, slope: Float[Tensor, "B M n"], matrix: Float[Tensor, "B M n n"]) -> tuple[Tensor, Tensor]:
        factor, info = torch.linalg.cholesky_ex(matrix.mT)  # the layout that LAPACK takes
        definite = info == 0
        if not definite.all():
            identity = torch.eye(slope.shape[-1], dtype=slope.dtype, device=slope.device)
            factor = torch.where(definite[..., None, None], factor, identity)
        half = torch.linalg.solve_triangular(factor, slope[..., None], upper=False)
        value = 0.5 * half.square().sum((-2, -1)) - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        ctx.save_for_backward(half, factor, definite)
        ctx.mark_non_differentiable(definite)
        return torch.where(definite, value, 0.0), definite

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Float[Tensor, "B M"], _: Tensor) -> tuple[Tensor, Tensor]:
        half, factor, definite = ctx.saved_tensors
        cotangent = torch.where(definite, cotangent, 0.0)[..., None]
        solved = torch.linalg.solve_triangular(factor.mT, half, upper=True)
        by_matrix = torch.cholesky_inverse(factor).mT  # symmetric, and rows are contiguous
        by_matrix = by_matrix.addcmul_(solved, solved.mT).mul_(-0.5 * cotangent[..., None])
        return cotangent * solved[..., 0], by_matrix


def _linearised(
    energy: Energy, damping: float, scene: Scene, parameters: GameParameters, controls: Float[Tensor, "B M N K 2"]
) -> tuple[Float[Tensor, "B M n"], Float[Tensor, "B M n n"]]:
    """The gradient J^T r and the upper half of H = J^T J + eps I, differentiable, in double precision, by channel.

    Absent agents have unit rows. In single precision, matrices of highways may have no Cholesky factor.
    """
    if isinstance(energy, FeatureEnergy):
        return normal_equations(energy, scene, parameters, controls, damping)
    present = by_channel(scene.agent_mask[:, None, :, None, None].expand(-1, 1, *controls.shape[2:]))
    controls = controls.contiguous()  # forward-mode differentiation refuses expanded tensors
    _, slope = dense.gradient(energy, scene, parameters, controls)
    matrix = dense.gauss_newton(energy, scene, parameters, controls).double()
    order = by_channel(torch.arange(controls.shape[2:].numel(), device=controls.device).view_as(controls[:1, :1]))
    matrix = matrix[..., order[0, 0, :, None], order[0, 0]]
    return by_channel(slope).double(), matrix + (damping * present.to(matrix)).diag_embed()
