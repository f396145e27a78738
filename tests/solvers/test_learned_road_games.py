"""Games that a forecaster has learned on highways: solutions against SciPy, which knows only the function."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.optimize
import torch

import epo_lightning
from epo_lightning import GameParameters, LevenbergMarquardt, Scene, pretrained
from epo_lightning.forecast import Status
from epo_lightning.game.energy import Energy

RUN = "highway_sim/hivt_m_epo"
MODES = (0, 2, 3)


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_another_minimiser_finds_no_lower_energy(number: int) -> None:
    forecaster: Any = epo_lightning.load(RUN)
    scene = pretrained.examples(RUN)[number : number + 1]
    with torch.no_grad():
        inferred = forecaster.predict(scene).parameters
    scene, games = scene.to(torch.float64), inferred.to(torch.float64)
    solve = LevenbergMarquardt(steps=200, step_size=1.0, damping=1.0, adaptive=True)
    for mode in MODES:
        game = games.map(lambda values, mode=mode: values[:, mode : mode + 1])
        solution = solve(forecaster.energy, scene, game)
        assert (solution.status == Status.COMPLETED).all()
        energy = solution.energy.item()
        assert energy < 0.8 * solution.initial_energy.item(), "the game is far from solved at its start"
        assert energy <= (1 + 1e-6) * lowest(forecaster.energy, scene, game, game.initial_controls)
        assert energy == pytest.approx(lowest(forecaster.energy, scene, game, solution.controls), rel=1e-9)


def lowest(energy: Energy, scene: Scene, game: GameParameters, start: torch.Tensor) -> float:
    """Energy at which SciPy's L-BFGS ends, from the strategies ``start`` of one game."""

    def function(flat: np.ndarray) -> tuple[float, np.ndarray]:
        controls = torch.from_numpy(flat).view(start.shape).requires_grad_()
        value = energy(scene, game, controls).sum()
        (slope,) = torch.autograd.grad(value, controls)
        return value.item(), slope.flatten().numpy()

    options = {"maxiter": 3000, "maxfun": 6000, "maxcor": 30, "ftol": 1e-15, "gtol": 1e-9}
    peer = scipy.optimize.minimize(function, start.flatten().numpy(), jac=True, method="L-BFGS-B", options=options)
    return float(peer.fun)
