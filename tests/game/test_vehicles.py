"""Headway, clearances of vehicles and conflicts: by hand, against loops, and under rigid motion."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.game.features import PAIR_FEATURES
from epo_lightning.game.vehicles import CONFLICT_TIME, TIME_GAP

NAMES = ("headway", "longitudinal", "lateral", "time_to_conflict")
CAR, TRUCK = (4.5, 1.9), (12.0, 2.5)


def value(name, first, second, margin=0.0, sizes=(CAR, CAR)):
    """The feature of two agents, each x, y, heading, speed."""
    states = (torch.tensor([[agent]], dtype=torch.float64) for agent in (first, second))
    shapes = (torch.tensor([[size]], dtype=torch.float64) for size in sizes)
    return PAIR_FEATURES[name].function(*states, *shapes, torch.tensor([[margin]], dtype=torch.float64)).item()


def by_hand(name, first, second, margin, sizes):
    """The definitions of the module, in plain arithmetic and with angles instead of unit vectors."""
    (x, y, heading, speed), (other_x, other_y, other_heading, other_speed) = first, second
    length, width = ((sizes[0][e] + sizes[1][e]) / 2 for e in range(2))
    between = math.remainder(heading - other_heading, 2 * math.pi)
    if name == "time_to_conflict":
        vx = speed * math.cos(heading) - other_speed * math.cos(other_heading)
        vy = speed * math.sin(heading) - other_speed * math.sin(other_heading)
        time = -((x - other_x) * vx + (y - other_y) * vy) / (vx * vx + vy * vy + 0.01)
        time = min(max(time, 0.0), CONFLICT_TIME)
        apart = math.hypot(x - other_x + time * vx, y - other_y + time * vy)
        return (1 - time / CONFLICT_TIME) * max(0.0, width + margin - apart)
    if math.cos(between) < 0:
        if name == "headway":
            return 0.0
        between = math.remainder(between - math.pi, 2 * math.pi)
    axis = heading - between / 2
    along = (x - other_x) * math.cos(axis) + (y - other_y) * math.sin(axis)
    across = (y - other_y) * math.cos(axis) - (x - other_x) * math.sin(axis)
    room, limit, side = (length, across, width) if name != "lateral" else (width, along, length)
    used = abs(across) if name == "lateral" else abs(along)
    if name == "headway":
        share = min(max(0.5 - along / (2 * length), 0.0), 1.0)
        room += TIME_GAP * (share * speed + (1 - share) * other_speed)
    return math.cos(between) * max(0.0, 1 - (limit / side) ** 2) ** 2 * max(0.0, room + margin - used)


agents = st.tuples(st.floats(-15.0, 15.0), st.floats(-4.0, 4.0), st.floats(-7.0, 7.0), st.floats(-2.0, 30.0))


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=150)
@given(first=agents, second=agents, margin=st.floats(0.0, 2.0), sizes=st.sampled_from([(CAR, CAR), (CAR, TRUCK)]))
def test_values_are_those_of_plain_arithmetic(name, first, second, margin, sizes):
    if abs(math.cos(first[2] - second[2])) < 1e-6:
        return  # the common axis of perpendicular agents is a matter of rounding, and the feature is zero anyway
    expected = by_hand(name, first, second, margin, sizes)
    assert value(name, first, second, margin, sizes) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=60)
@given(first=agents, second=agents, turn=st.floats(-7.0, 7.0), margin=st.floats(0.0, 2.0))
def test_values_are_symmetric_and_invariant_to_rigid_motion(name, first, second, turn, margin):
    here = value(name, first, second, margin, (CAR, TRUCK))
    assert value(name, second, first, margin, (TRUCK, CAR)) == pytest.approx(here, rel=1e-9, abs=1e-9)
    if abs(math.cos(first[2] - second[2])) < 1e-6:
        return
    c, s = math.cos(turn), math.sin(turn)
    moved = [(3.0 + c * x - s * y, s * x + c * y, heading + turn, v) for x, y, heading, v in (first, second)]
    assert value(name, *moved, margin, (CAR, TRUCK)) == pytest.approx(here, rel=1e-7, abs=1e-7)


def test_the_rear_car_keeps_its_headway_to_the_car_ahead():
    front, fast, slow = (30.0, 0.0, 0.0, 20.0), (0.0, 0.0, 0.0, 30.0), (0.0, 0.0, 0.0, 20.0)
    gap = 30.0 - 4.5
    assert value("headway", fast, front) == pytest.approx(TIME_GAP * 30.0 - gap)
    assert value("headway", front, fast) == pytest.approx(TIME_GAP * 30.0 - gap), "whichever of the two is named first"
    assert value("headway", slow, front) == 0.0
    assert value("headway", slow, front, margin=7.0) == pytest.approx(TIME_GAP * 20.0 + 7.0 - gap)
    beside = (30.0, 3.5, 0.0, 20.0)
    assert value("headway", fast, beside) == 0.0, "another lane"
    oncoming = (30.0, 0.0, math.pi, 20.0)
    assert value("headway", fast, oncoming) == 0.0


def test_clearances_act_along_and_across():
    behind, beside = (-5.0, 0.0, 0.0, 20.0), (0.0, 2.2, 0.0, 20.0)
    here = (0.0, 0.0, 0.0, 20.0)
    assert value("longitudinal", here, behind, margin=2.0) == pytest.approx(4.5 + 2.0 - 5.0)
    assert value("lateral", here, behind, margin=2.0) == 0.0
    assert value("lateral", here, beside, margin=1.0) == pytest.approx(1.9 + 1.0 - 2.2)
    assert value("longitudinal", here, beside, margin=1.0) == 0.0
    oncoming = (5.0, 0.0, math.pi, 20.0)
    assert value("longitudinal", here, oncoming, margin=2.0) == pytest.approx(4.5 + 2.0 - 5.0)
    crossing = (3.0, 0.0, math.pi / 2, 20.0)
    assert value("longitudinal", here, crossing, margin=2.0) == pytest.approx(0.0, abs=1e-9)


def test_conflicts_are_seen_before_they_happen():
    here = (0.0, 0.0, 0.0, 10.0)
    oncoming = (20.0, 0.0, math.pi, 10.0)  # they meet in one second
    assert value("time_to_conflict", here, oncoming) == pytest.approx((1 - 1 / CONFLICT_TIME) * 1.9, rel=1e-3)
    assert value("time_to_conflict", here, (20.0, 3.5, math.pi, 10.0)) == 0.0, "they pass in their lanes"
    assert value("time_to_conflict", here, (70.0, 0.0, math.pi, 10.0)) == 0.0, "too far ahead in time"
    assert value("time_to_conflict", here, (20.0, 0.0, 0.0, 20.0)) == 0.0, "it drives away"
