"""Maps and scenes of one's own: lanes from centrelines, and scenes of vehicles on them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from data.recorded.roads import WIDTH, curve, road
from epo_lightning import LaneGraph, RoadScenes
from epo_lightning.data.errors import RecordingError
from epo_lightning.frames import in_world

LINES = [np.stack([np.linspace(-100.0, 300.0, 41), np.full(41, y)], 1) for y in (0.0, WIDTH)]


@pytest.mark.parametrize("radius", [None, 300.0])
def test_lanes_from_centrelines_are_those_with_their_borders(radius: float | None) -> None:
    wanted = road(curve(radius), lanes=3, sections=2)
    made = LaneGraph.from_centrelines(
        wanted.centre, WIDTH, successors=wanted.successors, left_of=wanted.left_of.tolist(), speed_limit=30.0
    )
    for side in ("left", "right", "centre"):
        for line, other in zip(getattr(made, side), getattr(wanted, side), strict=True):
            np.testing.assert_allclose(line[1:-1], other[1:-1], atol=1e-6)
            np.testing.assert_allclose(line, other, atol=0.02)  # ends have the direction of their segment
    for name in ("left_of", "right_of", "adjacent_left", "adjacent_right"):
        assert getattr(made, name).tolist() == getattr(wanted, name).tolist()
    assert list(made.successors) == list(wanted.successors)
    assert (made.speed_limit == 30.0).all()


@pytest.mark.parametrize(
    ("centre", "words", "message"),
    [
        ([], {}, "the map has no lanes"),
        ([np.zeros((3, 2))], {}, r"the centreline of lane 0 has shape \[3, 2\], expected \[n, 2\] with length"),
        ([LINES[0], np.zeros(2)], {}, r"the centreline of lane 1 has shape \[2\]"),
        (LINES, {"left_of": [1]}, "left_of has 1 entries, expected one for each of 2 lanes"),
        (LINES, {"left_of": [2, -1]}, "left_of names lane 2, but the last lane is 1"),
        (LINES, {"left_of": [-2, -1]}, "a lane names a neighbouring lane that does not exist"),
        (LINES, {"successors": [(5,), ()]}, "a lane names a successor that does not exist"),
    ],
)
def test_maps_that_cannot_be_are_refused(centre: list, words: dict, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        LaneGraph.from_centrelines(centre, WIDTH, **words)


def vehicles(*now: tuple[float, float, float]) -> np.ndarray:
    """Histories [1, N, 10, 4] of vehicles at x, y with a speed, along x."""
    past = 0.2 * np.arange(-9, 1)
    return np.array([[[(x + speed * time, y, 0.0, speed) for time in past] for x, y, speed in now]])


def test_goals_and_lines_of_vehicles_lie_on_the_lanes_that_they_can_reach() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH, left_of=[1, -1]))
    scene = make(vehicles((0.0, 0.3, 20.0), (10.0, WIDTH, 25.0)), np.full((1, 2, 2), [4.5, 1.9]))
    assert scene.references is not None
    assert scene.goal_candidates is not None
    points = in_world(torch.cat((scene.references, torch.zeros_like(scene.references)), -1), scene.frame)[0, ..., 1]
    for agent, expected in ((0, (WIDTH, 0.0, -WIDTH / 2)), (1, (1.5 * WIDTH, WIDTH, 0.0))):
        for line, y in enumerate(expected):  # left, own, right; beside the road its border
            torch.testing.assert_close(points[agent, line], torch.full_like(points[agent, line], y), atol=1e-3, rtol=0)
    back = in_world(scene.history[:, :, -1], scene.frame)[0]
    torch.testing.assert_close(back[:, :2], torch.tensor([[0.0, 0.3], [10.0, WIDTH]]).double(), atol=1e-4, rtol=0)


def test_what_is_left_out_is_there_and_seen() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH))
    history, size = vehicles((0.0, 0.0, 20.0), (10.0, WIDTH, 25.0)), np.full((1, 2, 2), [4.5, 1.9])
    everything = np.ones((1, 2, 10), dtype=bool)
    given = make(history, size, everything, everything[..., 0], np.zeros((1, 2), dtype=int))
    assert torch.equal(make(history, size).history, given.history)
    assert torch.equal(make(history, size).agent_mask, given.agent_mask)


def test_vehicles_beside_the_road_and_wrong_shapes_are_named() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH))
    history, size = vehicles((0.0, 0.0, 20.0), (10.0, 40.0, 25.0)), np.full((1, 2, 2), [4.5, 1.9])
    with pytest.raises(ValueError, match=r"agent 1 of scene 0 is on no lane, at \(10.0, 40.0\) m: leave it out"):
        make(history, size)
    make(history, size, agent_mask=np.array([[True, False]]))
    with pytest.raises(ValueError, match=r"history has shape \[2, 10, 4\], expected \[B, N, H, 4\]"):
        make(history[0], size)
    with pytest.raises(ValueError, match=r"size has shape \[1, 1, 2\], expected \[1, 2, 2\]"):
        make(history, size[:, :1])
