"""Lanes around scenes, and agents that end far from them, compared with plain loops over chunks of few scenes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from data.recorded.test_parts import tables
from epo_lightning.data.recorded import surroundings
from epo_lightning.data.recorded.surroundings import far_from_lanes, nearest_pieces, reachable_pieces


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """So many scenes, agents or fractions of them at once that the last chunk is not full."""
    monkeypatch.setattr(surroundings, "CHUNK", 32)


@pytest.mark.parametrize("most", [1, 7, 12, 15])
def test_the_nearest_lanes_are_those_of_a_plain_loop_and_absent_ones_are_minus_one(most: int) -> None:
    random = np.random.default_rng(0)
    lines, centre = random.uniform(-200, 200, (12, 11, 2)), random.uniform(-200, 200, (70, 2))
    found = nearest_pieces(lines, centre, most)
    for row, (x, y) in zip(found, centre.tolist(), strict=True):
        away = [np.hypot(line[5, 0] - x, line[5, 1] - y) for line in lines]  # from the middle of each
        assert row.tolist() == (sorted(range(12), key=away.__getitem__) + [-1] * most)[:most]
    assert (nearest_pieces(lines[:0], centre, most) == -1).all()


def test_lanes_within_reach_equal_a_plain_loop() -> None:
    random = np.random.default_rng(0)
    lines = random.uniform(-200, 200, (40, 1, 2)) + random.uniform(-9, 9, (40, 11, 2))
    position, far = random.uniform(-200, 200, (13, 2)), random.uniform(10, 120, 13)
    members = random.integers(-1, 13, (90, 3))
    centre = random.uniform(-200, 200, (90, 2))
    found = reachable_pieces(lines, position, far, members, centre)
    for scene in range(90):
        expected = [
            line
            for line in sorted(range(40), key=lambda line: np.linalg.norm(lines[line, 5] - centre[scene]))
            if any(
                np.linalg.norm(point - position[agent]) <= far[agent]
                for agent in members[scene]
                if agent >= 0
                for point in lines[line]
            )
        ]
        assert found[scene].tolist() == expected + [-1] * (found.shape[1] - len(expected))
    assert (found[:, -1] >= 0).any(), "as many columns as the scene with the most lanes needs"


def test_moving_agents_that_end_more_than_ten_metres_from_all_lanes_equal_a_plain_loop() -> None:
    draw = np.random.default_rng(0)
    end, way = draw.uniform(-15, 15, (40, 2)), draw.uniform(-1, 1, (40, 2))
    way[-1] = 0.9  # the last agent moves: it must not count where a scene has no agent
    history, future = draw.normal(size=(40, 3, 4)), draw.normal(size=(40, 2, 4))
    future[:, -1, :2], history[:, -1, :2] = end, end - way
    scenes = dataclasses.replace(
        tables(draw, 3, False),
        history=history,
        future=future,
        future_mask=(draw.random((40, 2)) < 0.7) | (np.arange(40)[:, None] == 39),
        polylines=draw.uniform(-60, 60, (25, 1, 2)) + draw.uniform(-4, 4, (25, 5, 2)),
        agents=draw.integers(-1, 40, (49, 4)),
        lanes=draw.integers(-1, 25, (49, 3)),
    )
    far = moving = 0
    for members, lanes in zip(scenes.agents, scenes.lanes, strict=True):
        for agent in members[members >= 0]:
            if scenes.future_mask[agent, -1] and np.hypot(*way[agent]) > 1.0:
                moving += 1
                points = [point for lane in lanes[lanes >= 0] for point in scenes.polylines[lane]]
                far += all(np.hypot(*(point - end[agent])) > 10.0 for point in points)
    assert far_from_lanes(scenes) == (far, moving)
    assert 0 < far < moving
    without = dataclasses.replace(scenes, polylines=scenes.polylines[:0], lanes=np.full((49, 0), -1))
    assert far_from_lanes(without) == (0, 0), "there is no map"
