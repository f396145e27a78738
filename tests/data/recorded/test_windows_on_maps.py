"""What windows take from the map: reference speeds, lanes and their pieces, lane changes; and maps that do not fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from data.recorded.window_scenes import scenes_of
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.road_scenes import RoadScenes
from epo_lightning.data.recorded.routes import BEYOND, SPACING, reach
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.scene import KINDS

from .roads import FOUR, recording

ALL = WindowConfig(agents=3, least_agents=3, lane_change=False, speed_limit=28.0)
THREE = [(1, 30.0, 0, 20.0, None), (2, 20.0, 1, 20.0, None), (3, 10.0, 2, 20.0, None)]


@pytest.mark.parametrize("lines", [None, 6])
def test_the_reference_speed_is_the_limit_of_the_lane_and_that_of_the_settings_where_it_has_none(lines):
    of = recording(vehicles=THREE)
    limit = np.array([22.0, np.nan, 33.0])[np.arange(len(of.lanes)) % 3]
    of = dataclasses.replace(of, lanes=dataclasses.replace(of.lanes, speed_limit=limit))
    scene, data = scenes_of(of, dataclasses.replace(ALL, lines=lines))
    expected = {1: 22.0, 2: 28.0, 3: 33.0}
    for found, entry in zip(scene.reference_speed, data.provenance(range(len(data))), strict=True):
        assert found.tolist() == [expected[track] for track in entry["tracks"]]
    make = RoadScenes(of.lanes, ALL)
    states = np.stack([of.tracks.position[of.tracks.frame == 100, axis] for axis in (0, 1)], -1)
    now = np.concatenate([states, np.zeros((3, 1)), np.full((3, 1), 20.0)], 1)
    history = np.repeat(now[None, :, None], 10, 2)
    assert make(history, np.full((1, 3, 2), 2.0)).reference_speed.tolist() == [[22.0, 28.0, 33.0]]


def test_pieces_of_lanes_have_vectors_of_six_metres_at_most():
    scenes, _ = extract(recording(vehicles=THREE), ALL)
    length = np.linalg.norm(np.diff(scenes.polylines, axis=1), axis=-1)
    assert SPACING == 6.0
    assert 5.0 < length.max() <= 6.0


def test_vectors_of_lanes_lead_from_one_to_the_next_in_the_direction_of_driving():
    scene, _ = scenes_of(recording(vehicles=THREE), dataclasses.replace(ALL, lanes=64))
    assert 0 < scene.lane_mask.float().mean() < 1, "absent lanes are padded"
    start, end = scene.lanes[..., :2], scene.lanes[..., 2:]
    assert torch.equal(start[:, :, 1:], end[:, :, :-1])
    there = scene.lane_mask
    assert ((end - start)[there][:, 0] > 4.9).all(), "the road leads along x"
    assert (scene.lanes[~there] == 0).all()


def test_without_a_number_of_lanes_a_scene_has_those_on_which_its_agents_may_be_and_some_more():
    of = recording(vehicles=[(1, 20.0, 0, 8.0, None)], seconds=7.0)
    config = WindowConfig(agents=1, least_agents=1, lane_change=False, lanes=None)
    scenes, _ = extract(of, config)
    _, (far,) = reach(np.array([8.0]), 4.0)
    for row, agent in enumerate(scenes.agents[:, 0]):
        away = np.linalg.norm(scenes.polylines - scenes.history[agent, -1, :2], axis=-1).min(1)
        lanes = scenes.lanes[row]
        assert set(lanes[lanes >= 0].tolist()) == set(np.flatnonzero(away <= far + BEYOND).tolist())


@pytest.mark.parametrize(("dt", "horizon"), [(0.1, 20), (0.2, 20), (0.4, 10)])
def test_goals_of_scenes_of_ones_own_lie_within_the_time_of_the_settings(dt, horizon):
    make = RoadScenes(recording().lanes, WindowConfig(dt=dt, horizon=horizon))
    history = np.repeat([[[[100.0, 0.0, 0.0, 15.0]]]], 10, 2)
    goals = make(history, np.full((1, 1, 2), 2.0)).goal_candidates[0, 0, 20:40, 0]
    (near,), (far,) = reach(np.array([15.0]), dt * horizon)
    torch.testing.assert_close(goals[[0, -1]].double(), torch.tensor([near, far]), rtol=0, atol=1e-3)


def test_a_jump_aside_that_smoothing_removes_is_no_lane_change():
    """One frame is wrong by six metres: without later frames, the vehicle seems to be on the lane beside."""
    of = recording(vehicles=THREE)
    wrong = (of.tracks.agent == 0) & (of.tracks.frame == 125)
    position = of.tracks.position + np.where(wrong, 6.0, 0.0)[:, None] * (0.0, 1.0)
    of = dataclasses.replace(of, tracks=dataclasses.replace(of.tracks, position=position))
    smooth = dataclasses.replace(ALL, smoothing=1.0)
    scene, _ = scenes_of(of, smooth)
    assert scene.current[:, :, 1].max() + scene.frame[0, 1] > 2.0
    _, counts = extract(of, dataclasses.replace(smooth, lane_change=True))
    assert counts["scenes"] == 0
    assert counts["no lane change"] > 0


def beside(share: tuple[int, int], kind: str = "car", speed: float = 24.0):
    """A recording of vehicles, some of which are beside the road, in a lane that the map does not have."""
    on, off = share
    vehicles = [(k, 10.0 + 12.0 * k, 0, 24.0, None) for k in range(on)]
    vehicles += [(50 + k, 10.0 + 12.0 * k, 4, speed, None) for k in range(off)]
    of = recording(vehicles=vehicles)
    of.tracks.kind[on:] = KINDS.index(kind)
    return of


@pytest.mark.parametrize(
    ("of", "refused"),
    [
        (beside((2, 3)), "60%"),
        (beside((3, 3)), None),
        (beside((2, 8), kind="bicycle", speed=6.0), None),
        (beside((2, 8), kind="pedestrian", speed=3.0), None),
        (beside((2, 8), kind="truck", speed=3.0), "80%"),
        (beside((2, 8), speed=1.5), None),  # parked, as noise of the recording has it
    ],
)
def test_a_map_is_refused_if_most_moving_vehicles_are_beside_its_lanes(of, refused):
    config = WindowConfig(off_lane="agent", lane_change=False, agents=2, least_agents=1)
    if refused is None:
        assert extract(of, config)[0] is not None
        return
    with pytest.raises(RecordingError, match=f"{refused} of the positions of moving vehicles lie on no lane"):
        extract(of, config)


def test_vehicles_that_drive_backwards_count_as_moving():
    of = recording(vehicles=FOUR)
    turned = dataclasses.replace(of.tracks, heading=of.tracks.heading + np.pi)
    assert (turned.speed < 0).all()
    with pytest.raises(RecordingError, match="100% of the positions of moving vehicles lie on no lane"):
        extract(dataclasses.replace(of, tracks=turned), WindowConfig())


def test_kinds_and_sizes_are_those_of_the_agents_and_zero_for_none():
    of = recording(vehicles=THREE)
    of.tracks.kind[:] = [KINDS.index(kind) for kind in ("truck", "van", "bus")]
    of.tracks.size[:] = [[10.0, 2.5], [5.5, 2.0], [12.0, 2.6]]
    scene, data = scenes_of(of, dataclasses.replace(ALL, agents=4))
    for row, entry in enumerate(data.provenance(range(len(data)))):
        agents = [entry["tracks"].index(track) for track in (1, 2, 3)]
        assert scene.kind[row, agents].tolist() == of.tracks.kind.tolist()
        torch.testing.assert_close(
            scene.size[row, agents].double(), torch.from_numpy(of.tracks.size), rtol=0, atol=1e-6
        )
    assert not scene.agent_mask[:, 3].any()
    for name in (
        "kind",
        "size",
        "reference_speed",
        "history",
        "future",
        "history_mask",
        "goal_candidates",
        "references",
    ):
        assert (getattr(scene, name)[:, 3] == 0).all()
