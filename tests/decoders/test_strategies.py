"""Initial strategies: one network for all agents, and modes that begin on different sides."""

from __future__ import annotations

import pytest
import torch
from games import random_scene

from epo_lightning.decoders.strategies import InitialStrategies
from epo_lightning.game.dynamics import Unicycle


def decoded(swerve: float, modes: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Controls without and with a swerve, of two networks with the same initial weights."""
    scene, z = random_scene(4, 2), torch.randn(4, 2, 8)
    controls = []
    for value in (0.0, swerve):
        torch.manual_seed(0)
        controls.append(InitialStrategies(8, modes, 10, scale=0.3, swerve=value)(z, scene))
    return controls[0], controls[1]


def test_modes_swerve_to_both_sides_and_back() -> None:
    plain, swerving = decoded(0.2)
    difference = (swerving - plain).detach()
    expected = 0.2 * torch.tensor([-1.0, 0.0, 1.0])[:, None] * torch.tensor([1.0] * 5 + [-1.0] * 5)
    torch.testing.assert_close(difference[..., 1], expected[None, :, None].expand(4, 3, 2, 10))
    assert (difference[..., 0] == 0).all()


def test_swerving_agents_begin_on_different_sides() -> None:
    """The mode with the positive turn rate ends to the left of the other, with about the same heading."""
    plain, swerving = (controls.detach() for controls in decoded(0.2, modes=2))
    start = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(4, 1, 2, 4)
    last = Unicycle().rollout(start, swerving - plain, 0.1)[..., -1, :]
    assert (last[:, 1, :, 1] > 0.03).all()
    assert (last[:, 0, :, 1] < -0.03).all()
    assert last[..., 2].abs().max() == pytest.approx(0.0, abs=1e-6)
