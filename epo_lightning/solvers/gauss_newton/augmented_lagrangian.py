"""Hard constraints by an augmented Lagrangian around the layer (Nocedal and Wright 2006, chapter 17).

The paper's collision terms and bounds are soft: how much they are violated depends on their weights. Here they are
constraints h(u) <= 0 of the game,

    min_u E(u)    subject to    R_ij - |p_i,k - p_j,k| <= 0,    lower <= s_i,k <= upper,

with E made of all other features. Each round minimises, by the layer's steps,

    L_A(u) = E(u) + mu / 2 sum_c max(0, h_c(u) + lambda_c / mu)^2,

whose terms are those of the soft features with the weight sqrt(mu) and with limits that are moved by lambda_c / mu, for
every pair, agent and step. Then

    lambda_c <- max(0, lambda_c + mu h_c(u)),

and mu grows where the violation has not become much smaller. At the end the conditions of Karush, Kuhn and Tucker hold:
grad E + sum_c lambda_c grad h_c = 0, h <= 0, lambda >= 0 and lambda_c h_c = 0. Constraints of pairs count once for both
agents, so a solution is a generalised Nash equilibrium in which both have the same multiplier.

The derivative of the solution is that of these conditions on the active set (lambda_c > 0), by the implicit function
theorem.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.checks import check_number, check_whole
from epo_lightning.forecast import Constraints, GameParameters, Solution, Status
from epo_lightning.game.energy import FEATURES, Energy
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.host import readable
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import STATIONARY, Minimiser
from epo_lightning.solvers.gauss_newton.constrained_game import ConstrainedGame
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt
from epo_lightning.solvers.general import dense, descent

DISCS = ("proximity", "clearance")
"""Pair features that can be constraints: the distance of two discs has a sign."""
SUFFICIENT = 0.5
"""A round in which the violation falls to less than this share needs no larger penalty."""
LARGEST_PENALTY = 1e8
NEAR = 1e-4
"""Gradient, relative to the first one, up to which strategies count as a minimum for an update of the multipliers."""
_SINGULAR = 1e-10
"""Added to the diagonal of the active constraints' matrix, relative to its largest entry: constraints of neighbouring steps
may be dependent."""


@register("solver", "augmented_lagrangian")
@dataclass(frozen=True)
class AugmentedLagrangian(Minimiser):
    """Rounds of the layer and of updates of multipliers; solutions are constants, so learn with ``backward=implicit``.

    A constraint holds for the agents and pairs whose weight of its feature is not zero; its value has no effect on the
    strategies. A sample is COMPLETED if its constraints are met to the tolerance at a minimum of the augmented Lagrangian.
    Others are STOPPED at the end: their constraints may be impossible to meet, such as those of agents that overlap from the
    beginning, or the rounds were too few. ``Solution.constraints`` says how much is missing.

    Attributes:
        constraints: names of the features that are constraints, ``proximity``, ``clearance`` and bounds (``velb``, ``accb``,
            ...); None for all of these that the energy has.
        rounds: largest number of rounds. Multipliers are updated in those that end near a minimum.
        steps: adaptive Gauss-Newton steps of the first round.
        newton_steps: adaptive steps with the Hessian, in every round.
        damping: lambda of the first step.
        penalty: mu of the first round.
        growth: factor of mu after a round without sufficient progress.
        tolerance: largest violation at the end, in the unit of the feature: [m] for pairs. The slack of a constraint with a
            multiplier is as small.
    """

    needs_from_energy = frozenset({FEATURES})
    provides = frozenset({STATIONARY})

    constraints: Sequence[str] | None = None
    rounds: int = 100
    steps: int = 10
    newton_steps: int = 3
    damping: float = 1.0
    penalty: float = 10.0
    growth: float = 4.0
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        check_whole("solver.rounds", self.rounds, least=1)
        check_whole("solver.newton_steps", self.newton_steps, least=1)
        check_number("solver.penalty", self.penalty)
        if self.penalty > LARGEST_PENALTY:
            raise ConfigError(
                f"solver.penalty must be at most {LARGEST_PENALTY:g}, not {self.penalty:g}: it only grows"
            )
        check_number("solver.tolerance", self.tolerance)
        check_number("solver.growth", self.growth)
        if self.growth < 1:
            raise ConfigError(f"solver.growth must be 1 or more, not {self.growth}: the penalty does not fall")
        if self.constraints is not None and not self.constraints:
            raise ConfigError("solver.constraints is empty: name features, or null for all that can be constraints")
        self.inner()  # checks its settings

    def inner(self) -> LevenbergMarquardt:
        """The steps of the rounds. Limits that differ from step to step are known to the PyTorch backend alone."""
        return LevenbergMarquardt(
            steps=self.steps,
            step_size=1.0,
            damping=self.damping,
            adaptive=True,
            newton_steps=self.newton_steps,
            backend="pytorch",
        )

    def hard(self, energy: FeatureEnergy) -> tuple[str, ...]:
        """Names of the energy's features that are constraints.

        Raises:
            ConfigError: a name that the energy does not have or that cannot be a constraint, none at all, or no other
                feature.
        """
        bounded = [name for name, feature in energy.own_features.items() if feature.bounded]
        can = (*bounded, *(name for name in energy.pair if name in DISCS))
        chosen = can if self.constraints is None else tuple(self.constraints)
        for name in chosen:
            if name not in can:
                raise ConfigError(
                    f"solver.constraints: {name!r} is no feature of this energy that can be a constraint, which are "
                    f"proximity, clearance and bounds such as velb; {nearest(name, can)}"
                )
        if not chosen:
            raise ConfigError(
                "solver=augmented_lagrangian needs an energy with constraints: proximity or clearance in energy.pair, or "
                "bounds such as velb in energy.own"
            )
        if not (set(energy.own) | set(energy.pair)) - set(chosen):
            raise ConfigError("solver=augmented_lagrangian needs a feature besides the constraints, which is minimised")
        return chosen

    def check(self, energy: Energy) -> None:
        """Refuse an energy without the features that are to be constraints.

        Raises:
            ConfigError: as :meth:`hard`.
        """
        if isinstance(energy, FeatureEnergy):
            self.hard(energy)

    @torch.no_grad()
    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        """Rounds until the constraints of all games are met.

        Raises:
            ConfigError: as :meth:`hard`.
            ValueError: scene and parameters do not fit together.
        """
        if not isinstance(energy, FeatureEnergy):
            raise ValueError(f"solver=augmented_lagrangian takes energy=features, not {type(energy).__name__}")
        names = self.hard(energy)
        scene, controls = descent.begin(energy, scene, parameters)
        if controls.numel() == 0:
            return descent.nothing(controls)
        game = ConstrainedGame(energy, names, scene, parameters.for_every_mode(controls.shape[1]))
        initial = energy(scene, game.parameters, controls)
        rounds = _Rounds.begin(self, game, controls, initial)
        for _ in range(self.rounds):
            if descent.ended(~rounds.open):
                break
            rounds.advance()
        controls = rounds.controls
        violation = _largest({name: value.clamp_min(0.0) for name, value in game.excess(controls).items()})
        return Solution(
            controls=controls,
            states=energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt),
            initial_energy=initial,
            energy=energy(scene, game.parameters, controls),
            gradient_norm=rounds.norm,
            status=torch.where(rounds.solved, int(Status.COMPLETED), int(Status.STOPPED)),
            constraints=Constraints(rounds.multipliers, rounds.penalty, violation, rounds.count),
        )

    def attach(
        self, energy: Energy, scene: Scene, parameters: GameParameters, solution: Solution, exact: bool
    ) -> tuple[Tensor, Tensor]:
        """The controls of a solution with the derivative of the optimality conditions on the active set, and a status.

        With the Hessian H of the Lagrangian, the Jacobian A of the active constraints and the derivatives f and c of grad L
        and of these constraints by a parameter,

            H du + A^T dlambda = -f,    A du = -c.

        Samples of which a constraint is not met, or at which H + mu A^T A is not positive definite, are STOPPED and get no
        gradient. It is computed with dense matrices in float64.
        """
        assert isinstance(energy, FeatureEnergy)
        assert solution.constraints is not None
        names, met = self.hard(energy), solution.status != Status.STOPPED
        state = solution.constraints.to(torch.float64)
        game = ConstrainedGame(energy, names, scene.to(torch.float64), parameters.to(torch.float64))
        controls = torch.where(descent.wide(met), solution.controls, 0.0).detach().double()
        multipliers = torch.cat([value.flatten(2) for value in state.multipliers.values()], -1)
        with torch.no_grad():
            matrix = (
                game.hessian(multipliers, controls)
                if exact
                else dense.gauss_newton(game.objective, game.scene, game.parameters, controls)
            )
            active = multipliers > 0
            most = int(active.sum(-1).max()) if active.numel() else 0
            real, rows = active.to(torch.int8).topk(most, -1)
            jacobian = torch.take_along_dim(game.jacobian(controls), rows[..., None], 2) * real[..., None]
            penalty = state.penalty[..., None, None]
            factor, definite = dense.factorise(matrix + jacobian.mT @ (penalty * jacobian))
            solved = torch.cholesky_solve(jacobian.mT, factor)
            schur = jacobian @ solved
            if most:
                floor = _SINGULAR * schur.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
                schur = schur + torch.diag_embed(1.0 - real + floor)
            pivots = torch.linalg.lu_factor_ex(schur)
            definite = definite & met & (pivots.info == 0) & pivots.LU.flatten(2).isfinite().all(-1)
            # Zeros in place of what is not finite, because zero times NaN is NaN.
            kept = definite[..., None, None]
            jacobian, solved = torch.where(kept, jacobian, 0.0), torch.where(kept, solved, 0.0)
            lower_upper = torch.where(kept, pivots.LU, torch.eye(most, dtype=schur.dtype, device=schur.device))
        with torch.enable_grad():
            scene, parameters = dense.with_zeros(game.scene, game.parameters, definite)
            game = dataclasses.replace(game, scene=scene, parameters=parameters)
            slope = game.slope(multipliers, controls)
            excess = torch.cat([value.flatten(2) for value in game.excess(controls).values()], -1)
            excess = torch.where(real > 0, torch.take_along_dim(excess, rows, -1), 0.0)
            change, moved = (slope - slope.detach()).flatten(2)[..., None], (excess - excess.detach())[..., None]
            free = -torch.cholesky_solve(change + jacobian.mT @ (penalty * moved), factor)
            pushed = torch.linalg.lu_solve(lower_upper, pivots.pivots, jacobian @ free + moved) if most else moved
            step = (free - solved @ pushed)[..., 0].view_as(controls)
            attached = solution.controls.detach() + torch.where(descent.wide(definite), step, 0.0).to(solution.controls)
        return attached, torch.where(definite, int(Status.COMPLETED), int(Status.STOPPED))


@dataclass
class _Rounds:
    """The state of the rounds of a batch, which :meth:`advance` changes.

    Attributes:
        solver, game: what is solved.
        controls: the strategies.
        damping: that of the layer's steps, by sample, as all that follows.
        multipliers, penalty: lambda by constraint, and mu.
        before: violation (or slack with a multiplier) after the last update.
        steepest, norm: norm of the gradient of E at the start, plus one; and of the augmented Lagrangian.
        open: whether a sample needs more rounds.
        solved: whether its constraints are met at a minimum.
        count: number of its rounds.
    """

    solver: AugmentedLagrangian
    game: ConstrainedGame
    controls: Tensor
    damping: Tensor
    multipliers: dict[str, Tensor]
    penalty: Tensor
    before: Tensor
    steepest: Tensor
    norm: Tensor
    open: Tensor
    solved: Tensor
    count: Tensor

    @classmethod
    def begin(cls, solver: AugmentedLagrangian, game: ConstrainedGame, controls: Tensor, initial: Tensor) -> _Rounds:
        """The state after the Gauss-Newton steps of the first round; ``initial`` is E [B, M] at the start."""
        multipliers = {name: torch.zeros_like(value) for name, value in game.excess(controls).items()}
        penalty, finite = torch.full_like(initial, solver.penalty), initial.isfinite()
        found, damping = solver.inner().run(*game.augmented(multipliers, penalty, controls), solver.steps)
        return cls(
            solver,
            game,
            torch.where(descent.wide(finite), found.controls, controls),
            damping,
            multipliers,
            penalty,
            torch.full_like(initial, torch.inf),
            1.0 + _slope(game, controls),
            found.gradient_norm,
            finite,
            torch.zeros_like(finite),
            torch.zeros_like(initial, dtype=torch.long),
        )

    def advance(self) -> None:
        """One round of the scenes with an open sample: steps, and an update of multipliers or penalty near a minimum."""
        rows = torch.arange(len(self.open), device=self.open.device)
        if readable(self.open):
            rows = rows[self.open.any(1)]
        solver, game, was_open = self.solver, self.game.of(rows), self.open[rows]
        multipliers, penalty = {name: value[rows] for name, value in self.multipliers.items()}, self.penalty[rows]
        augmented = game.augmented(multipliers, penalty, self.controls[rows])
        found, damping = solver.inner().run(*augmented, solver.newton_steps, self.damping[rows], exact=True)
        controls = torch.where(descent.wide(was_open), found.controls, self.controls[rows])
        norm = torch.where(was_open, found.gradient_norm, self.norm[rows])
        excess, mu = game.excess(controls), descent.wide(penalty, 2)
        # Above a multiplier's slack, h counts; far below, the multiplier itself does, which the update removes.
        missing = _largest({name: h.maximum(-multipliers[name] / mu) for name, h in excess.items()})
        met, flat = missing <= solver.tolerance, math.sqrt(torch.finfo(norm.dtype).eps)
        # The update is that of a minimum: far from one, more steps are taken first. At a solution the constraints balance
        # the gradient of E, which may be steeper there than at the start, and whose rounding then decides what is flat.
        steepest = self.steepest[rows]
        near = torch.where(met, flat * steepest.maximum(1.0 + _slope(game, controls)), max(flat, NEAR) * steepest)
        settled = was_open & (norm <= near)
        for name, multiplier in multipliers.items():
            updated = (multiplier + mu * excess[name]).clamp_min(0.0)
            self.multipliers[name][rows] = torch.where(descent.wide(settled, 2), updated, multiplier)
        slow = settled & (missing > SUFFICIENT * self.before[rows])
        hopeless = slow & ~met & (penalty >= LARGEST_PENALTY)
        self.penalty[rows] = torch.where(slow & ~met, (solver.growth * penalty).clamp_max(LARGEST_PENALTY), penalty)
        self.before[rows] = torch.where(settled, missing, self.before[rows])
        self.controls[rows], self.damping[rows], self.norm[rows] = controls, damping, norm
        self.count[rows] += was_open.long()
        self.solved[rows] |= settled & met
        self.open[rows] = was_open & ~(settled & met) & ~hopeless


def _slope(game: ConstrainedGame, controls: Tensor) -> Float[Tensor, "B M"]:
    """Norm of the gradient of E, without the constraints."""
    return dense.gradient(game.objective, game.scene, game.parameters, controls)[1].flatten(2).norm(dim=-1)


def _largest(values: Mapping[str, Tensor]) -> Float[Tensor, "B M"]:
    """The largest absolute value of every sample, over all constraints; zero where there is none."""
    return descent.largest(torch.cat([value.flatten(2) for value in values.values()], -1))
