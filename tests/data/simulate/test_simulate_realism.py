"""Statistics of traffic, on motion whose speeds, gaps and manoeuvres are known."""

from __future__ import annotations

import numpy as np
import pytest
from data.recorded.roads import recording

from epo_lightning.data.recorded.clock import Stretches
from epo_lightning.data.simulate import realism
from epo_lightning.data.simulate.realism import DT


def one_vehicle(x: np.ndarray, y: np.ndarray, heading: float) -> Stretches:
    """The stretch of one vehicle; its speed is not read."""
    state = np.stack([x, y, np.full_like(x, heading), np.zeros_like(x)], -1)
    return Stretches(DT, np.array([0]), np.array([0]), np.array([len(x)]), np.array([0]), state)


def test_accelerations_and_jerks_are_those_along_and_to_the_left_of_the_heading():
    time = DT * np.arange(30)
    north = one_vehicle(-0.5 * time**2 - 0.1 * time**3, 20.0 * time + 0.2 * time**3, np.pi / 2)
    found = realism._motion(north)
    middle = time[1:-1]
    np.testing.assert_allclose(found["speed"].mean(), 20.0 + 0.2 * time[-1] ** 2)
    np.testing.assert_allclose(found["longitudinal acceleration"], 1.2 * middle, atol=1e-8)
    np.testing.assert_allclose(found["lateral acceleration"], 1.0 + 0.6 * middle, atol=1e-8)
    np.testing.assert_allclose(found["longitudinal jerk"], 1.2, atol=1e-8)
    np.testing.assert_allclose(found["lateral jerk"], 0.6, atol=1e-8)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_lane_change_lasts_as_long_as_the_vehicle_moves_sideways(side):
    step = np.zeros(40)
    step[10:25] = 0.24  # 15 steps of 0.2 s at 1.2 m/s, to the side
    offset = side * np.append(0.0, step.cumsum())
    offset[18:] -= side * 3.6  # from there on, the offset from the middle of the other lane
    clock = one_vehicle(25.0 * DT * np.arange(41), np.zeros(41), 0.0)
    ((duration, speed),) = realism._manoeuvres(clock, offset, np.array([18]))
    assert duration == pytest.approx(3.0)
    assert speed == pytest.approx(1.2)


def test_gaps_headways_and_rates_by_hand():
    vehicles = ((1, 30.0, 0, 25.0, None), (2, 60.0, 0, 25.0, None), (3, 200.0, 1, 25.0, 2.0))
    report = realism.describe([recording(vehicles=vehicles, seconds=10.0)])
    assert report["vehicles"] == {"count": 3.0, "share of trucks": 0.0}
    assert report["speed"]["p50"] == pytest.approx(25.0, abs=1e-6)
    followed = {"count": 51.0}  # the first vehicle, at every step of 10 s
    gap, headway = report["gap"], report["time headway"]
    assert {"count": gap["count"]} == {"count": headway["count"]} == followed
    assert gap["p5"] == pytest.approx(30.0 - 4.5, abs=1e-6)
    assert headway["p95"] == pytest.approx((30.0 - 4.5) / 25.0, abs=1e-6)
    assert report["lane changes"]["count"] == 1
    assert report["lane changes"]["per vehicle and hour"] == pytest.approx(3600 / (3 * 51 * DT))
