"""Our steps against Theseus' own Levenberg-Marquardt on the same residuals; docs/benchmarks.md says how to install it."""

from __future__ import annotations

import pytest
import torch
from games import ALL, BOUNDS, random_game, random_scene

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

theseus = pytest.importorskip(
    "theseus", reason="the peer is not installed: see docs/benchmarks.md on how to install it"
)


def test_steps_equal_theseus():
    scene = random_scene(3, 2, history=2, size=2.0, dtype=torch.float64)
    parameters = random_game(scene, modes=1, horizon=6)
    energy = FeatureEnergy(ALL, bounds=BOUNDS, lane_slides=True)  # as automatic differentiation does
    shape = parameters.initial_controls.shape

    def residuals(optim_vars, aux_vars):
        controls = optim_vars[0].tensor.view(-1, *shape[1:])
        index = aux_vars[0].tensor[:, 0].long()
        terms = energy.residuals(scene[index], parameters[index], controls)
        return torch.cat([term.flatten(1) for term in terms.values()], -1)

    unknowns = theseus.Vector(shape[1:].numel(), name="controls", dtype=torch.float64)
    index = theseus.Variable(torch.arange(3, dtype=torch.float64)[:, None], name="index")
    rows = sum(term[0].numel() for term in energy.residuals(scene, parameters, parameters.initial_controls).values())
    unit = theseus.ScaleCostWeight(theseus.Variable(torch.ones(1, 1, dtype=torch.float64), name="unit"))
    cost = theseus.AutoDiffCostFunction(
        [unknowns], residuals, rows, cost_weight=unit, aux_vars=[index], autograd_mode="dense"
    )
    objective = theseus.Objective(dtype=torch.float64)
    objective.add(cost)
    optimizer = theseus.LevenbergMarquardt(
        objective, max_iterations=4, step_size=0.3, abs_err_tolerance=0.0, rel_err_tolerance=0.0
    )
    layer = theseus.TheseusLayer(optimizer)
    found, _ = layer.forward(
        {"controls": parameters.initial_controls.flatten(1), "index": index.tensor},
        optimizer_kwargs={"damping": 10.0, "adaptive_damping": False},
    )
    ours = LevenbergMarquardt(4, 0.3, 10.0)(energy, scene, parameters).controls
    torch.testing.assert_close(found["controls"].view(shape), ours, rtol=0, atol=1e-5)
    assert (ours - parameters.initial_controls).abs().max() > 0.1, "the comparison should be about real steps"
