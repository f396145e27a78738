"""Waymo Open Motion: shards that an independent encoder wrote, splits by folder, and bad files."""

from __future__ import annotations

import numpy as np
import pytest

from data.recorded.formats import waymo_files
from data.recorded.formats.waymo_files import (
    AGENTS,
    boundary,
    double,
    feature,
    inside,
    lane,
    line,
    moving,
    neighbour,
    polyline,
    roads,
    scenario,
    single,
    state,
    track,
    whole,
    write,
)
from epo_lightning.data.recorded.formats.waymo import scenario as message_of
from epo_lightning.data.recorded.formats.waymo import waymo
from epo_lightning.data.recorded.lanes import LANE, SHOULDER
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tracks import RecordingError
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS

STANDARD = WindowConfig(dt=0.1, history=11, horizon=80, least_agents=2, lane_change=False)


def read(home, *scenarios):
    write(home, scenarios or [scenario()])
    return waymo(home)[0].read()


def one(home, content):
    """The recording of a shard that holds one scenario, and no more."""
    write(home, [content])
    (source,) = waymo(home)
    return source.read()


def test_waymo_is_a_registered_format():
    assert lookup("format", "waymo") is waymo


def test_tracks_hold_the_valid_states(tmp_path):
    unseen = {7: (0, 1, 40), 8: (), 9: range(5, 91), 12: (), 13: range(91)}
    tracks = [track(id, kind, moving(*about, unseen=unseen[id])) for id, kind, *about in AGENTS]
    recording = read(tmp_path, scenario(tracks=tracks))
    found = recording.tracks
    assert found.rate == 10.0
    assert found.ids.tolist() == [7, 8, 9, 12]
    assert [KINDS[kind] for kind in found.kind] == ["car", "truck", "pedestrian", "bicycle"]
    np.testing.assert_array_equal(found.size, np.float32([[4.5, 1.9], [12.0, 2.6], [0.6, 0.7], [1.8, 0.8]]))
    for number, (id, _, x, y, heading, speed, _) in enumerate(AGENTS[:4]):
        mine = found.agent == number
        frames = [k for k in range(91) if k not in unseen[id]]
        assert found.frame[mine].tolist() == frames
        steps = 0.1 * np.array(frames) * speed
        np.testing.assert_allclose(
            found.position[mine], np.column_stack([x + steps, y + 0 * steps]), rtol=0, atol=1e-12
        )
        np.testing.assert_array_equal(found.heading[mine], np.float32(heading))
        np.testing.assert_array_equal(found.velocity[mine], np.float32([[speed, 0.0]] * len(frames)))
    assert recording.dropped["tracks without a valid state"] == 1


def test_the_size_of_an_agent_is_that_of_its_first_valid_state(tmp_path):
    sizes = [(4.0 + 0.01 * k, 1.5 + 0.01 * k) for k in range(91)]
    seen = [state(float(k), 0.0, 0.0, 10.0, size, valid=k >= 3) for k, size in enumerate(sizes)]
    found = one(tmp_path, scenario(tracks=[track(1, 1, seen)])).tracks
    np.testing.assert_array_equal(found.size, np.float32([sizes[3]]))


def test_lanes_have_successors_neighbours_and_boundaries(tmp_path):
    recording = read(tmp_path)
    lanes = recording.lanes
    assert lanes.ids.tolist() == [10, 11, 12, 13, 14, 30]
    ids = dict(enumerate(lanes.ids.tolist())) | {-1: None}
    assert [[ids[other] for other in following] for following in lanes.successors] == [[12], [13, 14], [], [], [], []]
    assert [ids[to] for to in lanes.adjacent_left] == [11, None, 13, None, None, 10]
    assert [ids[to] for to in lanes.adjacent_right] == [30, 10, None, 12, None, None]
    # Solid lines are not crossed; lines that are broken somewhere, or not described, are.
    assert [ids[to] for to in lanes.left_of] == [11, None, 13, None, None, None]
    assert [ids[to] for to in lanes.right_of] == [None, 10, None, None, None, None]
    assert lanes.kind.tolist() == [LANE] * 5 + [SHOULDER]
    np.testing.assert_allclose(lanes.speed_limit, [11.176, 11.176, np.nan, 11.176, 11.176, 11.176])
    assert recording.dropped == {"lanes without length": 1, "lane references to lanes that do not exist": 1}
    at = {id: lane for lane, id in ids.items()}
    np.testing.assert_array_equal(lanes.centre[at[10]], [(0.0, 1.75), (100.0, 1.75)])
    np.testing.assert_array_equal(lanes.centre[at[14]], [(100.0, 5.25), (110.0, 7.0), (115.0, 12.0), (117.0, 30.0)])
    for id, left, right in (
        (10, 3.5, 0.0),  # a line on the left, an edge on the right
        (12, 3.5, -0.05),  # half way to the neighbour on the left, no information on the right
        (13, 7.05, 3.5),
        (30, 0.475, -1.55),  # half way to lane 10, and the width of a bicycle lane
    ):
        np.testing.assert_allclose(lanes.left[at[id]][:, 1], left, atol=1e-9)
        np.testing.assert_allclose(lanes.right[at[id]][:, 1], right, atol=1e-9)
    # The right line of lane 11 is named for its first ten points; beyond, the neighbour says how wide it is.
    np.testing.assert_allclose(lanes.right[at[11]][:, 1], 3.5, atol=1e-9)
    np.testing.assert_allclose(lanes.left[at[11]][:, 1], 7.2, atol=1e-6)
    # On the turn, boundaries are as far from the centreline at its ends as the usual lane is wide.
    ends = [np.linalg.norm(getattr(lanes, side)[at[14]][0] - lanes.centre[at[14]][0]) for side in ("left", "right")]
    np.testing.assert_allclose(ends, 1.8)


def test_repeated_points_and_sharp_turns_keep_boundaries_beside_the_line(tmp_path):
    points = [(0.0, 0.0), (5.0, 0.0), (5.0, 0.0), (10.0, 0.0), (5.0, 0.0), (5.0, 9.0)]
    recording = one(tmp_path, scenario(features=[feature(1, 3, lane(points))]))
    lanes = recording.lanes
    np.testing.assert_array_equal(lanes.centre[0], [points[k] for k in (0, 3, 4, 5)])
    for side in (lanes.left[0], lanes.right[0]):
        assert all(min(np.linalg.norm(np.subtract(point, points), axis=1)) == pytest.approx(1.8) for point in side)
    assert (lanes.left[0][:2, 1] > 0).all()


def test_simplified_lines_stay_near_those_of_the_map(tmp_path):
    angle = np.linspace(0, np.pi / 2, 60)
    points = np.stack([20 * np.sin(angle), 20 - 20 * np.cos(angle)], 1)
    lanes = one(tmp_path, scenario(features=[feature(1, 3, lane(points.tolist()))])).lanes
    assert len(lanes.centre[0]) < 30
    for found, radius in ((lanes.centre[0], 20.0), (lanes.left[0], 18.2), (lanes.right[0], 21.8)):
        along = np.concatenate([found[:-1] + share * np.diff(found, axis=0) for share in np.linspace(0, 1, 9)])
        np.testing.assert_allclose(np.linalg.norm(along - [0.0, 20.0], axis=1), radius, atol=0.03)
    np.testing.assert_array_equal(lanes.centre[0][[0, -1]], points[[0, -1]])


def test_boundaries_that_are_far_away_are_not_believed(tmp_path):
    features = [
        feature(1, 3, lane(line(0.0, 0, 50), left_lines=[boundary(0, 10, 5, 0)], right_lines=[boundary(2, 4, 6, 0)])),
        feature(5, 5, polyline(2, [(0.0, 40.0), (50.0, 40.0)])),
        feature(6, 5, polyline(2, [(0.0, 0.0), (50.0, 0.0)])),
    ]
    lanes = one(tmp_path, scenario(features=features)).lanes
    np.testing.assert_allclose(lanes.left[0][:, 1], 3.0)
    np.testing.assert_allclose(lanes.right[0], [(0, -1.8), (5, -1.8), (10, -0.5), (20, -0.5), (25, -1.8), (50, -1.8)])


def test_a_scenario_is_one_recording_and_a_shard_is_read_in_places(tmp_path):
    path = write(tmp_path, [scenario(name=name) for name in ("a", "b", "c")])
    sources = waymo(tmp_path)
    assert [source.name for source in sources] == [f"{path.name}-{number:04d}" for number in range(3)]
    assert {source.group for source in sources} == {path.name}
    assert all(source.files == (path,) for source in sources)
    names = [message_of(*source.read.args[2:]).scenario_id for source in sources]
    assert names == [b"a", b"b", b"c"]
    # Damage in one scenario leaves the others as they are.
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    first, second, third = waymo(tmp_path)
    assert len(first.read().tracks) == len(third.read().tracks) == 5 * 91
    with pytest.raises(RecordingError, match="wrong checksum"):
        second.read()
    # A shard that is cut off is listed up to the cut.
    path.write_bytes(content[: len(content) - 100])
    *_, last = waymo(tmp_path)
    assert last.name == f"{path.name}-0002"
    with pytest.raises(RecordingError, match="it ends within record 2"):
        last.read()


def test_the_publishers_windows_are_one_moment_of_each_scenario(tmp_path):
    driving = [track(id, kind, moving(*about)) for id, kind, *about in AGENTS if kind != 2]
    scenes, counts = extract(read(tmp_path, scenario(tracks=driving)), STANDARD)
    assert set(scenes.frame.tolist()) == {10}
    assert counts["windows"] == 4
    assert scenes.history.shape[1:] == (11, 4)
    assert scenes.future_mask.all()
    (row,) = np.flatnonzero(scenes.track == 8)
    assert scenes.size[row].tolist() == np.float32([12.0, 2.6]).tolist()
    # Reference lines of the car in lane 10: its own lane and the left one; goals follow the road.
    (row,) = np.flatnonzero(scenes.track == 7)
    own = scenes.references[row, 1] + scenes.origin[0]
    np.testing.assert_allclose(own[:, 1], 1.75, atol=1e-4)
    np.testing.assert_allclose((scenes.references[row, 0] + scenes.origin[0])[:, 1], 5.25, atol=1e-4)


def test_the_publishers_splits_are_groups(tmp_path):
    for home in ("training", "validation", "testing"):
        write(tmp_path / home, [scenario(), scenario()], f"{home}.tfrecord-00000-of-00001")
    with pytest.warns(UserWarning, match="testing in .*: left out, its scenarios have no futures"):
        found = waymo(tmp_path)
    assert [source.group for source in found] == ["training"] * 2 + ["validation"] * 2
    splits = RecordedData("waymo", "waymo", str(tmp_path), {"lane_change": False}, test=["validation"]).splits(found)
    assert {source.group for source in splits["test"]} == {"validation"}
    write(tmp_path / "validation_interactive", [scenario()], "interactive.tfrecord-00000-of-00001")
    with (
        pytest.warns(UserWarning, match="no futures"),
        pytest.raises(RecordingError, match="validation and validation_interactive hold the same drives"),
    ):
        waymo(tmp_path)
    assert len(waymo(tmp_path / "testing")) == 2
    scenes, _ = extract(one(tmp_path / "t", scenario(frames=11)), STANDARD)
    assert scenes is None


def test_folders_without_shards_and_shards_of_one_name_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="there is no shard in it"):
        waymo(tmp_path)
    write(tmp_path / "a", [scenario()])
    write(tmp_path / "b", [scenario()])
    with pytest.raises(RecordingError, match="has the same name: rename or remove"):
        waymo(tmp_path)


def test_an_empty_shard_and_a_link_to_nowhere_are_refused(tmp_path):
    write(tmp_path, [scenario()], "a.tfrecord")
    (tmp_path / "b.tfrecord").write_bytes(b"")
    whole, empty = waymo(tmp_path)
    assert len(whole.read().tracks)
    with pytest.raises(RecordingError, match=r"b.tfrecord: it is empty: fetch the file again"):
        empty.read()
    (tmp_path / "c.tfrecord").symlink_to(tmp_path / "none")
    with pytest.raises(RecordingError, match=r"c.tfrecord: the file cannot be read: No such file"):
        waymo(tmp_path)


def states(*changed, count=91):
    """States of a standing car, some of which are replaced."""
    found = [state(float(k), 0.0, 0.0, 10.0) for k in range(count)]
    for index, content in changed:
        found[index] = content
    return [track(3, 1, found)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff" * 20, "is no Scenario"),
        (scenario()[:-3], "is no Scenario"),
        (b"", "has no timestamps or no tracks"),
        (inside(5, b"abc"), "has no timestamps or no tracks"),
        (scenario(tracks=states(count=90)), "track 3 has 90 states, but there are 91 frames"),
        (scenario(tracks=states() * 2), "there are two tracks with the id 3"),
        (scenario(times=[0.2 * k for k in range(91)]), "0.2 s between the frames 0 and 1; 0.1 s were expected"),
        (scenario(times=[float("nan")] * 91), "nan s between the frames 0 and 1"),
        (scenario(tracks=states((4, state(np.nan, 0.0, 0.0, 10.0)))), r"track 3 has the numbers \[nan, .* in frame 4"),
        (scenario(tracks=states((4, state(4.0, 0.0, 0.0, 1e5)))), r"velocity \[100000.0"),
        (
            scenario(tracks=[track(3, 1, [state(float(k), 0.0, 2.0, 0.0) + single(9, 10.0) for k in range(91)])]),
            "headings differ by 115 degrees",
        ),
        (scenario(features=[feature(1, 3, lane(line(0, 0, 50)))] * 2), "there are two lanes with the id 1"),
        (scenario(features=[feature(1, 3, lane([(0.0, 0.0), (np.inf, 1.0)]))]), "lane 1 has coordinates that are not"),
        (scenario(features=[feature(1, 4, polyline(2, [(0.0, 0.0), (1e9, 1.0)]))]), "road_line 1 has coordinates"),
        (
            scenario(features=[feature(1, 3, lane(line(0, 0, 50), left=[neighbour(1, 0, 5)]))]),
            "lane 1 lies beside itself",
        ),
    ],
)
def test_invalid_scenarios_are_refused(tmp_path, content, message):
    with pytest.raises(RecordingError, match=rf"tfrecord-00000-of-00001.*{message}"):
        one(tmp_path, content)


def test_what_is_left_out_is_counted(tmp_path):
    tracks = [
        track(1, 9, moving(0.0, 2.0, 0.0, 5.0, (4.0, 2.0))),
        track(2, 1, moving(0.0, 5.0, 0.0, 5.0, (4.5, 0.0))),
        track(3, 2, [state(float(2 * k + 90 * (k > 50)), 9.0, 0.0, 20.0, (0.5, 0.5)) for k in range(91)]),
    ]
    features = [feature(1, 3, lane(line(0, 0, 50), mph=2000.0, entries=[77], left=[neighbour(78, 0, 5)]))]
    recording = one(tmp_path, scenario(tracks=tracks, features=features))
    assert recording.tracks.ids.tolist() == [1, 2]
    assert KINDS[recording.tracks.kind[0]] == "other"
    assert recording.tracks.size[1].tolist() == [4.5, 1.8]
    assert np.isnan(recording.lanes.speed_limit).all()
    assert recording.dropped == {
        "agents of a class that is unknown, taken as 'other'": 1,
        "agents whose size cannot be right, taken as one typical for their type": 1,
        "tracks that jump, faster than 120 m/s": 1,
        "speed limits that cannot be right": 1,
        "lane references to lanes that do not exist": 2,
    }


def test_a_scenario_without_lanes_has_no_map(tmp_path):
    assert one(tmp_path, scenario(features=roads()[-5:])).lanes is None


def test_unknown_fields_are_skipped(tmp_path):
    extra = scenario() + inside(12, bytes(100)) + whole(99, 5) + double(98, 1.0)
    assert len(one(tmp_path, extra).tracks) == 5 * 91
    assert waymo_files.crc32c(b"123456789") == 0xE3069283
