"""Controls from positions in closed form: exact without noise, smooth with it, headings of slow agents kept."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.flatness import JERK, STILL, _smoothing, followed_controls
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


def before_agents_could_reverse(positions: torch.Tensor, current: torch.Tensor, noise: float) -> torch.Tensor:
    """The formula for agents that only drive forwards."""
    start = torch.stack((current[..., HEADING].cos(), current[..., HEADING].sin()), -1) * current[..., SPEED, None]
    begin = torch.stack((current[..., :2], current[..., :2] + DT * start), -2)
    smooth = _smoothing(positions.shape[-2], noise / (JERK * DT**3)).to(positions)
    velocity = torch.cat((begin, smooth @ torch.cat((begin, positions[..., 1:, :]), -2)), -2).diff(dim=-2) / DT
    heading = torch.atan2(velocity[..., 1], velocity[..., 0])
    heading = torch.cat((current[..., None, HEADING], heading[..., 1:]), -1)
    known = torch.where(DT * velocity.norm(dim=-1) > max(noise, STILL), torch.arange(heading.shape[-1]), 0)
    heading = heading.gather(-1, known.cummax(-1).values)
    speed = velocity[..., 0] * heading.cos() + velocity[..., 1] * heading.sin()
    speed = torch.cat((current[..., None, SPEED], speed[..., 1:]), -1)
    turn = torch.remainder(heading.diff(dim=-1) + torch.pi, 2.0 * torch.pi) - torch.pi
    rates = torch.stack((speed.diff(dim=-1), turn), -1) / DT
    return torch.cat((rates, torch.zeros_like(rates[..., :1, :])), -2)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_agents_that_drive_forwards_are_followed_with_the_same_bits_as_before(noise: float, dtype: torch.dtype):
    current, controls = moving(3, agents=500, steps=20)
    positions = Unicycle().rollout(current, 0.5 * controls, DT)[..., :2] + noise * torch.randn(500, 20, 2)
    positions, current = positions.to(dtype), current.to(dtype)
    found = followed_controls(positions, current, DT, noise)
    assert torch.equal(found, before_agents_could_reverse(positions, current, noise))


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize(
    ("speed", "acceleration"), [(-1.5, 0.0), (0.0, -2.0), (1.0, -1.0), (-1.0, 1.0), (0.0, 2.0), (-0.01, 2.0)]
)
def test_agents_that_reverse_keep_their_heading(noise: float, speed: float, acceleration: float):
    """Backwards, from a stand backwards, from forwards to backwards, the other way round, and forwards from a stand."""
    current = torch.tensor([[0.0, 0.0, 0.4, speed]], dtype=torch.float64)
    controls = torch.tensor([[[acceleration, 0.0]] * 15], dtype=torch.float64)
    states = Unicycle().rollout(current, controls, DT)
    found = followed_controls(states[..., :2], current, DT, noise)
    assert_close(found[:, :-1, 1], torch.zeros(1, 14, dtype=torch.float64), rtol=0, atol=1e-6)
    assert_close(found[:, :-1, 0], controls[:, :-1, 0], rtol=0, atol=0.5)


def test_headings_turn_the_short_way():
    current = torch.tensor([[0.0, 0.0, math.pi - 0.01, 10.0]])
    controls = torch.tensor([[[0.0, 0.3]] * 8])
    states = Unicycle().rollout(current, controls, DT)
    states[..., HEADING] = torch.remainder(states[..., HEADING] + math.pi, 2 * math.pi) - math.pi
    found = followed_controls(states[..., :2], current, DT, noise=0.0)
    assert_close(found[:, :-1], controls[:, :-1], rtol=0, atol=1e-3)
