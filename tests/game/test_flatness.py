"""Controls from positions in closed form: exact without noise, smooth with it, headings of slow agents kept."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.flatness import JERK, followed_controls
from epo_lightning.scene import HEADING, SPEED

DT = 0.2


def moving(seed: int, agents: int = 5, steps: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Present states of agents that move at 5 to 15 m/s in any direction, and random controls that do not stop them."""
    generator = torch.Generator().manual_seed(seed)
    current = torch.randn(agents, 4, generator=generator, dtype=torch.float64)
    current[:, SPEED] = 5.0 + 10.0 * torch.rand(agents, generator=generator, dtype=torch.float64)
    current[:, HEADING] *= 3.0
    return current, torch.randn(agents, steps, 2, generator=generator, dtype=torch.float64)


@given(st.integers(0, 10_000), st.integers(2, 25))
@settings(max_examples=25, deadline=None)
def test_without_noise_the_controls_are_those_that_were_driven(seed: int, steps: int):
    current, controls = moving(seed, steps=steps)
    states = Unicycle().rollout(current, controls, DT)
    found = followed_controls(states[..., :2], current, DT, noise=0.0)
    assert_close(found[:, :-1], controls[:, :-1])
    assert (found[:, -1] == 0).all(), "the last control affects no position"
    assert_close(Unicycle().rollout(current, found, DT)[..., :2], states[..., :2])


def test_smooth_positions_are_the_minimum_of_the_stated_cost():
    current, controls = moving(0)
    positions = Unicycle().rollout(current, controls, DT)[..., :2] + 0.1 * torch.randn(5, 12, 2, dtype=torch.float64)
    found = followed_controls(positions, current, DT, noise=0.1)
    q = Unicycle().rollout(current, found, DT)[..., :2].requires_grad_()

    def cost(q: torch.Tensor) -> torch.Tensor:
        third = torch.cat((current[:, None, :2], q), 1).diff(n=3, dim=1)
        return (q - positions).square().sum() / 0.1**2 + third.square().sum() / (JERK * DT**3) ** 2

    (slope,) = torch.autograd.grad(cost(q), q)
    assert slope[:, 1:].abs().max() < 1e-8 * float(cost(q.detach()))
    assert slope[:, :1].abs().max() > 1e-3, "the first position follows from the present velocity"


def test_smoothing_removes_most_of_the_jitter():
    current, controls = moving(1, agents=200, steps=20)
    controls[..., 0] *= 0.3
    controls[..., 1] *= 0.02
    true = Unicycle().rollout(current, controls, DT)[..., :2]
    jittered = true + 0.1 * torch.randn(true.shape, dtype=torch.float64)
    followed = Unicycle().rollout(current, followed_controls(jittered, current, DT, noise=0.1), DT)[..., :2]
    assert (followed - true).square().mean() < 0.5 * (jittered - true).square().mean()


def test_a_standing_agent_keeps_its_heading():
    current = torch.tensor([[1.0, 2.0, 0.7, 0.0]])
    jittered = current[:, None, :2] + 0.03 * torch.randn(1, 10, 2)
    followed = Unicycle().rollout(current, followed_controls(jittered, current, DT, noise=0.1), DT)
    assert_close(followed[..., HEADING], torch.full((1, 10), 0.7))
    assert (followed[..., :2] - current[:, None, :2]).norm(dim=-1).max() < 0.1


def test_headings_turn_the_short_way():
    current = torch.tensor([[0.0, 0.0, math.pi - 0.01, 10.0]])
    controls = torch.tensor([[[0.0, 0.3]] * 8])
    states = Unicycle().rollout(current, controls, DT)
    states[..., HEADING] = torch.remainder(states[..., HEADING] + math.pi, 2 * math.pi) - math.pi
    found = followed_controls(states[..., :2], current, DT, noise=0.0)
    assert_close(found[:, :-1], controls[:, :-1], rtol=0, atol=1e-3)
