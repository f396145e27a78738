"""The unicycle against a loop over time and against automatic differentiation."""

from __future__ import annotations

import math

import pytest
import torch

from epo_lightning.game.dynamics import Unicycle, controls_between
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, wrapped

INTEGRATORS = ("euler", "semi_implicit", "heun")


def loop(state, controls, dt, integrator):
    """Eq. 13 and its variants, one step after the other."""
    x, y, heading, speed = state
    states = []
    for a, w in controls:
        after_heading, after_speed = heading + w * dt, speed + a * dt
        now = (speed * math.cos(heading), speed * math.sin(heading))
        then = (after_speed * math.cos(after_heading), after_speed * math.sin(after_heading))
        share = {"euler": 1.0, "semi_implicit": 0.0, "heun": 0.5}[integrator]
        x += dt * (share * now[0] + (1 - share) * then[0])
        y += dt * (share * now[1] + (1 - share) * then[1])
        heading, speed = after_heading, after_speed
        states.append((x, y, heading, speed))
    return torch.tensor(states, dtype=torch.float64)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_rollout_equals_a_loop_over_time(integrator):
    initial = torch.randn(3, 4, dtype=torch.float64)
    controls = torch.randn(3, 25, 2, dtype=torch.float64)
    states = Unicycle(integrator).rollout(initial, controls, 0.1)
    for sample in range(3):
        expected = loop(initial[sample].tolist(), controls[sample].tolist(), 0.1, integrator)
        torch.testing.assert_close(states[sample], expected, rtol=0, atol=1e-12)


def test_integrators_agree_as_the_step_shrinks_and_heun_is_of_second_order():
    initial = torch.tensor([0.0, 0.0, 0.3, 1.0], dtype=torch.float64)

    def end(integrator, steps):
        controls = torch.tensor([0.5, 0.7], dtype=torch.float64).expand(steps, 2)
        return Unicycle(integrator).rollout(initial, controls, 2.0 / steps)[-1, :2]

    exact = end("heun", 20_000)
    for integrator, order in (("euler", 1), ("semi_implicit", 1), ("heun", 2)):
        coarse, fine = (end(integrator, steps) - exact for steps in (50, 100))
        assert math.log2(coarse.norm() / fine.norm()) == pytest.approx(order, abs=0.05)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_tangent_equals_automatic_differentiation(integrator):
    unicycle = Unicycle(integrator)
    initial = torch.randn(4, dtype=torch.float64)
    controls = torch.randn(6, 2, dtype=torch.float64)
    jacobian = torch.func.jacfwd(lambda u: unicycle.rollout(initial, u, 0.1))(controls)  # [K, 4, K, 2]
    states = unicycle.rollout(initial, controls, 0.1)

    direction = torch.randn(1, 6, 2, dtype=torch.float64)
    expected = torch.einsum("ksju,ju->ks", jacobian, direction[0])
    torch.testing.assert_close(unicycle.tangent(states, direction, 0.1)[0], expected, rtol=0, atol=1e-12)


def test_controls_between_states_are_those_that_were_driven_also_where_headings_wrap():
    start = torch.tensor([0.0, 0.0, 3.0, 5.0], dtype=torch.float64)
    controls = torch.tensor([[1.0, 0.5], [-2.0, 0.7], [0.0, -1.5], [0.5, 0.2]], dtype=torch.float64)
    states = torch.cat((start[None], Unicycle().rollout(start, controls, 0.4)))
    states[:, HEADING] = wrapped(states[:, HEADING])
    assert states[:, HEADING].diff().abs().amax() > 6
    torch.testing.assert_close(controls_between(states, 0.4), controls)


def test_unknown_integrator_names_the_nearest_one():
    with pytest.raises(ConfigError, match="did you mean 'semi_implicit'"):
        Unicycle("semi-implicit")
