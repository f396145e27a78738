"""highD, inD, rounD and uniD: frames of reference, kinds and lanes, against a plain reader of the same files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from data.recorded.formats.fuzz import damage
from data.recorded.formats.levelx_files import LOWER, RATE, UPPER, urban_road, write_highd, write_urban
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.lanes import LaneGraph
from epo_lightning.data.recorded.tracks import Recording
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS


def read(format: str, folder: Path) -> Recording:
    (source,) = lookup("format", format)(folder)
    return source.read()


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a table as texts, by an independent reader."""
    with path.open(newline="", encoding="latin-1") as file:
        return [
            {(name or "").strip(' "'): (value or "").strip('"') for name, value in row.items()}
            for row in csv.DictReader(file, quoting=csv.QUOTE_NONE)
        ]


def numbers(rows: list[dict[str, str]], *names: str) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows]).reshape(len(rows), len(names))


def check_highd(recording: Recording, folder: Path, label: str = "") -> None:
    """A recording holds the rows of its files: centres instead of corners, y up, headings along the road."""
    tracks = recording.tracks
    rows = numbers(rows_of(folder / "01_tracks.csv"), "id", "frame", "x", "y", "xVelocity", "yVelocity")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    meta = {int(row["id"]): row for row in rows_of(folder / "01_tracksMeta.csv")}
    assert len(tracks) == len(rows), label
    np.testing.assert_array_equal(tracks.ids[tracks.agent], rows[:, 0], label)
    np.testing.assert_array_equal(tracks.frame, rows[:, 1], label)
    extent = np.array([[float(meta[int(id)]["width"]), float(meta[int(id)]["height"])] for id in rows[:, 0]])
    np.testing.assert_array_equal(tracks.size[tracks.agent], extent, label)
    centre = np.stack([rows[:, 2] + extent[:, 0] / 2, -(rows[:, 3] + extent[:, 1] / 2)], 1)
    np.testing.assert_allclose(tracks.position, centre, rtol=1e-12, err_msg=label)
    np.testing.assert_array_equal(tracks.velocity, rows[:, 4:] * (1, -1), label)
    to_right = np.array([int(meta[int(id)]["drivingDirection"]) == 2 for id in rows[:, 0]])
    off = np.abs((tracks.heading - np.where(to_right, 0.0, np.pi) + np.pi) % (2 * np.pi) - np.pi)
    assert (off <= np.pi / 2 + 1e-9).all(), label
    fast = np.where(to_right, 1, -1) * rows[:, 4] > 2.0
    course = np.arctan2(-rows[fast, 5], rows[fast, 4])
    np.testing.assert_allclose(np.cos(tracks.heading[fast] - course), 1.0, atol=1e-9, err_msg=label)


def check_urban(recording: Recording, folder: Path, label: str = "") -> None:
    """A recording holds the rows of its files; pedestrians and cyclists have a size."""
    tracks = recording.tracks
    names = ("trackId", "frame", "xCenter", "yCenter", "xVelocity", "yVelocity", "heading")
    rows = numbers(rows_of(folder / "data" / "00_tracks.csv"), *names)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    assert len(tracks) == len(rows), label
    np.testing.assert_array_equal(tracks.ids[tracks.agent], rows[:, 0], label)
    np.testing.assert_array_equal(tracks.frame, rows[:, 1], label)
    np.testing.assert_array_equal(tracks.position, rows[:, 2:4], label)
    np.testing.assert_array_equal(tracks.velocity, rows[:, 4:6], label)
    turns = (tracks.heading - np.deg2rad(rows[:, 6])) / (2 * np.pi)
    np.testing.assert_allclose(turns, turns.round(), atol=1e-9, err_msg=label)


def test_highd_has_centres_y_up_and_headings_along_the_road(tmp_path):
    folder = write_highd(tmp_path)
    recording = read("highd", folder)
    tracks = recording.tracks
    assert (recording.name, recording.group, recording.dropped, tracks.rate) == ("01", "2", {}, RATE)
    assert tracks.ids.tolist() == [3, 5, 8, 9]
    assert [KINDS[kind] for kind in tracks.kind] == ["car", "truck", "car", "car"]
    assert tracks.size.tolist() == [[4.6, 1.9], [14.5, 2.5], [4.2, 1.8], [4.9, 2.0]]
    check_highd(recording, folder)
    # Displacements point where headings do: signs of axes, velocities and headings agree.
    moved = np.diff(tracks.position, axis=0)[np.diff(tracks.agent) == 0]
    course = np.arctan2(moved[:, 1], moved[:, 0])
    heading = tracks.heading[:-1][np.diff(tracks.agent) == 0]
    steady = np.linalg.norm(moved, axis=1) > 2.0 / RATE
    np.testing.assert_allclose(np.cos(heading - course)[steady], 1.0, atol=1e-9)
    slow = tracks.heading[tracks.agent == 3]
    np.testing.assert_allclose(slow, -np.arctan2(0.1, 2.0), err_msg="lateral noise turns a slow vehicle little")
    assert (tracks.speed > 0).all()


def test_highd_lanes_lie_between_the_markings(tmp_path):
    folder = write_highd(tmp_path, limit=27.78)
    recording = read("highd", folder)
    lanes = recording.lanes
    assert isinstance(lanes, LaneGraph)
    assert lanes.ids.tolist() == [2, 3, 5, 6, 7]
    np.testing.assert_array_equal(lanes.speed_limit, 27.78)
    located = lanes.locate(recording.tracks.position, recording.tracks.heading)
    stated = numbers(sorted(rows_of(folder / "01_tracks.csv"), key=lambda row: int(row["id"])), "laneId")[:, 0]
    np.testing.assert_array_equal(lanes.ids[located.lane], stated)
    assert len(set(stated[recording.tracks.agent == 2].tolist())) == 2, "one car changes lane"
    for lane, (left, right, centre) in enumerate(zip(lanes.left, lanes.right, lanes.centre, strict=True)):
        way = centre[-1] - centre[0]
        assert np.sign(way[0]) == (-1 if lanes.ids[lane] < 4 else 1)
        assert way[0] * (left[0, 1] - right[0, 1]) > 0, "the left boundary is on the left"
        np.testing.assert_allclose(centre, 0.5 * (left + right))
        assert {round(-float(left[0, 1]), 6), round(-float(right[0, 1]), 6)} <= {*UPPER, *LOWER}
        if (beside := lanes.left_of[lane]) >= 0:
            np.testing.assert_array_equal(lanes.right[beside], left)
            assert lanes.right_of[beside] == lane
    assert lanes.left_of.tolist() == [1, -1, -1, 2, 3]
    assert lanes.adjacent_left.tolist() == [1, -1, -1, 2, 3]
    assert lanes.adjacent_right.tolist() == [-1, 0, 3, 4, -1]


def test_highd_lanes_begin_before_all_vehicles_and_end_after_them(tmp_path):
    path = write_highd(tmp_path) / "01_tracks.csv"
    pl.read_csv(path).with_columns(pl.col("x") + 3).write_csv(path)
    recording = read("highd", tmp_path)
    assert np.ptp(recording.tracks.position[:, 0]) == 360.0
    assert {tuple(sorted(centre[:, 0])) for centre in recording.lanes.centre} == {(20.0, 390.0)}


@pytest.mark.parametrize("format", ["ind", "round", "unid"])
@pytest.mark.parametrize("maps", ["maps/lanelet2", "maps/lanelets", "maps", "lanelet2", "lanelets", "data"])
def test_urban_recordings_and_their_maps_are_read(tmp_path, format, maps):
    folder = write_urban(tmp_path, osm=urban_road(), maps=maps)
    recording = read(format, folder)
    tracks = recording.tracks
    assert (recording.name, recording.group) == ("00", "4" if format == "ind" else "00")
    assert [KINDS[kind] for kind in tracks.kind] == ["car", "truck", "bicycle", "pedestrian", "pedestrian"]
    assert tracks.size.tolist() == [[4.4, 1.8], [11.8, 2.6], [1.8, 0.7], [0.5, 0.5], [0.5, 0.5]]
    assert recording.dropped == {
        "bicycles without a size, taken as 1.8 x 0.7 m": 1,
        "pedestrians without a size, taken as 0.5 x 0.5 m": 2,
    }
    check_urban(recording, folder)
    assert recording.lanes.ids.tolist() == [1, 2, 3, 4, 5, 6]
    np.testing.assert_array_equal(recording.lanes.speed_limit, 13.9)
    located = recording.lanes.locate(tracks.position, tracks.heading)
    assert [set(located.lane[tracks.agent == agent].tolist()) for agent in (0, 1, 3)] == [{0}, {1}, {-1}]


def test_urban_recordings_without_a_map_have_no_lanes(tmp_path):
    folder = write_urban(tmp_path)
    assert read("ind", folder).lanes is None
    with pytest.raises(RecordingError, match="there is no map of its locationId 4"):
        lookup("format", "exid")(folder)


def test_a_vehicle_of_highd_that_rolls_backwards_keeps_its_direction(tmp_path):
    path = write_highd(tmp_path) / "01_tracks.csv"
    rolls, table = pl.col("id") == 9, pl.read_csv(path)
    table.with_columns(
        xVelocity=pl.when(rolls).then(-1.0).otherwise("xVelocity"),
        x=pl.when(rolls).then(90.0 - (pl.col("frame") - 7) / RATE).otherwise("x"),
    ).write_csv(path)
    tracks = read("highd", tmp_path).tracks
    mine = tracks.agent == 3
    assert (np.abs(tracks.heading[mine]) < 0.1).all()
    np.testing.assert_allclose(tracks.speed[mine], -1.0, atol=0.01)


@pytest.mark.parametrize(("name", "kind"), [("trailer", "truck"), ("cyclist", "bicycle"), ("animal", "other")])
def test_names_of_classes_are_kinds(tmp_path, name, kind):
    path = write_urban(tmp_path) / "data" / "00_tracksMeta.csv"
    path.write_text(path.read_text().replace(",car", f",{name}"))
    recording = read("ind", tmp_path)
    assert KINDS[recording.tracks.kind[0]] == kind
    assert not any("unknown" in reason for reason in recording.dropped)


def test_a_map_is_found_by_the_number_of_its_location_alone(tmp_path):
    folder = write_urban(tmp_path, osm=urban_road())
    write_urban(folder, osm=urban_road(), maps="data")
    (folder / "maps" / "4_somewhere.osm").touch()
    (folder / "maps" / "04_somewhere.osm").rename(folder / "maps" / "44_elsewhere.osm")
    (source,) = lookup("format", "ind")(folder)
    assert source.files[-1] == folder / "maps" / "4_somewhere.osm", "not the copy beside the tables"
    (folder / "maps" / "4_somewhere.osm").rename(folder / "maps" / "location4.osm")
    (source,) = lookup("format", "ind")(folder)
    assert source.files[-1].name == "location4.osm"


def test_a_recording_may_be_long_and_of_location_0_and_need_not_state_its_duration(tmp_path):
    data = write_urban(tmp_path, location=0) / "data"
    for name, columns in (("tracks", ["frame"]), ("tracksMeta", ["initialFrame", "finalFrame"])):
        table = pl.read_csv(data / f"00_{name}.csv")
        table.with_columns(pl.col(columns) + 40_000).write_csv(data / f"00_{name}.csv")
    meta = data / "00_recordingMeta.csv"
    pl.read_csv(meta).drop("duration", "speedLimit").write_csv(meta)
    recording = read("ind", tmp_path)
    assert recording.group == "0"
    assert recording.tracks.frame.min() == 40_000


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("tracks", ("xVelocity", "vx"), "01_tracks.csv: there is no column xVelocity"),
        ("tracks", ("8,22", "7,22"), None),
        ("tracksMeta", ("Car,1", "Car,3"), r"01_tracksMeta.csv: drivingDirection of vehicle 3 is 3; 1 \(towards"),
        ("tracksMeta", ("Car,2", "Car,1"), "drivingDirection of vehicle 8 is 1; it drives the other way"),
        (
            "tracksMeta",
            ("3,4.6,1.9", "3,4.6,-1.9"),
            r"01_tracksMeta.csv: length and width \[4.6, -1.9\] of track 3 were",
        ),
        ("tracksMeta", ("numFrames", "frames"), "there is no column numFrames; is it 'frames'"),
        (
            "recordingMeta",
            ("8.5;12.4", "12.4;8.5"),
            r"recordingMeta.csv, row 2: upperLaneMarkings is \[12.4, 8.5, 16.2\]",
        ),
        ("recordingMeta", ("8.5;12.4;16.2", "8.5"), "two or more positions of markings in metres were expected"),
        ("recordingMeta", ("8.5;12.4", "8.5;x"), "upperLaneMarkings is .*numbers separated by semicolons"),
        (
            "recordingMeta",
            ("21.0;24.9;28.7;32.5", "14.0;18.0;22.0;26.0"),
            "upperLaneMarkings end at 16.2, beyond the first of lower",
        ),
        ("recordingMeta", ("lowerLaneMarkings", "lower"), "there is no column lowerLaneMarkings"),
    ],
)
def test_invalid_files_of_highd_are_refused(tmp_path, file, change, message):
    folder = write_highd(tmp_path)
    path = folder / f"01_{file}.csv"
    text = path.read_text()
    if message is None:
        path.write_text(text.replace("\n1,3,", "\n2,3,", 1))
        message = "track 3 has frame 2 twice"
    else:
        assert change[0] in text
        path.write_text(text.replace(*change))
    with pytest.raises(RecordingError, match=message):
        read("highd", folder)


def test_positions_in_pixels_are_refused(tmp_path):
    folder = write_highd(tmp_path)
    path = folder / "01_tracks.csv"
    pl.read_csv(path).with_columns(pl.col("x") * 10, pl.col("y") * 10).write_csv(path)
    with pytest.raises(RecordingError, match=r"positions move 10 times as fast|jumps from"):
        read("highd", folder)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("trials", [60, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("format", ["highd", "ind"])
def test_damaged_tables_give_only_recording_errors(tmp_path, trials, format):
    folder = tmp_path / format
    if format == "highd":
        write_highd(folder)
    else:
        write_urban(folder)
    check = check_highd if format == "highd" else check_urban
    (source,) = lookup("format", format)(folder)
    damage(
        lambda: read(format, folder),
        folder,
        [file for file in source.files if file.suffix == ".csv"],
        trials,
        lambda found, label: check(found, folder, label),
    )
