"""Candidates from a model of motion: properties of their rollouts."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.decoders.motions import Motions
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.scene import HEADING, SPEED

DT = 0.2


def rolled(motions: Motions, current: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Controls, and the states x_0 .. x_K."""
    controls = motions.controls(current, DT)
    states = Unicycle().rollout(current[:, None], controls, DT)
    start = current[:, None, :, None].expand(*states.shape[:3], 1, 4)
    return controls, torch.cat((start, states), 3)


def moving(agents: int = 6, fastest: float = 15.0) -> torch.Tensor:
    current = torch.randn(2, agents, 4, dtype=torch.float64)
    current[..., SPEED] = fastest * torch.rand(2, agents, dtype=torch.float64)
    return current


def bends(states: torch.Tensor) -> torch.Tensor:
    """Change of heading per metre between two steps, from the positions' chords of the integrator."""
    way = states[..., 1:, :2] - states[..., :-1, :2]
    return states[..., HEADING].diff(dim=-1) / way.norm(dim=-1)


def test_the_first_motion_continues_the_present_one():
    current = moving()
    controls, states = rolled(Motions(7, 10, 2.0, 0.3), current)
    assert (controls[:, 0] == 0).all()
    torch.testing.assert_close(states[:, 0, :, -1, 2:], current[..., 2:])


def test_motions_are_drawn_from_the_mixture_of_the_paper():
    current = moving(fastest=1.0) + torch.tensor([0.0, 0.0, 0.0, 20.0])  # too fast to stop
    _, states = rolled(Motions(101, 12, 2.0, 0.3), current)
    bend = bends(states)
    straight = (bend.abs() < 1e-9).all(-1)
    circle = ~straight & (bend.diff(dim=-1).abs() < 1e-9).all(-1)
    # Linear in the way covered: the second difference quotient is zero.
    way = (states[..., 1:, :2] - states[..., :-1, :2]).norm(dim=-1)
    growth = bend.diff(dim=-1) / way[..., :-1]
    clothoid = ~straight & ~circle & (growth.diff(dim=-1).abs() < 1e-9).all(-1)
    for kind, count in ((straight, 31), (circle, 20), (clothoid, 50)):
        assert (kind.sum(1) == count).all()
    acceleration = states[..., SPEED].diff(dim=-1) / DT
    torch.testing.assert_close(acceleration, acceleration[..., :1].expand_as(acceleration))
    # Both signs of everything, close to the largest values.
    for values, largest in ((acceleration[..., 0], 2.0), (bend[..., 0] * states[..., 0, SPEED] ** 2, 2.0)):
        assert values.amin() < -0.5 * largest
        assert values.amax() > 0.5 * largest


@settings(max_examples=40)
@given(
    st.floats(0.0, 40.0),
    st.floats(0.05, 9.0),
    st.floats(0.005, 2.0),
    st.integers(1, 40),
    st.integers(1, 25),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_motions_stay_within_their_ranges_and_never_reverse(speed, acceleration, curvature, count, horizon, dtype):
    current = torch.tensor([[[1.0, -2.0, 0.7, speed]]], dtype=dtype)
    controls, states = rolled(Motions(count, horizon, acceleration, curvature), current)
    assert controls.shape == (1, count, 1, horizon, 2)
    tolerance = 1e-4 * (1.0 + speed) if dtype == torch.float32 else 1e-9
    assert (states[..., SPEED] >= -tolerance).all()
    assert (controls[..., 0].abs() <= acceleration + tolerance / DT).all()
    turn, before = controls[..., 1].abs(), states[..., :-1, SPEED]
    assert (turn <= curvature * before.abs() + tolerance).all()
    assert (turn * before.abs() <= acceleration + tolerance * (1.0 + curvature)).all(), "sideways"


def test_stopped_agents_stay_and_standing_agents_do_not_turn():
    slow = torch.tensor([[[0.0, 0.0, 0.3, 0.4], [5.0, 0.0, 1.0, 0.0]]], dtype=torch.float64)
    controls, states = rolled(Motions(41, 20, 1.0, 0.5), slow)
    speed = states[..., SPEED]
    stopped = speed[:, :, 0, -1].abs() < 1e-12
    assert 0 < stopped.sum() < 41
    assert (controls[:, :, 0][stopped][:, -1] == 0).all()
    standing = speed[..., :-1] < 1e-12
    assert (controls[..., 1][standing] == 0).all()
    brakes = controls[:, :, 1, 0, 0] <= 0
    assert (states[:, :, 1][brakes] == slow[:, None, 1, None]).all(), "who stands and brakes does nothing at all"
    assert (speed[:, :, 1, -1] > 0).any()


def test_agents_rolling_backwards_are_slowed_within_the_range():
    current = torch.tensor([[[0.0, 0.0, 0.0, -0.2]]], dtype=torch.float64)
    controls, states = rolled(Motions(21, 10, 1.0, 0.5), current)
    assert (controls[..., 0].abs() <= 1.0).all()
    assert (states[..., SPEED] >= -0.2 - 1e-12).all()


@pytest.mark.parametrize("count", [2, 3, 6, 12, 100])
def test_candidates_are_distinct_and_equal_for_all_agents(count):
    motions = Motions(count, 8, 2.0, 0.3)
    current = moving() + torch.tensor([0.0, 0.0, 0.0, 2.0])  # too fast to stand after a step, when all brake alike
    controls = motions.controls(current, DT)
    different = (controls[:, :, None] - controls[:, None]).abs().amax((-1, -2)).amin((0, 3))
    assert (different[~torch.eye(count, dtype=torch.bool)] > 1e-6).all()
    assert torch.equal(controls, Motions(count, 8, 2.0, 0.3).controls(current, DT)), "nothing is drawn at random"
    assert torch.equal(controls[1:, :, 2:3], motions.controls(current[1:, 2:3], DT)), (
        "agents do not matter to each other"
    )
    assert not list(motions.parameters())
    assert not motions.state_dict()


@pytest.mark.parametrize("wrong", [{"horizon": 0}, {"count": 0}, {"acceleration": 0.0}, {"curvature": math.inf}])
def test_invalid_ranges_are_refused(wrong):
    name = next(iter(wrong))
    with pytest.raises(ValueError, match=name):
        Motions(**{"horizon": 5, "count": 6, "acceleration": 1.0, "curvature": 0.1, **wrong})
