"""Measures of episodes made by hand, and intervals with known values."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import pytest
import torch

from epo_lightning.drive.episodes import Episodes
from epo_lightning.drive.measures import SOON, differences, estimate, measure, touching
from epo_lightning.drive.world import Outcome, World

DT, STEPS = 0.1, 40


def meeting(gap: float, speed: float = 1.0) -> Episodes:
    """A robot that drives along x at 1 m/s, and an agent that stands beside its way at a distance of ``gap``."""
    times = DT * torch.arange(STEPS + 1, dtype=torch.double)
    states = torch.zeros(1, 2, STEPS + 1, 4, dtype=torch.double)
    states[0, 0, :, 0], states[0, 0, :, 3] = speed * times, speed
    states[0, 1, :, 0], states[0, 1, :, 1] = 2.0, gap
    outcome = Outcome(
        states=states,
        agent_mask=torch.ones(1, 2, STEPS + 1, dtype=torch.bool),
        size=torch.full((1, 2, 2), 0.5, dtype=torch.double),
        progress=states[:, 0, :, 0],
        measures={"height": torch.ones(1, dtype=torch.double)},
    )
    return Episodes(
        dt=DT,
        outcome=outcome,
        controls=torch.zeros(1, STEPS, 2, dtype=torch.double),
        found=torch.ones(1, STEPS, dtype=torch.bool),
    )


def values(episodes: Episodes, shape: str = "disc", arrived: float = 10.0) -> dict[str, float]:
    world = cast(World, SimpleNamespace(shape=shape, arrived=arrived, patience=2.0))
    return {name: float(value[0]) for name, value in measure(episodes, world).items()}


def test_contact_and_distance() -> None:
    assert values(meeting(0.4))["collision"] == 1.0
    assert values(meeting(0.6))["collision"] == 0.0
    assert values(meeting(0.6))["distance"] == pytest.approx(0.6)
    apart = meeting(0.4)
    apart.outcome.agent_mask[:, 1] = False
    assert values(apart)["collision"] == 0.0
    assert values(apart)["time_to_collision"] == SOON
    turned = meeting(0.55)
    turned.outcome.states[:, 1, :, 2] = torch.pi / 4  # the corner of a box reaches further than its side
    assert [values(turned, shape)["collision"] for shape in ("disc", "box")] == [0.0, 1.0]
    assert [values(turned, shape)["time_to_collision"] for shape in ("disc", "box")] == [SOON, 0.0]
    gone = meeting(0.6)
    gone.outcome.agent_mask[:, 0, 15:] = False  # the robot is at most at 1.4 m, and the agent stands at 2 m
    assert values(gone)["distance"] == pytest.approx((0.6**2 + 0.6**2) ** 0.5)


def test_the_steps_of_a_contact() -> None:
    # The robot is at 2 m after 20 steps, and discs of 0.25 m touch where it is less than 0.22 m away from there.
    happened = meeting(0.45).outcome
    assert touching(happened, "disc")[0].nonzero()[:, 0].tolist() == [18, 19, 20, 21, 22]
    happened.agent_mask[:, 1, 20:] = False
    assert touching(happened, "disc")[0].nonzero()[:, 0].tolist() == [18, 19]


def test_time_to_collision_is_the_smallest_over_the_way() -> None:
    begun = meeting(0.0)
    happened = begun.outcome
    happened = dataclasses.replace(
        happened,
        states=happened.states[:, :, :6],
        agent_mask=happened.agent_mask[:, :, :6],
        progress=happened.progress[:, :6],
    )
    early = dataclasses.replace(begun, outcome=happened, controls=begun.controls[:, :5], found=begun.found[:, :5])
    # After 0.5 s the robot is 1.5 m away, and discs of 0.25 m touch after 1 s.
    assert values(early)["time_to_collision"] == pytest.approx(1.1, abs=0.11)
    assert values(meeting(0.6))["time_to_collision"] == SOON
    assert values(begun)["time_to_collision"] == 0.0, "they overlap later"
    begun.outcome.states[:, 0] = torch.tensor([1.6, 0.0, torch.pi, 10.0])
    assert values(begun)["time_to_collision"] == 0.0, "they overlap, and would be apart after 0.1 s"


def test_comfort_progress_and_deadlocks() -> None:
    episodes = meeting(1.0)
    episodes.controls[0, ::2, 0] = 0.1
    episodes.controls[0, :, 1] = -0.2
    found = values(episodes)
    assert found["jerk"] == pytest.approx(0.1 / DT)
    assert found["lateral"] == pytest.approx(0.2)
    assert found["progress"] == pytest.approx(4.0)
    assert found["deadlock"] == 0.0
    assert found["height"] == 1.0, "a measure of the world"
    assert values(meeting(1.0, speed=0.0))["deadlock"] == 1.0
    assert values(meeting(1.0, speed=-0.5))["deadlock"] == 0.0, "it drives backwards"
    standing = meeting(1.0, speed=0.0)
    assert values(standing, arrived=0.0)["deadlock"] == 0.0, "it has arrived"
    standing.outcome.states[:, 0, ::15, 3] = 1.0
    assert values(standing)["deadlock"] == 0.0, "it never stands for two seconds"
    for steps, expected in ((20, 0.0), (21, 1.0)):  # states of 1.9 s, and of 2 s
        standing.outcome.states[:, 0, :, 3] = 1.0
        standing.outcome.states[:, 0, :steps, 3] = 0.0
        assert values(standing)["deadlock"] == expected
    over = meeting(1.0, speed=0.0)
    over.outcome.agent_mask[:, :, 15:] = False
    assert values(over)["deadlock"] == 0.0, "its last state is kept after the end, which is no time that it stands"


def test_one_step_without_a_plan_counts() -> None:
    episodes = meeting(1.0)
    assert values(episodes)["fallback"] == 0.0
    episodes.found[0, 3] = False
    assert values(episodes)["fallback"] == 1.0


def test_intervals() -> None:
    rate = estimate(torch.tensor([1.0] * 10 + [0.0] * 90, dtype=torch.double), rate=True)
    assert (rate.mean, rate.low, rate.high) == pytest.approx((0.1, 0.0552, 0.1744), abs=1e-3)  # Wilson (1927)
    draws = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.double)
    mean = estimate(draws)
    assert mean.high - mean.low == pytest.approx(2 * 1.96 * float(draws.std()) / 20, rel=0.1)
    assert estimate(draws) == mean, "intervals are the same in every run"
    still = estimate(torch.zeros(20, dtype=torch.double))
    assert (still.mean, still.low, still.high) == (0.0, 0.0, 0.0), "lengths that are all 0 are no rate"


def test_differences_are_those_of_the_same_episodes() -> None:
    base = 10 * torch.randn(200, generator=torch.Generator().manual_seed(0), dtype=torch.double)
    found = differences({"progress": base + 1.0}, {"progress": base})["progress"]
    assert (found.mean, found.low, found.high) == pytest.approx((1.0, 1.0, 1.0))


def test_infinite_distances_have_intervals_and_differences() -> None:
    """In an episode without other agents, the distance is infinite."""
    values = torch.tensor([torch.inf, *[1.0, 2.0] * 10], dtype=torch.double)
    found = estimate(values)
    assert found.mean == found.high == torch.inf
    assert 1.0 < found.low < 2.0
    assert estimate(torch.full((3,), torch.inf, dtype=torch.double)).low == torch.inf
    (difference,) = differences({"distance": values}, {"distance": values - 0.5}).values()
    assert difference.mean == pytest.approx(0.5 * 20 / 21)
    assert difference.low <= difference.mean <= difference.high
