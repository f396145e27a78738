"""Argoverse 2: tracks and maps against an independent reader, splits by folder, and bad files."""

from __future__ import annotations

import json
import math
import shutil
from itertools import pairwise

import numpy as np
import polars as pl
import pytest

from data.recorded.formats.argoverse2_files import city, drive, lane, points, write
from data.recorded.formats.exid_files import shared
from epo_lightning.data.recorded.formats.argoverse2 import argoverse2, midways
from epo_lightning.data.recorded.lanes import LANE, SHOULDER
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tracks import RecordingError
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS

NAMES = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
STANDARD = WindowConfig(dt=0.1, history=50, horizon=60, least_agents=2, lane_change=False)


def read(home):
    (source,) = argoverse2(home)
    return source.read()


def plain(folder):
    """The agents' states by identifier and frame, and the map, read in the simplest way."""
    (tracks,), (roads,) = folder.glob("*.parquet"), folder.glob("*.json")
    states, kinds = {}, {}
    used = ("track_id", "object_type", "timestep", *NAMES)
    for row in pl.scan_parquet(tracks).select(used).collect().to_dicts():
        if row["object_type"] not in ("static", "background", "construction", "riderless_bicycle"):
            id = -1 if row["track_id"] == "AV" else int(row["track_id"])
            states.setdefault(id, {})[row["timestep"]] = [row[name] for name in NAMES]
            kinds[id] = row["object_type"]
    return states, kinds, json.loads(roads.read_text())["lane_segments"].values()


def found_states(tracks):
    """The states of a recording by identifier and frame."""
    rows = np.column_stack([tracks.position, tracks.heading, tracks.velocity]).tolist()
    found = {id: {} for id in tracks.ids.tolist()}
    for id, frame, row in zip(tracks.ids[tracks.agent].tolist(), tracks.frame.tolist(), rows, strict=True):
        found[id][frame] = row
    return found


def agrees(recording, folder):
    """Assert that a recording holds what the plain reader finds."""
    states, kinds, segments = plain(folder)
    tracks, lanes = recording.tracks, recording.lanes
    assert found_states(tracks) == states
    names = {"vehicle": "car", "cyclist": "bicycle", "motorcyclist": "motorcycle", "unknown": "other"}
    assert [KINDS[kind] for kind in tracks.kind] == [names.get(kinds[id], kinds[id]) for id in tracks.ids]
    known = {segment["id"]: segment for segment in segments}
    assert set(lanes.ids.tolist()) == set(known)
    for at, id in enumerate(lanes.ids.tolist()):
        for side in ("left", "right"):
            line = [[point["x"], point["y"]] for point in known[id][f"{side}_lane_boundary"]]
            assert getattr(lanes, side)[at].tolist() == line
        following = {other for other in known[id]["successors"] if other in known}
        following |= {other for other, segment in known.items() if id in segment["predecessors"]}
        assert {int(lanes.ids[other]) for other in lanes.successors[at]} == following
        for side, found in (("left", lanes.adjacent_left[at]), ("right", lanes.adjacent_right[at])):
            beside = known[id][f"{side}_neighbor_id"]
            if found >= 0:
                assert lanes.ids[found] == beside
            elif beside in known:
                ways = [
                    np.subtract(*(lanes.centre[at][end] for end in (-1, 0)))
                    for at in (at, lanes.ids.tolist().index(beside))
                ]
                assert np.dot(*ways) < 0, "only lanes of oncoming traffic are no neighbours"
        # Points of the centreline are about as far from one boundary as from the other, and the publisher's lie on it.
        for x, y in lanes.centre[at]:
            far = [distance(line, x, y) for line in (lanes.left[at], lanes.right[at])]
            assert abs(far[0] - far[1]) < 1.1, id
        if "centerline" in known[id]:
            theirs = [(point["x"], point["y"]) for point in known[id]["centerline"]]
            assert max(distance(lanes.centre[at], x, y) for x, y in theirs) < 0.15, id


def distance(line, x, y):
    """Distance of a point from a line, segment by segment."""
    best = math.inf
    for (ax, ay), (bx, by) in pairwise(line):
        length = (bx - ax) ** 2 + (by - ay) ** 2
        share = 0.0 if not length else min(1.0, max(0.0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length))
        best = min(best, math.hypot(x - ax - share * (bx - ax), y - ay - share * (by - ay)))
    return best


def test_argoverse2_is_a_registered_format():
    assert lookup("format", "argoverse2") is argoverse2


def test_a_scenario_is_one_recording(tmp_path):
    folder = write(tmp_path)
    (source,) = argoverse2(tmp_path)
    assert (source.name, source.group) == ("s", "s")
    assert [file.name for file in source.files] == ["scenario_s.parquet", "log_map_archive_s.json"]
    recording = source.read()
    agrees(recording, folder)
    tracks, lanes = recording.tracks, recording.lanes
    assert tracks.rate == 10.0
    assert tracks.ids.tolist() == [-1, 7, 8, 9, 12, 14, 16]
    assert [KINDS[kind] for kind in tracks.kind] == ["car", "car", "bus", "pedestrian", "bicycle", "car", "motorcycle"]
    assert tracks.size.tolist() == [[4.5, 1.8], [4.5, 1.8], [12.0, 2.5], [0.5, 0.5], [1.8, 0.7], [4.5, 1.8], [2.2, 0.9]]
    assert recording.dropped == {
        "tracks of things that are no agents (static, construction, ...)": 1,
        "lane references to lanes that do not exist": 1,
    }
    at = {id: lane for lane, id in enumerate(lanes.ids.tolist())}
    named = [
        {
            side: lanes.ids[to] if (to := getattr(lanes, side)[at[id]]) >= 0 else None
            for side in ("left_of", "right_of", "adjacent_left", "adjacent_right")
        }
        for id in (10, 11, 20)
    ]
    assert named[0] == {"left_of": 11, "right_of": None, "adjacent_left": 11, "adjacent_right": 30}
    assert named[1] == {"left_of": None, "right_of": 10, "adjacent_left": None, "adjacent_right": 10}
    assert named[2] == dict.fromkeys(named[2])
    assert lanes.kind[[at[id] for id in (10, 30, 31)]].tolist() == [LANE, SHOULDER, SHOULDER]
    assert np.isnan(lanes.speed_limit).all()
    assert (lanes.centre[at[10]][:, 1] == 1.75).all()


def test_rows_in_any_order_give_the_same_tracks(tmp_path):
    write(tmp_path / "a")
    write(tmp_path / "b", tracks=drive().sample(fraction=1.0, shuffle=True, seed=0))
    one, other = read(tmp_path / "a").tracks, read(tmp_path / "b").tracks
    for name in ("agent", "frame", "position", "heading", "velocity", "ids", "size", "kind"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_the_publishers_windows_are_one_moment_of_each_scenario(tmp_path):
    write(tmp_path)
    scenes, counts = extract(read(tmp_path), STANDARD)
    assert set(scenes.frame.tolist()) == {49}
    assert counts["windows"] == 7, "one around every agent that is seen in all 110 frames"
    assert scenes.history.shape[1:] == (50, 4)
    assert scenes.future.shape[1:] == (60, 4)
    assert scenes.future_mask.all()
    # A track with a gap is in no complete window.
    write(tmp_path / "gap", tracks=drive().filter((pl.col("track_id") != "7") | (pl.col("timestep") != 30)))
    _, counts = extract(read(tmp_path / "gap"), STANDARD)
    assert (counts["windows"], counts["gaps in tracks"]) == (6, 1)


def test_the_publishers_splits_are_groups(tmp_path):
    for split, name in (("train", "a"), ("train", "b"), ("train", "c"), ("val", "d"), ("test", "e")):
        write(tmp_path / split, name, drive(50 if split == "test" else 110))
    with pytest.warns(UserWarning, match="test is left out: its scenarios have no futures"):
        found = argoverse2(tmp_path)
    assert [(source.name, source.group) for source in found] == [
        ("a", "train"),
        ("b", "train"),
        ("c", "train"),
        ("d", "val"),
    ]
    windows = {"dt": 0.1, "history": 50, "horizon": 60, "least_agents": 2, "lane_change": False}
    splits = RecordedData("argoverse2", "argoverse2", str(tmp_path), windows, test=["val"]).splits(found)
    assert [source.name for source in splits["test"]] == ["d"]
    assert sorted(source.name for part in ("train", "val") for source in splits[part]) == ["a", "b", "c"]
    (tmp_path / "both").mkdir()
    for split in ("train", "val"):
        shutil.copytree(tmp_path / split, tmp_path / "both" / split)
    assert [source.group for source in argoverse2(tmp_path / "both")] == ["train", "train", "train", "val"]
    # A folder of a split alone, or any other folder, has one group per scenario.
    assert [(source.name, source.group) for source in argoverse2(tmp_path / "train")] == [(n, n) for n in "abc"]
    assert [source.name for source in argoverse2(tmp_path / "test")] == ["e"]
    scenes, counts = extract(argoverse2(tmp_path / "test")[0].read(), STANDARD)
    assert scenes is None
    assert counts["tracks shorter than a window"] == 7


def test_one_broken_scenario_does_not_stop_the_listing(tmp_path):
    write(tmp_path, "a")
    write(tmp_path, "b")
    (tmp_path / "a" / "log_map_archive_a.json").unlink()
    first, second = argoverse2(tmp_path)
    assert [file.name for file in first.files] == ["scenario_a.parquet"]
    with pytest.raises(
        RecordingError, match=r"log_map_archive_a.json: there is no such file, but scenario_a.parquet is"
    ):
        first.read()
    assert second.read().name == "b"
    with pytest.raises(RecordingError, match="there is no such folder"):
        argoverse2(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="there is no Argoverse 2 scenario in it"):
        argoverse2(tmp_path / "empty")
    write(tmp_path / "again", "b")
    with pytest.raises(RecordingError, match="has the same name: remove one of the two"):
        argoverse2(tmp_path)


def test_listing_opens_no_file(tmp_path):
    folder = write(tmp_path)
    for file in folder.iterdir():
        file.write_bytes(b"")
    (source,) = argoverse2(tmp_path)
    with pytest.raises(RecordingError, match=r"scenario_s.parquet: it cannot be read as parquet"):
        source.read()


def at(row, **values):
    """A change of some values of one row of the tracks."""
    return lambda tracks: tracks.with_row_index().with_columns(
        pl.when(pl.col("index") == row).then(pl.lit(value, tracks.schema[name])).otherwise(pl.col(name)).alias(name)
        for name, value in values.items()
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop("heading"), "the columns track_id, .* were expected"),
        (lambda t: t.with_columns(pl.col("position_x").cast(pl.String)), "the column position_x is of the type String"),
        (lambda t: t.with_columns(pl.col("timestep").cast(pl.Float64)), "the column timestep is of the type Float64"),
        (lambda t: t.with_columns(track_id=pl.lit(7)), "the column track_id is of the type Int32"),
        (at(4, position_x=None), "row 5: there is no position_x"),
        (at(4, position_x=float("nan")), r"track 7 has the numbers \[nan, .* in frame 4"),
        (at(4, heading=float("inf")), "track 7 has the numbers"),
        (
            lambda t: t.with_columns(pl.col("position_x") + 1e8),
            r"scenario_s.parquet: track -1 has the numbers \[1000000\d\d.*positions at most 1e\+07 m",
        ),
        (at(4, velocity_x=500.0), r"velocity \[500.0, .* is it in another unit"),
        (at(4, track_id="seven"), "row 5: track_id is 'seven'; a number or AV was expected"),
        (at(4, track_id="-1"), "row 5: track_id is '-1'"),
        (at(4, timestep=-1), "row 5: timestep is -1; 0 to"),
        (at(4, timestep=3), "track 7 has frame 3 twice"),
        (at(4, object_type="bus"), "track 7 is of the types 'vehicle' and 'bus'"),
        (lambda t: t.with_columns(pl.col("velocity_x", "velocity_y") * 3.6), "positions move 0.278 times as fast"),
        (lambda t: t.with_columns(pl.col("heading") + np.pi / 2), "headings differ by 90 degrees"),
    ],
)
def test_invalid_tracks_are_refused(tmp_path, change, message):
    write(tmp_path, tracks=change(drive()))
    with pytest.raises(RecordingError, match=message):
        read(tmp_path)


def test_tracks_that_jump_and_unknown_types_are_counted(tmp_path):
    tracks = drive().with_columns(
        position_x=pl.when((pl.col("track_id") == "7") & (pl.col("timestep") > 60))
        .then(pl.col("position_x") + 40)
        .otherwise("position_x"),
        object_type=pl.when(pl.col("track_id") == "9").then(pl.lit("hovercraft")).otherwise("object_type"),
    )
    write(tmp_path, tracks=tracks)
    recording = read(tmp_path)
    assert recording.tracks.ids.tolist() == [-1, 8, 9, 12, 14, 16]
    assert KINDS[recording.tracks.kind[2]] == "other"
    assert recording.dropped["tracks that jump, faster than 120 m/s"] == 1
    assert recording.dropped["agents of a class that is unknown, taken as 'other'"] == 1


def test_a_scenario_without_agents_is_counted(tmp_path):
    write(tmp_path, tracks=drive(agents=(("15", "static", 0.0, 0.0, 0.0),)))
    recording = read(tmp_path)
    assert len(recording.tracks) == 0
    assert recording.dropped["recordings without traffic"] == 1
    assert extract(recording, STANDARD)[0] is None


def changed(**about):
    def change(roads):
        roads["lane_segments"]["10"] |= about
        return roads

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: [], "lane_segments was expected to be an object"),
        (lambda r: {"lane_segments": [1]}, "lane_segments was expected to be an object"),
        (lambda r: {"lane_segments": {"1": 2}}, "lane_segments was expected to be an object"),
        (changed(id="10"), "the id of a lane is '10'; a whole number"),
        (changed(id=11), "there are two lanes with the id 11"),
        (changed(left_lane_boundary=[{"x": 1.0}]), "left_lane_boundary of lane 10 was expected to be a list of points"),
        (changed(left_lane_boundary=None), "left_lane_boundary of lane 10 was expected"),
        (
            changed(right_lane_boundary=points((0.0, 0.0), (float("nan"), 1.0))),
            "right_lane_boundary of lane 10 has coord",
        ),
        (changed(right_lane_boundary=points((0.0, 0.0), (1e9, 1.0))), "beyond 1e.07 m"),
        (changed(successors=None), "successors of lane 10 is 'None'; a list"),
        (changed(predecessors=["x"]), "predecessors of lane 10 is 'x'; a whole number"),
        (changed(left_neighbor_id=1.5), "left_neighbor_id of lane 10 is '1.5'"),
        (changed(left_neighbor_id=10), "lane 10 lies beside itself"),
    ],
)
def test_invalid_maps_are_refused(tmp_path, change, message):
    write(tmp_path, roads=change(city()))
    with pytest.raises(RecordingError, match=rf"log_map_archive_s.json: .*{message}"):
        read(tmp_path)


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_maps_that_are_no_json_are_refused(tmp_path, text):
    (write(tmp_path) / "log_map_archive_s.json").write_bytes(text)
    with pytest.raises(RecordingError, match=r"log_map_archive_s.json: it is no JSON"):
        read(tmp_path)


def test_lanes_without_length_are_counted_and_no_lanes_are_no_map(tmp_path):
    roads = city()
    roads["lane_segments"]["99"] = lane(99, [(1.0, 1.0), (1.0, 1.0)], [(0.0, 0.0), (0.0, 1.0)])
    write(tmp_path / "a", roads=roads)
    recording = read(tmp_path / "a")
    assert 99 not in recording.lanes.ids
    assert recording.dropped["lanes without length"] == 1
    write(tmp_path / "b", roads={"lane_segments": {}})
    assert read(tmp_path / "b").lanes is None


def test_a_centreline_is_midway_between_its_boundaries():
    angle = np.linspace(0, np.pi / 2, 40)
    arc = np.stack([np.cos(angle), np.sin(angle)], 1)
    middle, straight = midways([20.0 * arc, np.eye(2)], [24.0 * arc[::3], 2.0 * np.eye(2)])
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 22.0, atol=0.03)
    assert np.linalg.norm(np.diff(middle, axis=0), axis=1).max() < 2.0
    np.testing.assert_allclose(straight, [[1.5, 0.0], [0.75, 0.75], [0.0, 1.5]])


def test_the_samples_agree_with_the_plain_reader():
    folder = shared("data/argoverse2")
    found = argoverse2(folder)
    assert len(found) == 3
    for source in found:
        agrees(source.read(), source.files[0].parent)


def test_the_samples_agree_with_the_publishers_package():
    serialization = pytest.importorskip("av2.datasets.motion_forecasting.scenario_serialization")
    maps = pytest.importorskip("av2.map.map_api")
    for source in argoverse2(shared("data/argoverse2")):
        recording = source.read()
        scenario = serialization.load_argoverse_scenario_parquet(source.files[0])
        tracks, lanes = recording.tracks, recording.lanes
        rows = 0
        for track in scenario.tracks:
            if track.object_type.value in ("static", "background", "construction", "riderless_bicycle"):
                continue
            agent = tracks.ids.tolist().index(-1 if track.track_id == "AV" else int(track.track_id))
            mine = tracks.agent == agent
            rows += mine.sum()
            states = [
                [state.timestep, *state.position, state.heading, *state.velocity] for state in track.object_states
            ]
            found = np.column_stack([tracks.frame, tracks.position, tracks.heading, tracks.velocity])[mine]
            np.testing.assert_array_equal(found, states)
        assert rows == len(tracks)
        static = maps.ArgoverseStaticMap.from_json(source.files[1])
        assert set(static.get_scenario_lane_segment_ids()) == set(lanes.ids.tolist())
        for at, id in enumerate(lanes.ids.tolist()):
            following = {
                other for other in static.get_lane_segment_successor_ids(id) if other in set(lanes.ids.tolist())
            }
            assert {int(lanes.ids[other]) for other in lanes.successors[at]} >= following
            theirs = static.get_lane_segment_centerline(id)[:, :2]
            assert max(distance(lanes.centre[at], x, y) for x, y in theirs) < 0.15
