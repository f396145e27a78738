"""Controls from observed motion: exact for futures of the dynamics, close for others, zero where unobserved."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from games import pad, random_scene
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from epo_lightning.game.double_integrator import DoubleIntegrator
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.tracking import demonstrated, observed_controls, with_motion
from epo_lightning.metrics.functional import overlapping_pairs
from epo_lightning.scene import HEADING, Scene

EULER = Unicycle()


class Linear:
    """Controls are accelerations along x and y; the state is x, y, and the velocity in place of heading and speed."""

    def rollout(self, initial, controls, dt):
        start = initial[..., None, :].expand(*controls.shape[:-2], 1, 4)
        velocity = start[..., 2:] + dt * controls.cumsum(-2)
        before = torch.cat((start[..., 2:], velocity[..., :-1, :]), -2)
        return torch.cat((start[..., :2] + dt * before.cumsum(-2), velocity), -1)


def turned(scene: Scene) -> Scene:
    """The scene with agents that begin just short of heading backwards."""
    history = scene.history.clone()
    history[..., HEADING] = 3.1
    return dataclasses.replace(scene, history=history)


def driven(scenes=3, agents=2, horizon=40, spread=0.5, dynamics=EULER, dtype=torch.float64):
    scene = turned(random_scene(scenes, agents, horizon=horizon, dtype=dtype))
    controls = spread * torch.randn(scenes, agents, horizon, 2, dtype=dtype)
    return dataclasses.replace(scene, future=dynamics.rollout(scene.current, controls, scene.dt)), controls


def wrapped(scene: Scene) -> Scene:
    future = scene.future.clone()
    future[..., HEADING] = torch.remainder(future[..., HEADING] + math.pi, 2 * math.pi) - math.pi
    return dataclasses.replace(scene, future=future)


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "heun"])
def test_motion_of_the_same_dynamics_gives_its_controls_back(integrator):
    dynamics = Unicycle(integrator)
    scene, controls = driven(spread=1.5, dynamics=dynamics)
    scene = wrapped(scene)
    assert (scene.future[..., HEADING].diff(dim=-1).abs() > math.pi).any()
    found, error = observed_controls(dynamics, scene)
    assert_close(found, controls, rtol=0, atol=1e-8)
    assert (error < 1e-8).all()


def test_a_rollout_follows_motion_of_other_dynamics():
    scene, controls = driven(dynamics=Unicycle("semi_implicit"))
    _, guess_error = observed_controls(EULER, scene, steps=0)
    found, error = observed_controls(EULER, scene)
    reached = EULER.rollout(scene.current, found, scene.dt)
    distance = (reached - scene.future)[..., :2].norm(dim=-1).mean(-1)
    assert_close(error, distance)
    assert (error < guess_error).all()
    assert error.mean() < 0.25 * guess_error.mean()
    assert (error < 0.01).all()
    assert (found - controls).square().mean().sqrt() < 0.1


def test_the_distance_that_remains_is_a_mean_over_observed_steps():
    """Against a loop: steps that were not observed count neither as hits nor as misses."""
    scene, _ = driven(dynamics=Unicycle("semi_implicit"), horizon=12)
    seen = torch.rand(3, 2, 12) < 0.5
    seen[0, 0] = False
    scene = dataclasses.replace(scene, future_mask=seen)
    found, error = observed_controls(EULER, scene)
    reached = EULER.rollout(scene.current, found, scene.dt)
    for b, i in ((b, i) for b in range(3) for i in range(2)):
        missed = [(reached - scene.future)[b, i, k, :2].norm() for k in range(12) if seen[b, i, k]]
        assert error[b, i].item() == pytest.approx(float(sum(missed)) / max(1, len(missed)), abs=1e-12)
    assert error[0, 0] == 0.0
    assert (error > 0).sum() == 5


def test_heading_and_speed_of_a_motion_have_no_gradient():
    """The direction of a standing agent has no derivative: NaN must not come back through it to the positions."""
    positions = torch.tensor([[1.0, 2.0], [1.0, 2.0], [1.0, 5.0]], dtype=torch.float64, requires_grad=True)
    current = torch.tensor([1.0, 2.0, 0.7, 0.0], dtype=torch.float64)
    states = with_motion(positions, current, 0.5)
    expected = [[1.0, 2.0, 0.7, 0.0], [1.0, 2.0, 0.7, 0.0], [1.0, 5.0, math.pi / 2, 6.0]]
    assert_close(states, torch.tensor(expected, dtype=torch.float64))
    states.sum().backward()
    assert torch.equal(positions.grad, torch.ones_like(positions))


@given(
    st.lists(
        st.lists(st.sampled_from([(0, 0), (0, 1), (1, 0), (-2, 1), (0.1, 0.3), (-0.3, 0.1)]), min_size=9, max_size=9),
        min_size=1,
        max_size=3,
    )
)
def test_a_heading_is_the_direction_of_the_last_half_metre(motions: list[list[tuple[float, float]]]):
    """A slow version goes from step to step; an agent that stands, or moves less, keeps its heading."""
    current = torch.tensor([[1.0, 2.0, 0.7, 3.0]] * len(motions), dtype=torch.float64)
    positions = current[:, None, :2] + torch.tensor(motions, dtype=torch.float64).cumsum(1)
    expected = []
    for steps in motions:
        heading, east, north = 0.7, 0.0, 0.0  # the way since the place at which the heading changed
        expected.append([])
        for x, y in steps:
            east, north = east + x, north + y
            if math.hypot(east, north) >= 0.5:
                heading, east, north = math.atan2(north, east), 0.0, 0.0
            expected[-1].append([heading, math.hypot(x, y) / 0.5])
    states = with_motion(positions, current, 0.5)
    assert torch.equal(states[..., :2], positions)
    assert_close(states[..., 2:], torch.tensor(expected, dtype=torch.float64))


def test_cars_that_stand_side_by_side_do_not_overlap_when_their_forecasts_jitter():
    """By directions of single steps, 5 cm of noise would turn each of them by any angle, and nearly all scenes overlap."""
    generator = torch.Generator().manual_seed(0)
    current = torch.zeros(50, 1, 2, 4, dtype=torch.float64)
    current[..., 1, 1] = 3.5
    noise = 0.05 * torch.randn(50, 1, 2, 20, 2, dtype=torch.float64, generator=generator)
    states = with_motion(current[..., None, :2] + noise, current, 0.2)
    size = torch.tensor([4.5, 1.8], dtype=torch.float64).expand(50, 2, 2)
    here = torch.ones(50, 2, dtype=torch.bool)
    assert not overlapping_pairs(states[:, 0], size, here, "box").any()
    turned = states.clone()
    before = torch.cat((current[..., None, :2], states[..., :-1, :2]), -2)
    turned[..., 2] = torch.atan2(*(states[..., :2] - before).flip(-1).unbind(-1))
    assert overlapping_pairs(turned[:, 0], size, here, "box").all()


def test_noise_does_not_become_wild_controls():
    scene, controls = driven(scenes=8)
    clean = scene.future
    noisy = dataclasses.replace(scene, future=clean + 0.01 * torch.randn_like(clean))
    found, error = observed_controls(EULER, noisy)
    assert (error < 0.02).all()
    # Differences of speeds and headings alone are sqrt(2) 0.01 / dt = 0.14 off.
    assert (found - controls).square().mean().sqrt() < 0.25


def test_linear_motion_is_tracked_in_one_step_from_zero_controls():
    time = torch.linspace(0.0, 3.0, 40, dtype=torch.float64)
    scene = random_scene(3, 2, horizon=40, dtype=torch.float64)
    controls = torch.stack((time.sin(), (2.0 * time).cos()), -1).expand(3, 2, -1, -1)
    scene = dataclasses.replace(scene, future=Linear().rollout(scene.current, controls, scene.dt))
    found, error = observed_controls(Linear(), scene, steps=1)
    assert (error < 2e-3).all()
    assert (found - controls).square().mean().sqrt() < 0.1
    # The problem is quadratic: its solution is where a step leads, and it stays there.
    again, _ = observed_controls(Linear(), scene, steps=3)
    assert_close(again, found, rtol=0, atol=1e-8)


def test_a_double_integrator_follows_a_unicycle():
    scene, _ = driven(spread=0.2)
    found, error = observed_controls(DoubleIntegrator(), scene)
    reached = DoubleIntegrator().rollout(scene.current, found, scene.dt)
    assert_close(error, (reached - scene.future)[..., :2].norm(dim=-1).mean(-1))
    assert (error < 0.01).all()
    assert (found.abs() < 5.0).all()


def test_the_solution_minimises_the_documented_cost():
    # Independently: a linear least-squares problem in double precision, solved by QR.
    scene, _ = driven(1, 1, horizon=12, dynamics=Unicycle("heun"))
    scene = dataclasses.replace(scene, future=scene.future + 0.02 * torch.randn_like(scene.future))
    found, _ = observed_controls(Linear(), scene, steps=1)
    free = Linear().rollout(scene.current, torch.zeros_like(found), scene.dt)[0, 0, :, :2]
    unit = torch.eye(24, dtype=torch.float64).view(24, 12, 2)
    columns = Linear().rollout(torch.zeros(24, 4, dtype=torch.float64), unit, scene.dt)[..., :2]
    for channel in range(2):
        reach = columns[channel::2, :, channel].T
        mu = 0.01 * reach.square().sum() / 12
        rows = torch.cat((reach, mu.sqrt() * torch.eye(12, dtype=torch.float64).diff(dim=0)))
        goal = torch.cat((scene.future[0, 0, :, channel] - free[:, channel], torch.zeros(11, dtype=torch.float64)))
        expected = torch.linalg.lstsq(rows, goal[:, None]).solution[:, 0]
        assert_close(found[0, 0, :, channel], expected, rtol=0, atol=1e-4)


def test_unobserved_steps_have_no_weight():
    scene, controls = driven(2, 3, horizon=10)
    mask = torch.ones(2, 3, 10, dtype=torch.bool)
    mask[0, 1, 6:] = False  # left
    mask[1, 0] = False  # never seen
    mask[1, 2, 3:5] = False  # out of sight for two steps
    future = torch.where(mask[..., None], scene.future, torch.nan)
    found, error = observed_controls(EULER, dataclasses.replace(scene, future=future, future_mask=mask))
    told = torch.ones(2, 3, 10, dtype=torch.bool)
    told[0, 1, 6:] = told[1, 0] = False
    assert torch.equal(demonstrated(dataclasses.replace(scene, future_mask=mask)), told)
    assert (found[~told] == 0).all()
    whole = mask.all(-1)
    assert_close(found[whole], controls[whole], rtol=0, atol=1e-8)
    assert_close(found[0, 1, :6], controls[0, 1, :6], rtol=0, atol=1e-8)
    assert error[1, 0] == 0
    reached = EULER.rollout(scene.current, found, scene.dt)
    assert ((reached - scene.future)[1, 2, mask[1, 2], :2].norm(dim=-1) < 0.05).all()


def test_standing_agents_do_not_turn():
    scene = random_scene(2, 1, horizon=10, dtype=torch.float64)
    history = scene.history.clone()
    history[..., 3] = 0.0
    still = history[:, :, -1:].expand(-1, -1, 10, -1)
    jitter = still.clone()
    jitter[..., :2] += 0.01 * torch.randn(2, 1, 10, 2, dtype=torch.float64)
    found, _ = observed_controls(EULER, dataclasses.replace(scene, history=history, future=still))
    assert (found == 0).all()
    found, error = observed_controls(EULER, dataclasses.replace(scene, history=history, future=jitter))
    assert found.isfinite().all()
    assert (error < 0.03).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tracking_does_not_depend_on_padding_or_batch(dtype):
    scene, _ = driven(dynamics=Unicycle("heun"), dtype=dtype)
    found, error = observed_controls(EULER, scene)
    assert found.dtype == error.dtype == dtype
    tolerance = {"rtol": 0, "atol": 1e-10 if dtype == torch.float64 else 2e-3}
    wide, wide_error = observed_controls(EULER, pad(scene))
    assert_close(wide[:, :2], found, **tolerance)
    assert (wide[:, 2:] == 0).all()
    assert (wide_error[:, 2:] == 0).all()
    alone, _ = observed_controls(EULER, scene[1])
    assert_close(alone[0], found[1], **tolerance)


def test_a_scene_without_a_future_is_refused():
    scene = dataclasses.replace(random_scene(), future=None, future_mask=None)
    with pytest.raises(ValueError, match=r"scene\.future"):
        observed_controls(EULER, scene)
    with pytest.raises(ValueError, match=r"scene\.future"):
        demonstrated(scene)
