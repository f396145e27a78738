"""Theseus 0.2.3 on the same problems, in its fastest mode and in the most favourable formulation that we know.

One vector of all unknowns, one cost function per group of residuals, Jacobians by ``vmap``, fixed damping, no stopping
tolerance, unrolled differentiation, B M problems in one batch, and the faster one of its dense linear solvers.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor  # Theseus does not say whether it computes a Jacobian

from benchmarks.games import Game
from benchmarks.residuals import problem
from epo_lightning.forecast import GameParameters

LINEAR_SOLVERS = ("LUDenseSolver", "CholeskyDenseSolver")
"""Dense linear solvers, the usually faster one first."""


def prepare(game: Game, linear_solver: str) -> Callable[[GameParameters], Tensor]:
    """A function from parameters to controls [B, M, N, K, 2].

    Raises:
        ImportError: Theseus is not installed.
    """
    with warnings.catch_warnings(action="ignore"):  # about sparse solvers that are not installed, nor needed
        import theseus

    plain = problem(game)
    start = plain.unknowns(game.parameters.initial_controls)
    unknowns = theseus.Vector(start.shape[1], name="unknowns", dtype=start.dtype)
    given = plain.tensors(game.parameters)
    auxiliary = [theseus.Variable(value, name=name) for name, value in given.items()]
    unit = theseus.ScaleCostWeight(theseus.Variable(torch.ones(1, 1, dtype=start.dtype), name="unit"))
    objective = theseus.Objective(dtype=start.dtype)
    # One cost function per group of residuals: a single one would pull the rows of all groups back through all others.
    for group in plain.groups:

        def residuals(optim_vars: tuple, aux_vars: tuple, group: str = group) -> Tensor:
            tensors = dict(zip(given, (variable.tensor for variable in aux_vars), strict=True))
            unknowns = optim_vars[0].tensor
            return plain.residuals(unknowns, tensors, (group,), is_functorch_wrapped_tensor(unknowns))

        with torch.no_grad():
            rows = plain.residuals(start, given, (group,), True).shape[1]
        objective.add(
            theseus.AutoDiffCostFunction(
                [unknowns], residuals, rows, cost_weight=unit, aux_vars=auxiliary, autograd_mode="vmap"
            )
        )
    optimizer = theseus.LevenbergMarquardt(
        objective,
        linear_solver_cls=getattr(theseus, linear_solver),
        max_iterations=game.steps,
        step_size=game.step_size,
        abs_err_tolerance=0.0,
        rel_err_tolerance=0.0,
    )
    layer = theseus.TheseusLayer(optimizer, vectorize=False).to(start.device)
    options = {"damping": game.damping, "adaptive_damping": False, "backward_mode": "unroll"}

    def solve(parameters: GameParameters) -> Tensor:
        inputs = {"unknowns": plain.unknowns(parameters.initial_controls), **plain.tensors(parameters)}
        found, _ = layer.forward(inputs, optimizer_kwargs=dict(options))
        return plain.controls(found["unknowns"])

    return solve
