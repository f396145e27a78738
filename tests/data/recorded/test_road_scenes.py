"""Maps and scenes of one's own: lanes from centrelines, and scenes of vehicles on them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from data.recorded.roads import WIDTH, curve, road
from epo_lightning import LaneGraph, RoadScenes
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.windows import WindowConfig
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
            np.testing.assert_allclose(line[1:-1], other[1:-1], atol=1e-4)
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
        (LINES, {"left_of": [-1, 0]}, "left_of of lane 1 is 0, which is not to its left"),
        (LINES, {"left_of": [0, -1]}, "left_of of lane 0 is 0, which is not to its left"),
        ([LINES[0], LINES[1][::-1]], {"left_of": [1, -1]}, "left_of of lane 0 is 1, which is not to its left"),
        ([*LINES, LINES[0]], {"left_of": [1, -1, 1]}, "lanes 0 and 2 have the same left neighbour"),
        (LINES, {"width": -3.5}, "width is -3.5, expected a positive number"),
        (LINES, {"width": np.inf}, "width is inf, expected a positive number"),
        (LINES, {"width": np.nan}, "width is nan, expected a positive number"),
        (LINES, {"speed_limit": 0.0}, "speed_limit is 0.0, expected a positive number"),
        (LINES, {"successors": [(5,), ()]}, "a lane names a successor that does not exist"),
    ],
)
def test_maps_that_cannot_be_are_refused(centre: list, words: dict, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        LaneGraph.from_centrelines(centre, **{"width": WIDTH, **words})


def test_lanes_keep_their_width_at_corners_and_repeated_points() -> None:
    corner = np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 0.0], [50.0, 50.0]])
    made = LaneGraph.from_centrelines([corner], 4.0)
    assert made.left[0].tolist() == [[0.0, 2.0], [48.0, 2.0], [48.0, 50.0]]
    assert made.right[0].tolist() == [[0.0, -2.0], [52.0, -2.0], [52.0, 50.0]]


def test_borders_stay_near_a_hairpin() -> None:
    for back in (0.0, 0.01, 5.0):
        made = LaneGraph.from_centrelines([np.array([[0.0, 0.0], [50.0, 0.0], [0.0, back]])], 4.0)
        for side in (made.left[0], made.right[0]):
            assert np.linalg.norm(side - made.centre[0], axis=1).max() < 4.0, "a sharp corner is cut"


def test_a_lane_may_begin_on_the_line_of_its_left_neighbour() -> None:
    lane = np.concatenate([LINES[1][:1], LINES[0][3:]])
    assert LaneGraph.from_centrelines([lane, LINES[1]], WIDTH, left_of=[1, -1]).right_of.tolist() == [-1, 0]


def vehicles(*now: tuple[float, float, float]) -> np.ndarray:
    """Histories [1, N, 10, 4] of vehicles at x, y with a speed, along x."""
    past = 0.2 * np.arange(-9, 1)
    return np.array([[[(x + speed * time, y, 0.0, speed) for time in past] for x, y, speed in now]])


def test_goals_and_lines_of_vehicles_lie_on_the_lanes_that_they_can_reach() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH, left_of=[1, -1]))
    scene = make(vehicles((0.0, 0.3, 20.0), (10.0, WIDTH, 25.0)), np.full((1, 2, 2), [4.5, 1.9]))
    assert scene.references is not None
    assert scene.goal_candidates is not None
    goals = scene.goal_candidates.unflatten(2, (3, 20))
    for points in (scene.references, goals):
        across = in_world(torch.cat((points, torch.zeros_like(points)), -1), scene.frame)[0, ..., 1]
        for agent, expected in ((0, (WIDTH, 0.0, -WIDTH / 2)), (1, (1.5 * WIDTH, WIDTH, 0.0))):
            for line, y in enumerate(expected):  # left, own, right; beside the road its border
                wanted = torch.full_like(across[agent, line], y)
                torch.testing.assert_close(across[agent, line], wanted, atol=1e-3, rtol=0)
    back = in_world(scene.history[:, :, -1], scene.frame)[0]
    torch.testing.assert_close(back[:, :2], torch.tensor([[0.0, 0.3], [10.0, WIDTH]]).double(), atol=1e-4, rtol=0)


def test_without_masks_all_vehicles_are_there_and_observed_and_cars() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH))
    history, size = vehicles((0.0, 0.0, 20.0), (10.0, WIDTH, 25.0)), np.full((1, 2, 2), [4.5, 1.9])
    everything = np.ones((1, 2, 10), dtype=bool)
    given = make(history, size, everything, everything[..., 0], np.zeros((1, 2), dtype=int))
    assert torch.equal(make(history, size).history, given.history)
    for name in ("history_mask", "agent_mask", "kind"):
        assert torch.equal(getattr(make(history, size), name), getattr(given, name)), name


def test_vehicles_beside_the_road_and_wrong_shapes_are_named() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH))
    history, size = vehicles((0.0, 0.0, 20.0), (10.0, 40.0, 25.0)), np.full((1, 2, 2), [4.5, 1.9])
    with pytest.raises(ValueError, match=r"agent 1 of scene 0 is on no lane, at \(10.0, 40.0\) m: leave it out"):
        make(history, size)
    assert make.on_lanes(history[0, :, -1]).tolist() == [True, False]
    make(history, size, agent_mask=np.array([[True, False]]))
    with pytest.raises(ValueError, match=r"history has shape \[2, 10, 4\], expected \[B, N, H, 4\]"):
        make(history[0], size)
    history[0, 1, :, 1] = WIDTH
    assert make.on_lanes(history[0, :, -1]).all()
    for name, shape in (("history_mask", (1, 2)), ("agent_mask", (2, 2)), ("kind", (1, 3))):
        with pytest.raises(ValueError, match=rf"{name} has shape .*, expected \[1, 2"):
            make(history, size, **{name: np.ones(shape, dtype=int)})
    with pytest.raises(ValueError, match=r"size has shape \[1, 1, 2\], expected \[1, 2, 2\]"):
        make(history, size[:, :1])
    for words in ({"agent_mask": [[False, True]]}, {"framed": 0}):
        with pytest.raises(ValueError, match="the first vehicle of every scene must be there"):
            make(history, size, **words)
    history[0, 1, 3] = np.nan
    with pytest.raises(
        ValueError, match="agent 1 of scene 0 was observed at step 3 of history, but is not finite there"
    ):
        make(history, size)
    with pytest.raises(ValueError, match=r"windows\.lines is 6"):
        RoadScenes(make.lanes, WindowConfig(lines=6))


def test_scenes_of_a_batch_are_those_of_their_own() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH, left_of=[1, -1]))
    kind, sizes = np.array([[0, 2]]), np.array([[[4.5, 1.9], [5.0, 2.0]], [[12.0, 2.5], [6.0, 2.1]]])
    alone = [
        make(vehicles((x, 0.3, 20.0), (x + 20.0, WIDTH, 25.0)), size[None], kind=kind)
        for x, size in zip((0.0, 130.0), sizes, strict=True)
    ]
    histories = np.concatenate([vehicles((x, 0.3, 20.0), (x + 20.0, WIDTH, 25.0)) for x in (0.0, 130.0)])
    both = make(histories, sizes, kind=kind.repeat(2, 0))
    for index, scene in enumerate(alone):
        for name in ("history", "size", "kind", "lanes", "goal_candidates", "references", "reference_speed", "frame"):
            torch.testing.assert_close(getattr(both, name)[[index]], getattr(scene, name), rtol=0, atol=1e-4)
    assert both.kind is not None
    assert both.kind.tolist() == [[0, 2], [0, 2]]


def test_the_first_vehicles_that_are_there_decide_on_the_frame() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH))
    history, size = vehicles((0.0, 0.0, 20.0), (30.0, WIDTH, 20.0), (100.0, 0.0, 20.0)), np.full((1, 3, 2), [4.5, 1.9])
    for framed, there, centre in (
        (None, [True, True, True], (130.0 / 3, WIDTH / 3)),
        (2, [True, True, True], (15.0, WIDTH / 2)),
        (2, [True, False, True], (0.0, 0.0)),
        (None, [True, False, True], (50.0, 0.0)),
    ):
        scene = make(history, size, agent_mask=np.array([there]), framed=framed)
        torch.testing.assert_close(scene.frame, torch.tensor([[*centre, 0.0]]).double(), atol=1e-5, rtol=0)
        assert scene.agent_mask.tolist() == [there]
        assert scene.future is scene.future_mask is scene.id is None


@pytest.mark.parametrize("heading", [0.0, np.pi])
def test_vehicles_that_drive_against_each_other_are_aligned_with_the_first_one(heading: float) -> None:
    make = RoadScenes(LaneGraph.from_centrelines([LINES[0], LINES[1][::-1]], WIDTH))
    states = [[20.0, 0.0, 0.0, 10.0], [20.0, WIDTH, np.pi, 10.0]]
    history = np.array(states if heading == 0 else states[::-1])[None, :, None].repeat(10, 2)
    assert make(history, np.full((1, 2, 2), [4.5, 1.9])).frame[0, 2].item() == pytest.approx(heading)


def test_numbers_that_were_not_observed_are_not_read() -> None:
    make = RoadScenes(LaneGraph.from_centrelines(LINES, WIDTH))
    history, size = vehicles((0.0, 0.0, 20.0), (10.0, WIDTH, 25.0), (20.0, 0.0, 20.0)), np.full((1, 3, 2), [4.5, 1.9])
    observed, there = np.ones((1, 3, 10), dtype=bool), np.array([[True, True, False]])
    observed[0, 1, :4] = False
    history[0, 1, :4], history[0, 2] = np.nan, np.nan
    scene = make(history, size, observed, there)
    assert scene.history_mask.tolist() == (observed & there[..., None]).tolist()
    assert scene.history.isfinite().all()
    history[0, 0, 2, 3] = np.nan
    with pytest.raises(ValueError, match="agent 0 of scene 0 was observed at step 2 of history, but is not finite"):
        make(history, size, observed, there)


def test_a_closed_loop_goes_on_with_vehicles_on_no_lane_and_a_scene_has_all_lanes_where_none_are_left_out() -> None:
    long = [np.stack([np.linspace(-100.0, 2900.0, 41), np.full(41, y)], 1) for y in (0.0, WIDTH)]
    make = RoadScenes(LaneGraph.from_centrelines(long, WIDTH), WindowConfig(lanes=None))
    history = vehicles((0.0, 0.0, 20.0), (10.0, 40.0, 25.0))
    scene = make(history, np.full((1, 2, 2), [4.5, 1.9]), on_lanes_only=False)
    assert scene.finite.all()
    back = in_world(scene.history[:, :, -1], scene.frame)[0, :, :2]
    torch.testing.assert_close(back, torch.tensor([[0.0, 0.0], [10.0, 40.0]]).double(), atol=1e-4, rtol=0)
    assert scene.lanes.shape[1] == 2 * 50, "3000 m in pieces of 60 m"
    assert scene.lane_mask.all()
