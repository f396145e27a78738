"""INTERACTION: both layouts, maps in local metres, pedestrians without heading and size, and bad files."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from data.recorded.formats.exid_files import ORIGIN, road
from data.recorded.formats.fuzz import damage
from data.recorded.formats.interaction_files import AROUND, PLACE, map_text, write_cases, write_map, write_recording
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.interaction import CASE, PEDESTRIANS, PER_CASE, interaction
from epo_lightning.data.recorded.formats.interaction import ORIGIN as ZERO
from epo_lightning.data.recorded.formats.lanelet2 import read_map
from epo_lightning.data.recorded.tracks import Recording
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS


def read(folder: Path) -> Recording:
    (source,) = interaction(folder)
    return source.read()


def check(recording: Recording, folder: Path, label: str = "") -> None:
    """A recording holds exactly the rows of its tables, by an independent reader."""
    rows = []
    for path in (*folder.rglob("*_tracks_*.csv"), *folder.rglob("*_train.csv")):
        with path.open(newline="", encoding="latin-1") as file:
            for raw in csv.DictReader(file, quoting=csv.QUOTE_NONE):
                row = {(name or "").strip(' "'): (value or "").strip(' "') for name, value in raw.items()}
                case, track = int(float(row.get("case_id") or 0)), row["track_id"]
                number = int(float(track.removeprefix("P"))) + PEDESTRIANS * track.startswith("P")
                values = [float(row[name]) for name in ("x", "y", "vx", "vy")]
                extra = [float(row.get(name) or "nan") for name in ("psi_rad", "length", "width")]
                rows.append([PER_CASE * case + number, CASE * case + float(row["frame_id"]), *values, *extra])
    expected = np.array(sorted(rows))
    tracks = recording.tracks
    assert len(tracks) == len(expected), label
    ids = tracks.ids[tracks.agent]
    # Agents of the second table follow those of the first one, whatever their ids.
    order = np.lexsort((tracks.frame, ids))
    np.testing.assert_array_equal(ids[order], expected[:, 0], label)
    np.testing.assert_array_equal(tracks.frame[order], expected[:, 1], label)
    np.testing.assert_array_equal(tracks.position[order], expected[:, 2:4], label)
    np.testing.assert_array_equal(tracks.velocity[order], expected[:, 4:6], label)
    given = ~np.isnan(expected[:, 6])
    turns = (tracks.heading[order][given] - expected[given, 6]) / (2 * np.pi)
    np.testing.assert_allclose(turns, turns.round(), atol=1e-6, err_msg=label)


@pytest.mark.parametrize("suffix", [".osm", ".osm_xy"])
def test_a_recording_has_the_rows_of_both_tables_and_its_map(tmp_path, suffix):
    folder = write_recording(tmp_path, suffix=suffix)
    (source,) = lookup("format", "interaction")(folder)
    assert (source.name, source.group) == (f"{PLACE}_000", PLACE)
    assert [path.name for path in source.files] == [
        "vehicle_tracks_000.csv",
        "pedestrian_tracks_000.csv",
        f"{PLACE}{suffix}",
    ]
    recording = source.read()
    tracks = recording.tracks
    assert tracks.rate == 10.0
    assert tracks.ids.tolist() == [1, 2, 3, PEDESTRIANS + 1, PEDESTRIANS + 2]
    assert [KINDS[kind] for kind in tracks.kind] == ["car", "car", "truck", "pedestrian", "pedestrian"]
    assert tracks.size.tolist() == [[4.3, 2.0], [4.8, 2.0], [9.5, 2.0], [0.5, 0.5], [0.5, 0.5]]
    assert recording.dropped == {"pedestrians without a size, taken as 0.5 x 0.5 m": 2}
    check(recording, folder)
    walks = tracks.heading[tracks.agent == 3]
    np.testing.assert_allclose(walks, np.arctan2(1.1, -0.9))
    np.testing.assert_allclose(tracks.heading[tracks.agent == 4], np.pi / 2)
    located = recording.lanes.locate(tracks.position, tracks.heading)
    assert [set(located.lane[tracks.agent == agent].tolist()) for agent in (0, 1, 2, 3)] == [{0}, {1}, {4}, {-1}]


def test_cases_of_the_challenge_do_not_meet(tmp_path):
    """All cases begin at frame 1 in the file; in the recording no two cases have a frame or an id in common."""
    folder = write_cases(tmp_path)
    recording = read(folder)
    tracks = recording.tracks
    check(recording, folder)
    assert len(tracks.ids) == 3 * 5
    case = tracks.frame // CASE
    assert (tracks.ids[tracks.agent] // PER_CASE == case).all()
    assert sorted(set(case.tolist())) == [1, 2, 3]
    config = WindowConfig(dt=0.1, history=3, horizon=4, least_agents=2, lane_change=False)
    scenes, counts = extract(recording, config)
    assert counts["scenes"] > 0
    for row in scenes.agents:
        members = scenes.track[row[row >= 0]]
        assert len(set((members // PER_CASE).tolist())) == 1, "agents of one scene are of one case"


def test_maps_in_degrees_and_in_metres_agree_with_the_road_as_it_was_drawn(tmp_path):
    exid = tmp_path / "exid.osm"
    exid.write_text(str(road()))
    drawn = read_map(exid, ORIGIN)
    for suffix in (".osm", ".osm_xy"):
        (tmp_path / f"map{suffix}").write_text(map_text(metres=suffix == ".osm_xy"))
        found = read_map(tmp_path / f"map{suffix}", ZERO, zone=31, north=True)
        assert found.successors == drawn.successors
        for name in ("left", "right", "centre"):
            for line, other in zip(getattr(found, name), getattr(drawn, name), strict=True):
                np.testing.assert_allclose(line - AROUND, other, atol=2e-6)


def test_the_projection_is_that_of_the_lanelet2_library(tmp_path):
    lanelet2 = pytest.importorskip("lanelet2", reason="the lanelet2 package is not installed")
    path = tmp_path / "map.osm"
    path.write_text(map_text())
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(0, 0))
    library = lanelet2.io.load(str(path), projector)
    found = read_map(path, ZERO, zone=31, north=True)
    for id, line in zip(found.ids.tolist(), found.left, strict=True):
        theirs = np.array([[point.x, point.y] for point in library.laneletLayer[id].leftBound])
        np.testing.assert_allclose(line, theirs, atol=1e-6)


def test_nodes_south_of_the_equator_keep_their_place(tmp_path):
    """Local coordinates may be negative: a false northing of the southern hemisphere would move them by 10,000 km."""
    text = map_text().replace("lat='0.00", "lat='-0.00")
    (tmp_path / "map.osm").write_text(text)
    lanes = read_map(tmp_path / "map.osm", ZERO, zone=31, north=True)
    assert -1100 < min(line[:, 1].min() for line in lanes.left) < 0


def test_a_recording_without_a_map_has_no_lanes(tmp_path):
    assert read(write_recording(tmp_path, suffix="")).lanes is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("track_id,", "id,"), "vehicle_tracks_000.csv: there is no column track_id"),
        (("1,3,300,car", "1,3,350,car"), "row 4: timestamp_ms is 350 in frame 3; 300 was expected: frames are 100 ms"),
        (("1,3,300,car", "1,3.5,350,car"), "row 4: frame_id is 3.5; a whole number in 0"),
        (("1,3,300,car", "1,2,200,car"), "track 1 has frame 2 twice"),
        (("1,3,300,car", "X1,3,300,car"), "row 4: track_id is 'X1'; a whole number below 1000000 was expected"),
        (("1,3,300,car", "1000000,3,300,car"), "row 4: track_id is '1000000'; a whole number below 1000000"),
        ((",4.3,2.0", ",,2.0"), "there is no length; only pedestrians and cyclists may lack it"),
        ((",4.3,2.0", ",0,0"), "length and width .* of track 1 were expected to be positive"),
        (("psi_rad,length,width", "psi_rad,length,breadth"), "row 2: there is no width; only pedestrians"),
    ],
)
def test_invalid_tables_are_refused(tmp_path, change, message):
    folder = write_recording(tmp_path)
    path = next(folder.rglob("vehicle_tracks_000.csv"))
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(RecordingError, match=message):
        read(folder)


def test_a_repeated_row_is_named_by_its_file_row_and_id(tmp_path):
    folder = write_recording(tmp_path / "whole")
    path = next(folder.rglob("pedestrian_tracks_000.csv"))
    path.write_text(path.read_text() + path.read_text().splitlines()[2] + "\n")
    with pytest.raises(RecordingError, match=r"pedestrian_tracks_000.csv, row 18: track P2 has frame 1 twice"):
        read(folder)
    folder = write_cases(tmp_path / "cases")
    path = next(folder.rglob("*_train.csv"))
    path.write_text(path.read_text() + path.read_text().splitlines()[1] + "\n")
    with pytest.raises(RecordingError, match=r"_train.csv, row 122: track 1 has frame 1 twice"):
        read(folder)


def test_spaces_after_commas_do_not_matter(tmp_path):
    expected = read(write_cases(tmp_path)).tracks
    path = next(tmp_path.rglob("*_train.csv"))
    path.write_text(path.read_text().replace(",", ", "))
    found = read(tmp_path).tracks
    np.testing.assert_array_equal(found.position, expected.position)
    np.testing.assert_array_equal(found.kind, expected.kind)


def test_headings_in_degrees_are_refused(tmp_path):
    folder = write_cases(tmp_path)
    path = next(folder.rglob("*_train.csv"))
    header, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    for row in cells:
        row[9] = row[9] and str(float(row[9]) + 90)
    path.write_text("\n".join([header, *(",".join(row) for row in cells)]))
    with pytest.raises(RecordingError, match=r"headings differ by .* radians counter-clockwise from x were expected"):
        read(folder)


def test_invalid_folders_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="there is no recording in it or below it"):
        interaction(tmp_path)
    write_recording(tmp_path / "a")
    write_recording(tmp_path / "b", suffix="")
    with pytest.raises(RecordingError, match="has the same name: rename one of the two, or remove a copy"):
        interaction(tmp_path)
    write_map(write_recording(tmp_path / "c"), ".osm")
    (tmp_path / "c" / "copy").mkdir()
    write_map(tmp_path / "c" / "copy", ".osm")
    with pytest.raises(RecordingError, match="is a map of the same scenario: keep one"):
        interaction(tmp_path / "c")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("trials", [60, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("layout", [write_recording, write_cases])
def test_damaged_tables_give_only_recording_errors(tmp_path, trials, layout):
    folder = layout(tmp_path / "interaction", suffix="")
    (source,) = interaction(folder)
    damage(lambda: read(folder), folder, source.files, trials, lambda found, label: check(found, folder, label))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("1009.370,992.770", "1809.370,992.770"), "track 1000001 jumps from"),
        (("-0.9,1.1", "-900,1100"), "velocity .* of track 1000001 .* is it in another unit"),
        (("P1,", "1,"), r"track 1 is in vehicle_tracks_000\.csv too: give it another id"),
    ],
)
def test_errors_of_pedestrians_name_their_table(tmp_path, change, message):
    folder = write_recording(tmp_path)
    path = next(folder.rglob("pedestrian_tracks_000.csv"))
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(RecordingError, match=rf"pedestrian_tracks_000\.csv: {message}"):
        read(folder)


@pytest.mark.parametrize("part", ["train", "val", "obs"])
def test_every_table_of_the_challenge_is_a_recording_whose_map_may_lie_beside_its_folder(tmp_path, part):
    (table,) = write_cases(tmp_path).rglob("*_train.csv")
    table.rename(table.with_name(f"{PLACE}_{part}.csv"))
    (source,) = interaction(table.parent)
    assert (source.name, source.group) == (f"{PLACE}_{part}", PLACE)
    assert source.files[-1] == tmp_path / "maps" / f"{PLACE}.osm"


def test_of_two_maps_the_one_in_degrees_is_read(tmp_path):
    (source,) = interaction(write_map(write_recording(tmp_path), ".osm_xy"))
    assert [path.name for path in source.files if "maps" in path.parts] == [f"{PLACE}.osm"]


def test_a_map_south_of_the_equator_lies_where_its_tracks_do(tmp_path):
    (path,) = write_recording(tmp_path).rglob("*.osm")
    path.write_text(path.read_text().replace("lat='0.00", "lat='-0.00"))
    assert all((np.abs(line) < 2000).all() for line in read(tmp_path).lanes.left)


def test_frames_of_a_case_end_before_those_of_the_next_one(tmp_path):
    """A recording may be of any length."""
    late = ("1,1,100,car", f"1,{CASE},{100 * CASE},car")
    path = next(write_recording(tmp_path / "whole").rglob("vehicle_tracks_000.csv"))
    lines = path.read_text().replace(*late).splitlines()
    path.write_text("\n".join([*lines[:1], *lines[2:], lines[1]]) + "\n")
    assert read(tmp_path / "whole").tracks.frame.max() == CASE
    path = next(write_cases(tmp_path / "cases").rglob("*_train.csv"))
    path.write_text(path.read_text().replace(*late))
    with pytest.raises(RecordingError, match=r"frame_id is 1000; a whole number in 0 \.\. 999 was expected"):
        read(tmp_path / "cases")


def test_a_pedestrian_that_stands_keeps_its_heading_and_a_cyclist_needs_no_size(tmp_path):
    folder = write_recording(tmp_path)
    path = next(folder.rglob("pedestrian_tracks_000.csv"))
    header, *rows = path.read_text().splitlines()
    ways = [("1.0", "0.0"), ("0.0", "-0.2"), ("0.0", "1.0"), ("-0.2", "0.0")]
    place, changed = np.array([900.0, 900.0]), []
    for frame, way in enumerate(ways, 1):
        changed.append(f"P7,{frame},{100 * frame},bicycle,{place[0]},{place[1]},{','.join(way)}")
        place += 0.1 * np.array(way, dtype=float)
    path.write_text("\n".join([header, *rows, *changed]) + "\n")
    recording = read(folder)
    tracks = recording.tracks
    assert KINDS[tracks.kind[-1]] == "bicycle"
    assert tracks.size[-1].tolist() == [1.8, 0.7]
    assert recording.dropped["bicycles without a size, taken as 1.8 x 0.7 m"] == 1
    np.testing.assert_allclose(tracks.heading[tracks.agent == 5], [0.0, 0.0, np.pi / 2, np.pi / 2])


def test_nodes_in_metres_are_bounded_and_degrees_come_first(tmp_path):
    path = tmp_path / "map.osm"
    path.write_text(re.sub(r" x='[^']*'", " x='1e9'", map_text(metres=True), count=1))
    with pytest.raises(RecordingError, match=r"node 1 at \[1000000000\.0, .* was expected in metres, at most 1e\+07 m"):
        read_map(path, ZERO)
    path.write_text(map_text())
    expected = read_map(path, ZERO, zone=31, north=True)
    path.write_text(map_text().replace(" lat=", " x='1' y='2' lat="))
    found = read_map(path, ZERO, zone=31, north=True)
    np.testing.assert_array_equal(np.concatenate(found.left), np.concatenate(expected.left))
