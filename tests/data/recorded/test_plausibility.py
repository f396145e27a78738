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
    noise = 0.02 * np.random.default_rng(1).standard_normal(still.shape)
    for speed in (0.0, 0.5):
        velocity = speed / 1.4 * walking().velocity
        stand = dataclasses.replace(walking(), position=still + noise, velocity=velocity)
        assert not doubts(stand), "agents that stand, with noise in positions and velocities"
    kept = np.flatnonzero(walking().agent < 0)
    nothing = {name: getattr(walking(), name)[kept] for name in ("agent", "frame", "position", "heading", "velocity")}
    assert not doubts(dataclasses.replace(walking(), **nothing)), "no agents"


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
    turned = dataclasses.replace(tracks, heading=tracks.heading + math.pi)
    for mistaken in (wrong, turned):
        for rows, doubted in ((38, False), (40, True)):
            few = {
                name: getattr(mistaken, name)[:rows] for name in ("agent", "frame", "position", "heading", "velocity")
            }
            assert bool(doubts(dataclasses.replace(mistaken, **few))) == doubted, "19 steps are too few, and 20 are not"


def with_turned_axes(position: np.ndarray) -> np.ndarray:
    """Positions whose axes are turned by 45 degrees."""
    return np.stack((position[:, 0] - position[:, 1], position[:, 0] + position[:, 1]), -1) / math.sqrt(2.0)


def standing(tracks: TrackTable) -> np.ndarray:
    """Positions that stay where each agent begins, with noise of 1.5 cm, so that few steps have a clear direction."""
    still = np.repeat(tracks.position[::STEPS], STEPS, 0)
    return still + 0.015 * np.random.default_rng(1).standard_normal(still.shape)


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda t: {"position": 3.28 * t.position}, "agents move 3.3 times as fast in their positions"),
        (lambda t: {"velocity": 3.6 * t.velocity}, "agents move 0.28 times as fast in their positions"),
        (lambda t: {"rate": 4.0}, "agents move 0.4 times as fast in their positions"),
        (lambda t: {"rate": 1.0}, "agents move 0.1 times as fast in their positions"),
        (lambda t: {"rate": 25.0}, "agents move 2.5 times as fast in their positions"),
        (lambda t: {"position": t.position[:, ::-1]}, "another direction than that of their velocities"),
        (lambda t: {"position": with_turned_axes(t.position)}, "their velocities, by 4[0-9] degrees in the median"),
        (lambda t: {"heading": t.heading + 0.8}, "their headings, by 4[0-9] degrees in the median"),
        (lambda t: {"position": standing(t)}, r"agents move -?[0-9.e-]+ times as fast in their positions"),
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


def driving(bend: float = 1.0, speed: float = 10.0) -> TrackTable:
    """Cars on a road along x, which bends a little."""
    tracks = walking()
    time = tracks.frame / RATE
    heading = bend * (0.02 + 0.01 * time)
    velocity = speed * np.stack((np.cos(heading), np.sin(heading)), -1)
    ahead = np.stack((np.sin(heading), -np.cos(heading)), -1) / (0.01 * bend) * speed
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


def test_headings_are_not_doubted_for_a_degree_or_for_an_offset_that_no_other_reading_explains() -> None:
    nearly_straight = driving(0.2)
    assert not doubts(dataclasses.replace(nearly_straight, heading=-nearly_straight.heading))
    assert not doubts(dataclasses.replace(driving(), heading=driving().heading + 0.06))


def test_fast_cars_in_noisy_positions_are_not_doubted() -> None:
    cars = driving(speed=40.0)
    noise = 0.3 * np.random.default_rng(1).standard_normal(cars.position.shape)
    assert not doubts(dataclasses.replace(cars, position=cars.position + noise))
    (doubt,) = doubts(dataclasses.replace(cars, position=3.28 * cars.position))
    assert doubt.startswith("agents move 3.3 times as fast"), "their steps are not named as jumps as well"


def test_agents_that_are_not_seen_for_a_while_are_not_doubted() -> None:
    """Slow ones over 40 s, and cars at one frame per second, which stand before and after 5 s in which they move 25 m."""
    frame = walking().frame + np.where(walking().frame < STEPS // 2, 0, 400)
    velocity = np.tile([0.4, 0.0], (len(frame), 1))
    slow = dataclasses.replace(walking(), frame=frame, position=velocity * frame[:, None] / RATE, velocity=velocity)
    assert not doubts(slow)
    late = walking().frame >= STEPS // 2
    position = np.where(late, 25.0, 0.0)[:, None] * (1.0, 0.0)
    frame = walking().frame + np.where(late, 4, 0)
    stop = dataclasses.replace(walking(), rate=1.0, frame=frame, position=position, velocity=0.0 * velocity)
    assert not any("steps of tracks end more than" in doubt for doubt in doubts(stop))


def test_mistakes_of_few_agents_of_a_kind_are_named() -> None:
    """One car among five pedestrians, whose speeds may lag behind a little, as those of DUT do."""
    tracks = walking()
    kind = np.where(np.arange(AGENTS) == 0, KINDS.index("car"), tracks.kind)
    mixed = dataclasses.replace(tracks, kind=kind)
    assert not doubts(mixed)
    for factor, doubted in ((1.6, False), (1.9, True), (3.6, True)):
        velocity = np.where(tracks.agent == 0, factor, 1.0)[:, None] * tracks.velocity
        found = doubts(dataclasses.replace(mixed, velocity=velocity))
        assert bool(found) == doubted
    (doubt,) = found
    (of_all,) = doubts(dataclasses.replace(mixed, velocity=3.6 * tracks.velocity))
    assert of_all.startswith("agents move 0.28 times"), "a mistake of all agents is named once"
    assert doubt.startswith("agents of the kind car move 0.28 times as fast in their positions as their velocities say")


@pytest.mark.parametrize("factor", [0.0, 0.05])
def test_velocities_near_zero_are_doubted_if_more_than_half_of_the_agents_that_move_have_them(factor: float) -> None:
    tracks = driving()
    for count, said in ((3, ""), (4, "4 of 6"), (6, "6 of 6")):
        velocity = np.where(tracks.agent < count, factor, 1.0)[:, None] * tracks.velocity
        found = doubts(dataclasses.replace(tracks, velocity=velocity))
        assert bool(found) == bool(said)
    (doubt,) = found
    assert doubt.startswith("6 of 6 agents that move 5 m or more have velocities near zero: are the velocities missing")


@pytest.mark.parametrize("kind", ["car", "van", "truck", "bus", "pedestrian"])
def test_vehicles_most_of_which_are_wider_than_long_are_doubted(kind: str) -> None:
    for count, doubted in ((0, False), (3, False), (4, True)):
        size = np.where(np.arange(AGENTS)[:, None] < count, [1.8, 4.5], [4.5, 1.8])
        found = doubts(dataclasses.replace(driving(), size=size, kind=np.full(AGENTS, KINDS.index(kind))))
        wanted = f"{count} of 6 vehicles are wider than long: are lengths and widths exchanged?"
        assert found == ([wanted] if doubted and kind != "pedestrian" else [])


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
