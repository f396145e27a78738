"""The double integrator against a loop over time."""

from __future__ import annotations

import math

import torch

from epo_lightning.game.double_integrator import STANDING, DoubleIntegrator

ROLL = DoubleIntegrator().rollout


def loop(state, controls, dt):
    """Positions and velocities, step by step, and the heading and speed of these velocities."""
    x, y, theta, speed = state
    vx, vy = speed * math.cos(theta), speed * math.sin(theta)
    states = []
    for along, across in controls:
        x, y = x + dt * vx, y + dt * vy
        vx += dt * (math.cos(theta) * along - math.sin(theta) * across)
        vy += dt * (math.sin(theta) * along + math.cos(theta) * across)
        states.append((x, y, vx, vy))
    return torch.tensor(states, dtype=torch.float64)


def test_rollout_equals_a_loop_over_time():
    initial = torch.randn(3, 4, dtype=torch.float64)
    controls = 2.0 * torch.randn(3, 25, 2, dtype=torch.float64)
    states = ROLL(initial, controls, 0.1)
    for sample in range(3):
        x, y, vx, vy = loop(initial[sample].tolist(), controls[sample].tolist(), 0.1).unbind(-1)
        torch.testing.assert_close(states[sample, :, 0], x, rtol=0, atol=1e-12)
        torch.testing.assert_close(states[sample, :, 1], y, rtol=0, atol=1e-12)
        heading, speed = states[sample, :, 2], states[sample, :, 3]
        torch.testing.assert_close(speed, torch.hypot(vx, vy), rtol=0, atol=1e-12)
        moving = speed >= STANDING
        torch.testing.assert_close((speed * heading.cos())[moving], vx[moving], rtol=0, atol=1e-12)
        torch.testing.assert_close((speed * heading.sin())[moving], vy[moving], rtol=0, atol=1e-12)
        assert ((heading - initial[sample, 2]).abs() <= math.pi).all()
        assert (heading[~moving] == initial[sample, 2]).all()


def test_positions_are_affine_in_the_controls():
    initial = torch.randn(2, 1, 4, dtype=torch.float64)
    one, other = torch.randn(2, 2, 3, 9, 2, dtype=torch.float64)
    blend = ROLL(initial, 0.3 * one + 0.7 * other, 0.2)
    parts = 0.3 * ROLL(initial, one, 0.2) + 0.7 * ROLL(initial, other, 0.2)
    torch.testing.assert_close(blend[..., :2], parts[..., :2], rtol=0, atol=1e-12)
    assert (blend[..., 3] - parts[..., 3]).abs().max() > 1e-3  # speeds are not


def test_straight_motion_has_constant_heading():
    initial = torch.tensor([1.0, 2.0, 3.0, 0.5])
    states = ROLL(initial, torch.zeros(4, 2), 0.1)
    assert states.shape == (4, 4)
    assert (states[:, 2] == 3.0).all()
    assert (states[:, 3] == 0.5).all()


def test_gradients_of_a_standing_agent_are_finite():
    controls = torch.zeros(5, 2, dtype=torch.float64, requires_grad=True)
    states = ROLL(torch.tensor([0.0, 0.0, 0.7, 0.0], dtype=torch.float64), controls, 0.1)
    assert (states[:, 2] == 0.7).all()
    (slope,) = torch.autograd.grad(states.sum(), controls, create_graph=True)
    assert slope.isfinite().all()
    assert torch.autograd.grad(slope.square().sum() + states.sum(), controls)[0].isfinite().all()
