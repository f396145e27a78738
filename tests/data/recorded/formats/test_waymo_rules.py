"""Waymo Open Motion: kinds and sizes of agents, times, neighbours, and the publisher's folders."""

from __future__ import annotations

import numpy as np
import pytest

from data.recorded.formats.waymo_files import (
    boundary,
    feature,
    lane,
    line,
    moving,
    neighbour,
    polyline,
    scenario,
    track,
    write,
)
from epo_lightning.data.recorded.formats.waymo import waymo
from epo_lightning.data.recorded.tracks import RecordingError
from epo_lightning.scene import KINDS


def read(home, **about):
    write(home, [scenario(**about)])
    (source,) = waymo(home)
    return source.read()


@pytest.mark.parametrize(
    ("kind", "size", "expected", "found"),
    [
        (1, (6.9, 2.2), "car", (6.9, 2.2)),
        (1, (7.0, 2.4), "truck", (7.0, 2.4)),
        (1, (18.0, 2.6), "truck", (18.0, 2.6)),
        (3, (7.5, 1.0), "bicycle", (7.5, 1.0)),
        (4, (9.0, 2.0), "other", (9.0, 2.0)),
        (1, (60.0, 2.5), "car", (4.5, 1.8)),
    ],
)
def test_long_vehicles_are_trucks_and_impossible_sizes_typical_ones(tmp_path, kind, size, expected, found):
    tracks = read(tmp_path, tracks=[track(1, kind, moving(0.0, 0.0, 0.0, 5.0, size))]).tracks
    assert KINDS[tracks.kind[0]] == expected
    np.testing.assert_array_equal(tracks.size, np.float32([found]) if found == size else [found])


@pytest.mark.parametrize(("late", "fits"), [(0.04, True), (-0.04, True), (0.06, False), (-0.06, False)])
def test_frames_may_be_late_by_half_of_their_time(tmp_path, late, fits):
    about = {"times": [0.1 * k + late * (k >= 5) for k in range(91)]}
    if fits:
        assert read(tmp_path, **about).tracks.frame.max() == 90
        return
    with pytest.raises(RecordingError, match=r"s between the frames 4 and 5; 0\.1 s were expected"):
        read(tmp_path, **about)


@pytest.mark.parametrize(
    ("kinds", "crossable"),
    [
        *(((kind,), kind not in (2, 3, 6, 7)) for kind in range(9)),
        ((2, 7), False),
        ((2, 8), True),
        ((), True),
    ],
)
def test_lines_decide_on_lane_changes(tmp_path, kinds, crossable):
    """Solid lines are 2, 3, 6 and 7; a passing line (8) is broken on one side, and where lines change, one may cross."""
    features = [
        feature(1, 3, lane(line(0.0, 0, 50), left=[neighbour(2, 0, 10, kinds)])),
        feature(2, 3, lane(line(3.6, 0, 50))),
    ]
    lanes = read(tmp_path, features=features).lanes
    assert lanes.adjacent_left.tolist() == [1, -1]
    assert lanes.left_of.tolist() == [1 if crossable else -1, -1]


def test_of_several_neighbours_the_one_along_most_of_the_lane_counts(tmp_path):
    features = [
        feature(1, 3, lane(line(0.0, 0, 50), left=[neighbour(2, 0, 3, [2]), neighbour(3, 3, 10, [1])])),
        feature(2, 3, lane(line(3.6, 0, 15))),
        feature(3, 3, lane(line(3.6, 15, 50))),
    ]
    lanes = read(tmp_path, features=features).lanes
    assert (lanes.adjacent_left[0], lanes.left_of[0]) == (2, 2)


def test_a_boundary_of_one_point_says_nothing_about_the_width(tmp_path):
    features = [
        feature(1, 3, lane(line(0.0, 0, 50), left_lines=[boundary(0, 10, 5, 0)])),
        feature(5, 4, polyline(2, [(25.0, 2.5)])),
    ]
    np.testing.assert_allclose(read(tmp_path, features=features).lanes.left[0][:, 1], 1.8)


def test_of_two_boundaries_the_nearer_one_counts(tmp_path):
    named = [boundary(0, 10, 5, 0), boundary(0, 4, 6, 0), boundary(0, 10, 7, 0)]
    ways = [feature(id, 4, polyline(2, [(0.0, y), (50.0, y)])) for id, y in ((5, 2.4), (6, 1.6), (7, 2.8))]
    left = read(tmp_path, features=[feature(1, 3, lane(line(0.0, 0, 50), left_lines=named)), *ways]).lanes.left[0]
    np.testing.assert_allclose(left, [(0.0, 1.6), (20.0, 1.6), (25.0, 2.4), (50.0, 2.4)])


def test_where_a_line_turns_back_its_sides_are_those_before_the_turn(tmp_path):
    lanes = read(tmp_path, features=[feature(1, 3, lane([(0.0, 0.0), (10.0, 0.0), (5.0, 0.0), (5.0, 9.0)]))]).lanes
    assert [10.0, 1.8] in lanes.left[0].round(6).tolist()
    assert [10.0, -1.8] in lanes.right[0].round(6).tolist()


def test_other_folders_of_the_publisher_belong_to_its_splits(tmp_path):
    for home in ("training_20s", "validation_interactive", "testing_interactive"):
        write(tmp_path / home, [scenario()], f"{home}.tfrecord")
    with pytest.warns(UserWarning, match="testing_interactive in .*: left out, its scenarios have no futures"):
        found = waymo(tmp_path)
    assert [source.group for source in found] == ["training", "validation"]


def test_the_innermost_folder_of_the_publisher_counts(tmp_path):
    write(tmp_path / "testing" / "validation" / "more", [scenario()])
    assert [source.group for source in waymo(tmp_path)] == ["validation"]


def test_two_folders_of_the_test_split_hold_the_same_drives(tmp_path):
    for home in ("testing", "testing_interactive"):
        write(tmp_path / home, [scenario()], f"{home}.tfrecord")
    with pytest.raises(RecordingError, match="testing and testing_interactive hold the same drives"):
        waymo(tmp_path)
