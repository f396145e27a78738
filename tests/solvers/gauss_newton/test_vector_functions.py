"""The sine, cosine and arctangent of the kernel, seen through states and energies, against those of PyTorch in float64."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from games import random_game, random_scene

from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.gauss_newton.backends import compiled
from epo_lightning.solvers.gauss_newton.kernel import interface

if isinstance(interface.find(), str):
    pytest.skip("the kernel was not built", allow_module_level=True)

MANY = 20_001


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vector_functions_are_exact_to_a_unit_in_the_last_place(dtype):
    scene, unit = random_scene(MANY, 1, history=1, size=1.0, dtype=dtype), torch.finfo(dtype).eps
    scene = dataclasses.replace(scene, dt=1.0)
    heading, turn = torch.linspace(-3000.0, 3000.0, MANY, dtype=dtype), torch.linspace(-20.0, 20.0, MANY, dtype=dtype)
    scene.history[..., :2] = 0.0
    scene.history[:, 0, 0, 2] = heading
    scene.history[..., 3] = 1.0
    game = random_game(scene, 1, 2, own=("steer",), spread=0.0, pair=())
    game.own_weights["steer"].fill_(1.0)
    game.initial_controls[:, 0, 0, 0, 1] = turn
    solution = compiled.solve(FeatureEnergy(["steer"], []), scene, game, 0, 0.3, torch.ones(MANY, 1, dtype=dtype))
    after_a_second = solution.states[:, 0, 0, 0].double()
    assert (after_a_second[:, 0] - heading.double().cos()).abs().max() < 0.75 * unit
    assert (after_a_second[:, 1] - heading.double().sin()).abs().max() < 0.75 * unit
    # At 1 m/s, the steering angle is atan(0.6 length * turn rate), and its cost half the square.
    angle = (2.0 * solution.energy[:, 0].double()).sqrt()
    assert (angle - (0.6 * turn.double()).atan().abs()).abs().max() < 2.0 * unit
