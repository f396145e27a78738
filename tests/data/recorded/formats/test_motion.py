"""Headings of agents whose heading is not recorded."""

from __future__ import annotations

import numpy as np

from epo_lightning.data.recorded.formats.motion import direction_of_motion

SLOW = 0.3


def test_an_agent_has_the_direction_of_its_first_velocity_until_it_moves():
    agent = np.array([0, 0, 0, 0, 1, 1])
    velocity = np.array([[0.1, 0.0], [0.0, 0.1], [0.0, -1.0], [0.1, 0.0], [-0.1, 0.0], [0.0, 0.1]])
    found = direction_of_motion(agent, velocity, SLOW)
    np.testing.assert_allclose(found, [0.0, 0.0, -np.pi / 2, -np.pi / 2, np.pi, np.pi])


def test_a_velocity_of_zero_has_the_direction_of_x_whatever_the_sign_of_its_zeros():
    """The other angles of signed zeros are half a turn and its negative."""
    signs = np.array([[0.0, 0.0], [-0.0, 0.0], [0.0, -0.0], [-0.0, -0.0]])
    assert direction_of_motion(np.arange(4), signs).tolist() == [0.0] * 4
