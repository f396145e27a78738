"""Conditional density estimation: the likelihood of the observed choices among candidate strategies."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from epo_lightning import losses
from epo_lightning.forecast import JointForecast
from epo_lightning.game.energy import Energy
from epo_lightning.objectives.base import Objective, Terms, checked_weights
from epo_lightning.objectives.terms import goal_term
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import Scene, observed_future
from epo_lightning.schedules import Annealing, is_positive
from epo_lightning.solvers.base import TABLES
from epo_lightning.solvers.discrete import assignments

DENSITIES = ("joint", "marginal")


GOAL = 0.1
"""Default weight of the cross entropy of goals. (Most energies over candidates have no goals, so it need not be set.)"""


@register("objective", "conditional")
class Conditional(Objective):
    """-log p(k*) with p(k) = exp(-E(k)) / Z, where k*_i is agent i's candidate closest to its observed future.

    - ``joint`` (JFP, Luo et al., CoRL 2022): -log p(k*_1, ..., k*_N) = E(k*) + log Z, the joint assignment of a scene.
    - ``marginal`` (DSDNet, Zeng et al., ECCV 2020): -log p(k*_i), averaged over agents.

    The joint density is that of the observed agents: unobserved ones are summed out (marginalised). In the other terms
    unobserved agents do not count, and scenes without observations contribute zero. k*_i is chosen among the candidates
    with a finite energy. If the combination of all k*_i has an infinite energy, or if energies are NaN, the scene
    contributes -log of the smallest positive number, without a gradient.

    In the joint density, log Z sums over all assignments and the numerator over those of the observed choices. Both are
    exact where all assignments can be enumerated (:func:`~epo_lightning.solvers.discrete.assignments.partition`), for any
    solver: the probability is 1 at most and the loss 0 at least. For larger games, ten rounds of messages give both. Bethe's
    log Z is no bound on the true one, so large pair energies can make the loss negative there.

    Args:
        weights: lambda of ``density``; of ``marginal``, the cross entropy of every agent's candidates by their own energies
            alone, exp(-E_i) (JFP's auxiliary loss); of ``regression``, the distance of the closest candidate, which trains
            decoded candidates and elsewhere measures how well the candidates cover the observed futures; and of ``goal``
            (unused where no goal is decoded; 0.1 where it is not named).
        density: ``joint`` or ``marginal``.
        annealing, annealing_steps: temperature [m] and duration of an :class:`~epo_lightning.schedules.Annealing` of
            ``regression``, over the candidates of each agent.
    """

    term_names = ("density", "marginal", "regression", "goal")
    through_solution = True
    needs_from_solver = frozenset({TABLES})

    def __init__(
        self,
        weights: Mapping[str, float],
        density: str = "joint",
        annealing: float = 0.0,
        annealing_steps: int = 2000,
    ) -> None:
        if density not in DENSITIES:
            raise ConfigError(f"unknown objective.density {density!r}: {nearest(str(density), DENSITIES)}")
        self.weights = checked_weights({"goal": GOAL, **weights}, self.term_names)
        self.density = density
        self.annealing = Annealing(annealing, annealing_steps)

    def __call__(self, scene: Scene, forecast: JointForecast, energy: Energy, step: int = 0) -> Terms:
        """The terms of a batch; see :meth:`Objective.__call__`.

        Raises:
            ValueError: the scene has no future, or the forecast no tables of candidates.
        """
        tables = None if forecast.solution is None else forecast.solution.tables
        if tables is None:
            raise ValueError(
                "a density over candidates needs forecast.solution.tables, which is None: use solver=enumeration or "
                "solver=sum_product"
            )
        future, mask = observed_future(scene)
        # NaN energies are replaced before they enter any derivative.
        known = tables.log_partition.isfinite()
        unary = torch.where(known[:, None, None], tables.unary, 0.0)
        pair = torch.where(known[:, None, None, None], tables.pair, 0.0)

        distance = losses.distances(tables.states[..., :2], future, mask)
        allowed = unary.transpose(1, 2).isfinite()
        closest = torch.where(allowed, distance, torch.inf).argmin(1)
        if self.density == "joint":
            _, log_partition = assignments.partition(unary, pair, scene.agent_mask)
            log_density = _joint(unary, pair, scene.agent_mask, closest, mask.any(-1)) - log_partition
            density = losses.joint_density(torch.where(known, log_density, torch.nan), mask)
        else:
            density = losses.marginal_density(tables.log_marginals.transpose(1, 2), closest, mask)
        alone = torch.where(known[:, None, None], (-unary).log_softmax(-1), torch.nan).transpose(1, 2)
        temperature = self.annealing.at(step)
        if is_positive(temperature):
            taught = torch.where(allowed | ~allowed.any(1, keepdim=True), distance, torch.inf)
        else:
            taught = distance.gather(1, closest[:, None])
        regression, _ = losses.marginal_imitation(taught, mask, temperature=temperature)
        return {
            "density": (self.weights["density"], density),
            "marginal": (self.weights["marginal"], losses.marginal_density(alone, closest, mask)),
            "regression": (self.weights["regression"], regression),
            **goal_term(scene, forecast, self.weights["goal"]),
        }


def _joint(unary: Tensor, pair: Tensor, present: Tensor, closest: Tensor, observed: Tensor) -> Tensor:
    """Logarithm of the sum of exp(-E) over all assignments in which observed agents take their closest candidates."""
    candidate = torch.arange(unary.shape[2], device=unary.device)
    other = observed[..., None] & (candidate != closest[..., None])
    _, log_sum = assignments.partition(torch.where(other, torch.inf, unary), pair, present)
    return log_sum
