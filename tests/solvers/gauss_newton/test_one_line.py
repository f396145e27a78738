"""Agents on one line: what docs/layer.md says of them, and of the status of a solution."""

from __future__ import annotations

import pytest
import torch

from epo_lightning import FeatureEnergy, GameParameters, LevenbergMarquardt, Scene, Status


@pytest.mark.parametrize("feature", ["circles", "proximity"])
@pytest.mark.parametrize("turn", [0.0, 0.001])
def test_vehicles_on_one_line_pass_beside_each_other_only_after_a_small_turn(feature: str, turn: float) -> None:
    history = torch.tensor([[[[0.0, 0.0, 0.0, 20.0]], [[25.0, 0.0, 0.0, 12.0]]]]).double()
    scene = Scene(
        history,
        dt=0.2,
        size=torch.tensor([[[4.5, 1.9], [4.5, 1.9]]]).double(),
        reference_speed=torch.tensor([[20.0, 12.0]]).double(),
    )
    controls = torch.zeros(1, 1, 2, 20, 2).double()
    controls[:, :, 0, :, 1], controls[:, :, 1, :, 1] = turn, -turn
    parameters = GameParameters(
        own_weights={name: torch.ones(1, 1, 2).double() for name in ("velref", "acc", "turnr")},
        pair_weights={feature: torch.full((1, 1, 1), 10.0).double()},
        goals=torch.zeros(1, 1, 2, 2).double(),
        initial_controls=controls,
    )
    solve = LevenbergMarquardt(steps=200, step_size=1.0, damping=1.0, adaptive=True)
    solution = solve(FeatureEnergy(own=["velref", "acc", "turnr"], pair=[feature]), scene, parameters)
    first, second = solution.states[0, 0, :, :, :2]
    assert solution.status.item() == Status.COMPLETED  # also where they have driven through each other
    through = (first - second).norm(dim=-1).min() < 2.5
    aside = solution.states[0, 0, :, :, 1].abs().max()
    if turn:
        assert not through
        assert solution.energy.item() < 0.1
        assert solution.gradient_norm.item() < 0.01
        assert aside > 0.5
    else:
        assert through
        assert solution.energy.item() > 100.0
        assert aside == 0.0
