"""Doubts about tracks: every mistake of units, axes and frames that positions, velocities and headings show."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.plausibility import doubts
from epo_lightning.data.recorded.tracks import TrackTable
from epo_lightning.scene import KINDS

AGENTS, STEPS, RATE = 6, 40, 10.0


def walking(noise: float = 0.02) -> TrackTable:
    """Pedestrians on gentle curves, in noisy positions."""
    random = np.random.default_rng(0)
    time = np.arange(STEPS) / RATE
    start = random.uniform(-math.pi, math.pi, AGENTS)
    heading = start[:, None] + 0.3 * random.standard_normal((AGENTS, 1)) * time
    velocity = 1.4 * np.stack((np.cos(heading), np.sin(heading)), -1)
    position = np.cumsum(velocity, 1) / RATE + noise * random.standard_normal((AGENTS, STEPS, 2))
    return TrackTable(
        rate=RATE,
        agent=np.repeat(np.arange(AGENTS), STEPS),
        frame=np.tile(np.arange(STEPS), AGENTS),
        position=position.reshape(-1, 2),
        heading=heading.reshape(-1),
        velocity=velocity.reshape(-1, 2),
        ids=np.arange(AGENTS),
        size=np.full((AGENTS, 2), 0.5),
        kind=np.full(AGENTS, KINDS.index("pedestrian")),
    ).check("walking.csv")


def test_tracks_without_a_mistake_are_not_doubted() -> None:
    assert not doubts(walking())
    turns = dataclasses.replace(walking(), heading=walking().heading + 4 * math.pi)
    assert not doubts(turns)
    still = np.repeat(walking().position[::STEPS], STEPS, 0)
    stand = dataclasses.replace(walking(), position=still, velocity=0.0 * walking().velocity)
    assert not doubts(stand), "agents that stand"


def test_agents_that_accelerate_between_frames_are_not_doubted() -> None:
    """Two frames of each agent, a second apart: it moves with the mean of both velocities."""
    velocity = np.tile([[1.5, 0.0], [3.5, 0.0]], (25, 1))
    tracks = TrackTable(
        rate=1.0,
        agent=np.repeat(np.arange(25), 2),
        frame=np.tile([0, 1], 25),
        position=np.tile([[0.0, 0.0], [2.5, 0.0]], (25, 1)),
        heading=np.zeros(50),
        velocity=velocity,
        ids=np.arange(25),
        size=np.full((25, 2), 0.5),
        kind=np.full(25, KINDS.index("pedestrian")),
    ).check("accelerating.csv")
    assert not doubts(tracks)
    wrong = dataclasses.replace(tracks, velocity=0.7 * velocity)
    assert doubts(wrong)
    few = {name: getattr(wrong, name)[:38] for name in ("agent", "frame", "position", "heading", "velocity")}
    assert not doubts(dataclasses.replace(wrong, **few)), "19 steps are too few"


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda t: {"position": 3.28 * t.position}, "agents move 3.3 times as fast in their positions"),
        (lambda t: {"velocity": 3.6 * t.velocity}, "agents move 0.28 times as fast in their positions"),
        (lambda t: {"rate": 4.0}, "agents move 0.4 times as fast in their positions"),
        (lambda t: {"rate": 1.0}, "agents move 0.1 times as fast in their positions"),
        (lambda t: {"rate": 25.0}, "agents move 2.5 times as fast in their positions"),
        (lambda t: {"position": t.position[:, ::-1]}, "another direction than that of their velocities"),
        (lambda t: {"heading": np.degrees(t.heading)}, "another direction than that of their headings"),
        (lambda t: {"heading": math.pi / 2 - t.heading}, "another direction than that of their headings"),
        (lambda t: {"heading": t.heading + math.pi}, "headings, by 1.. degrees in the median"),
        (
            lambda t: {"frame": 2 * t.frame, "rate": 20.0},
            "frames of a track are 2 apart .* is the frame rate 10 Hz instead of 20",
        ),
    ],
)
def test_mistakes_are_named(mistake: Callable[[TrackTable], dict[str, np.ndarray]], said: str) -> None:
    tracks = walking()
    (doubt,) = doubts(dataclasses.replace(tracks, **mistake(tracks)))
    assert re.search(said, doubt)


@pytest.mark.parametrize(
    ("name", "given", "said"),
    [
        (
            "ids",
            np.array([f"p{number}" for number in range(AGENTS)], dtype=object),
            "ids is of type object; whole numbers",
        ),
        ("position", np.ones((AGENTS * STEPS, 2), dtype=int), "position is of type int64; floating-point numbers"),
        ("heading", np.array(["0.5"] * 7 + ["north"] * 99), "heading is text, such as 'north'; floating-point numbers"),
        ("heading", np.array(["0.5"] * 9), "heading is of type <U3; floating-point numbers"),
    ],
)
def test_numbers_of_another_type_are_refused(name: str, given: np.ndarray, said: str) -> None:
    with pytest.raises(RecordingError, match=said):
        dataclasses.replace(walking(), **{name: given}).check("walking.csv")


def test_tracks_that_are_not_sorted_by_agent_are_refused() -> None:
    tracks = walking()
    with pytest.raises(
        RecordingError, match=r"frame 0 of track 0 comes after frames of track 1: tracks are sorted by agent"
    ):
        dataclasses.replace(tracks, agent=(tracks.agent + 1) % 2).check("walking.csv")


def driving() -> TrackTable:
    """Cars on a road along x, which bends a little."""
    tracks = walking()
    time = tracks.frame / RATE
    heading = 0.02 + 0.01 * time
    velocity = 10.0 * np.stack((np.cos(heading), np.sin(heading)), -1)
    ahead = np.stack((np.sin(heading), -np.cos(heading)), -1) / 0.01 * 10.0
    return dataclasses.replace(
        tracks,
        position=ahead + 5.0 * tracks.agent[:, None],
        heading=heading,
        velocity=velocity,
        kind=np.full(AGENTS, KINDS.index("car")),
    )


@pytest.mark.parametrize(
    ("turn", "said"),
    [
        (np.deg2rad, "taken as radians where degrees were expected"),
        (np.negative, "better if they are taken as clockwise: by"),
    ],
)
def test_headings_in_a_wrong_unit_or_sense_are_doubted_also_on_a_straight_road(
    turn: Callable[[np.ndarray], np.ndarray], said: str
) -> None:
    assert not doubts(driving())
    (doubt,) = doubts(dataclasses.replace(driving(), heading=turn(driving().heading)))
    assert re.search(said, doubt)


def test_mistakes_of_few_agents_of_a_kind_are_named() -> None:
    """One car among five pedestrians."""
    tracks = walking()
    kind = np.where(np.arange(AGENTS) == 0, KINDS.index("car"), tracks.kind)
    mixed = dataclasses.replace(tracks, kind=kind)
    assert not doubts(mixed)
    factor = np.where(tracks.agent == 0, 3.6, 1.0)[:, None]
    (doubt,) = doubts(dataclasses.replace(mixed, velocity=factor * tracks.velocity))
    assert doubt.startswith("agents of the kind car move 0.28 times as fast in their positions as their velocities say")


def test_velocities_of_zero_are_doubted_if_agents_move() -> None:
    (doubt,) = doubts(dataclasses.replace(walking(), velocity=0.0 * walking().velocity))
    assert re.search(r"agents that move 5 m or more have velocities near zero: are the velocities missing", doubt)


def test_vehicles_that_are_wider_than_long_are_doubted() -> None:
    cars = dataclasses.replace(driving(), size=np.tile([4.5, 1.8], (AGENTS, 1)))
    assert not doubts(cars)
    (doubt,) = doubts(dataclasses.replace(cars, size=cars.size[:, ::-1]))
    assert doubt == "6 of 6 vehicles are wider than long: are lengths and widths exchanged?"


def test_a_jump_that_a_car_could_do_is_doubted() -> None:
    position = walking().position.copy()
    position[45:80] += 8.0
    (doubt,) = doubts(dataclasses.replace(walking(), position=position).check("walking.csv"))
    assert doubt.startswith(
        "1 steps of tracks end more than 3 m from where their velocities lead, the first one after frame 4"
    )


def test_a_track_that_jumps_is_refused_in_every_format() -> None:
    position = walking().position.copy()
    position[50:] += 100.0
    with pytest.raises(
        RecordingError, match=r"track 1 jumps from \[.*\] to \[.*\] m after its frame 9: agents stay below"
    ):
        dataclasses.replace(walking(), position=position).check("walking.csv")
    apart = np.where(np.arange(AGENTS * STEPS) >= 50, walking().frame + 100, walking().frame)
    apart[2 * STEPS :] = walking().frame[2 * STEPS :]
    dataclasses.replace(walking(), position=position, frame=apart).check("walking.csv")
