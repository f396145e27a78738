"""Vehicle-crowd clips (DUT, CITR): axes, kinds, headings of standing pedestrians, and bad files."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from data.recorded.formats.crowd_files import RATE, pedestrians, vehicles, write
from data.recorded.formats.exid_files import shared
from data.recorded.formats.fuzz import damage
from epo_lightning.data.recorded.formats.crowd import VEHICLES, crowd
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tracks import Recording, RecordingError
from epo_lightning.registry import ConfigError, lookup
from epo_lightning.scene import KINDS


def read(folder: Path, **options: float) -> Recording:
    (source,) = crowd(folder, **options)
    return source.read()


def rows_of(folder: Path, name: str, label: str) -> list[dict[str, str]]:
    """The rows of a table as texts, by an independent reader."""
    path = folder / f"{name}_traj_{label}_filtered.csv"
    if not path.exists():
        return []
    with path.open(newline="", encoding="latin-1") as file:
        return list(csv.DictReader(file, quoting=csv.QUOTE_NONE))


def check(recording: Recording, folder: Path, name: str, label: str = "") -> None:
    """A recording holds exactly the rows of its tables: y up, angles counter-clockwise."""
    tracks, seen = recording.tracks, 0
    for kind, offset, columns in (("ped", 0, ("vx_est", "vy_est")), ("veh", VEHICLES, ("psi_est", "vel_est"))):
        rows = rows_of(folder, name, kind)
        names = ("id", "frame", "x_est", "y_est", *columns)
        table = np.array([[float(row[column]) for column in names] for row in rows]).reshape(len(rows), 6)
        table = table[np.lexsort((table[:, 1], table[:, 0]))]
        mine = (tracks.ids[tracks.agent] >= VEHICLES) == (kind == "veh")
        seen += len(rows)
        assert [KINDS[each] for each in np.unique(tracks.kind[tracks.agent[mine]])] == (
            [] if not rows else ["car"] if kind == "veh" else ["pedestrian"]
        ), label
        np.testing.assert_array_equal(tracks.ids[tracks.agent[mine]], table[:, 0] + offset, label)
        np.testing.assert_array_equal(tracks.frame[mine], table[:, 1], label)
        np.testing.assert_array_equal(tracks.position[mine], table[:, 2:4] * (1, -1), label)
        if kind == "ped":
            np.testing.assert_array_equal(tracks.velocity[mine], table[:, 4:] * (1, -1), label)
        else:
            turns = (tracks.heading[mine] + table[:, 4]) / (2 * np.pi)
            np.testing.assert_allclose(turns, np.round(turns), atol=1e-6, err_msg=label)
            np.testing.assert_allclose(tracks.speed[mine], table[:, 5], rtol=1e-6, atol=1e-9, err_msg=label)
    assert len(tracks) == seen, label


def test_crowd_is_a_registered_format():
    assert lookup("format", "crowd") is crowd


def test_both_tables_of_a_clip_become_one_recording(tmp_path):
    (source,) = crowd(write(tmp_path))
    assert (source.name, source.group, len(source.files)) == ("square_01", "square", 2)
    recording = source.read()
    tracks = recording.tracks
    assert (recording.name, recording.group, recording.lanes, recording.dropped) == ("square_01", "square", None, {})
    assert tracks.rate == RATE
    assert tracks.ids.tolist() == [0, 1, 2, 3, VEHICLES, VEHICLES + 1]
    assert [KINDS[kind] for kind in tracks.kind] == ["pedestrian"] * 4 + ["car"] * 2
    assert tracks.size.tolist() == [[0.3, 0.3]] * 4 + [[4.5, 1.8]] * 2
    check(recording, tmp_path, "square_01")


def test_headings_turn_with_the_motion(tmp_path):
    """In image axes the vehicle turns clockwise; with y up, positions and headings turn the other way."""
    tracks = read(write(tmp_path)).tracks
    car = tracks.agent == 4
    moved = np.diff(tracks.position[car], axis=0)
    course = np.arctan2(moved[:, 1], moved[:, 0])
    middle = 0.5 * (tracks.heading[car][1:] + tracks.heading[car][:-1])
    np.testing.assert_allclose(np.cos(course - middle), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(tracks.heading[car]), -0.3 / RATE)
    walking = (tracks.agent > 0) & (tracks.agent < 4)
    course = np.arctan2(tracks.velocity[walking, 1], tracks.velocity[walking, 0])
    np.testing.assert_allclose(np.cos(tracks.heading[walking] - course), 1.0)


def test_a_pedestrian_that_stands_keeps_its_heading(tmp_path):
    """The direction of a velocity of some centimetres per second is noise; later directions would be the future."""
    rows = [(0.01, 0.02), (1.0, 0.0), (0.0, -0.05), (0.0, 1.0), (-0.1, 0.0)]
    places = np.cumsum(rows, axis=0) / RATE
    text = "id,frame,label,x_est,y_est,vx_est,vy_est\n" + "".join(
        f"5,{frame},ped,{x_at},{y_at},{x},{y}\n"
        for frame, ((x, y), (x_at, y_at)) in enumerate(zip(rows, places, strict=True))
    )
    tracks = read(write(tmp_path, ped=text, veh="")).tracks
    expected = [np.arctan2(-0.02, 0.01), 0.0, 0.0, -np.pi / 2, -np.pi / 2]
    np.testing.assert_allclose(tracks.heading, expected)


def test_the_order_of_rows_does_not_matter(tmp_path):
    expected = read(write(tmp_path / "a")).tracks
    header, *rows = pedestrians().splitlines()
    found = read(write(tmp_path / "b", ped="\r\n".join([header, *sorted(rows, reverse=True)]) + "\r\n")).tracks
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value)


@pytest.mark.parametrize(("left_out", "said"), [("veh", "vehicles"), ("ped", "pedestrians")])
def test_a_clip_without_one_of_its_tables_is_read_and_counted(tmp_path, left_out, said):
    recording = read(write(tmp_path, **{left_out: ""}))
    assert recording.dropped == {f"clips without a table of {said}": 1}
    check(recording, tmp_path, "square_01")


def test_the_frame_rate_is_an_option(tmp_path):
    assert read(write(tmp_path), rate=24).tracks.rate == 24.0
    with pytest.raises(RecordingError, match=r"1\.67 times as fast .* at 40 frames per second \(data\.options\.rate\)"):
        read(tmp_path, rate=40)
    for rate in (0.0, 0.5, "24", None, True, float("nan")):
        with pytest.raises(ConfigError, match=r"data\.options\.rate must be frames per second"):
            crowd(tmp_path, rate=rate)


def data(folder: Path, **options) -> RecordedData:
    return RecordedData(
        dataset="crowd",
        format="crowd",
        folder=str(folder),
        map=False,
        windows={"dt": 0.4, "lane_change": False},
        root=str(folder / "cache"),
        options=options,
    )


def test_options_decide_on_the_data_set_and_unknown_ones_are_refused(tmp_path):
    for number in range(3):
        write(tmp_path, f"place{number}_01")
    digests = {data(tmp_path).digest, data(tmp_path, rate=24.0).digest}
    assert len(digests) == 2
    assert "options" not in data(tmp_path).config, "data sets without options keep their names"
    with pytest.raises(ConfigError, match=r"unknown key data.options.fps for format 'crowd': .*known: rate"):
        data(tmp_path, fps=24.0)


@pytest.mark.parametrize(
    ("ped", "veh", "message"),
    [
        (b"", None, "ped_filtered.csv: there are no rows in it"),
        ("id,frame,label,x_est,y_est,vx_est,vy_est\n", None, "there are no rows in it"),
        (pedestrians().replace("vy_est", "vy_est2"), None, "there is no column vy_est; is it 'vy_est2'"),
        (pedestrians().replace("1,3,ped", "1,3.5,ped"), None, "row 11: frame is '3.5'; a whole number was expected"),
        (pedestrians().replace("1,3,ped", "1,3,veh"), None, "row 11: label is 'veh'; 'ped' was expected in this file"),
        (pedestrians().replace("1,3,ped", "-1,3,ped"), None, "row 11: id is -1; 0 .. 999999 was expected"),
        (pedestrians().replace("1,3,ped", "1000000,3,ped"), None, "row 11: id is 1000000; 0 .. 999999 was expected"),
        (pedestrians().replace("1,3,ped", "1,-3,ped"), None, "row 11: frame -3 was expected in 0"),
        (pedestrians().replace("1,3,ped", "1,4,ped"), None, "track 1 has frame 4 twice"),
        (None, vehicles().replace("30.0", "inf", 1), r"veh_filtered.csv, row 3: x_est is inf; a finite number"),
        (None, vehicles(speed=90.0), "jumps from .* agents stay below 40 m/s"),
        (None, vehicles(speed=90.0, frames=1), None),
        (pedestrians(2) + pedestrians(2).split("\n", 1)[1], None, "track 0 has frame 1 twice"),
    ],
)
def test_invalid_files_are_refused(tmp_path, ped, veh, message):
    write(tmp_path, ped=ped or (None if ped is None else "\n"), veh=veh)
    if message is None:
        assert len(read(tmp_path).tracks)
        return
    with pytest.raises(RecordingError, match=message):
        read(tmp_path)


def test_invalid_folders_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"there is no clip in it or below it"):
        crowd(tmp_path)
    write(tmp_path / "a")
    write(tmp_path / "b")
    with pytest.raises(RecordingError, match="has the same name: rename one"):
        crowd(tmp_path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("trials", [60, pytest.param(2000, marks=pytest.mark.slow)])
def test_damaged_tables_give_only_recording_errors(tmp_path, trials):
    folder = write(tmp_path / "crowd")
    (source,) = crowd(folder)
    damage(
        lambda: read(folder),
        folder,
        source.files,
        trials,
        lambda found, label: check(found, folder, "square_01", label),
    )


def test_the_real_clips_are_read():
    folder = shared("data/dut")
    sources = crowd(folder)
    assert {source.group for source in sources} == {"intersection", "roundabout"}
    assert len(sources) == 14
    agents = 0
    for source in sources:
        recording = source.read()
        assert not recording.dropped
        check(recording, folder, source.name)
        agents += len(recording.tracks.ids)
    assert agents == 989


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (gzip.compress, r"it is compressed: unpack it"),
        (lambda text: text.decode().encode("utf-16"), r"it is text in UTF-16: save it as UTF-8"),
        (lambda text: text.replace(b",", b";"), r"its columns are separated by semicolons: save it with commas"),
        (lambda text: text.replace(b",", b"\t"), r"its columns are separated by tabs: save it with commas"),
        (
            lambda text: text.replace(b"\n", b"\r"),
            r"its lines end with carriage returns alone: save it with line feeds",
        ),
        (lambda text: text.replace(b"x_est", b"X_EST", 1), r"there is no column x_est; is it 'X_EST'\?"),
    ],
)
def test_tables_that_are_saved_in_another_way_are_named_as_such(tmp_path, change, said):
    (source,) = crowd(write(tmp_path))
    table = next(file for file in source.files if "_ped_" in file.name)
    table.write_bytes(change(table.read_bytes()))
    with pytest.raises(RecordingError, match=rf"{table.name}: {said}"):
        source.read()


def crowded(folder: Path, change) -> Path:
    """A clip with many pedestrians and two cars, after a change of the text of the table of cars."""
    table = vehicles(frames=60)
    changed = change(table)
    assert changed != table
    return write(folder, ped=pedestrians(30, 60), veh=changed)


def scaled(text: str, columns: dict[str, float]) -> str:
    """A table with some columns multiplied by a number."""
    header, *rows = [line.split(",") for line in text.splitlines()]
    factors = [columns.get(name, 1.0) for name in header]
    found = [
        [cell if factor == 1.0 else repr(factor * float(cell)) for cell, factor in zip(row, factors, strict=True)]
        for row in rows
    ]
    return "\n".join(",".join(row) for row in [header, *found]) + "\n"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: scaled(text, {"x_est": 1e-3, "y_est": 1e-3}), "positions move 0.001 times as fast as psi_est"),
        (lambda text: scaled(text, {"vel_est": 3.6}), "positions move 0.278 times as fast as psi_est and vel_est say"),
        (lambda text: scaled(text, {"psi_est": 180 / np.pi}), "positions move in another direction than psi_est and"),
        (lambda text: scaled(text, {"vel_est": -1.0}), "positions move in another direction than .* say, by 180 deg"),
        (lambda text: text.replace("x_est,y_est", "y_est,x_est"), "positions move in another direction than psi_est"),
    ],
)
def test_a_mistake_in_the_table_of_cars_is_not_hidden_by_many_pedestrians(tmp_path, change, said):
    folder = crowded(tmp_path, change)
    with pytest.raises(RecordingError, match=rf"^{folder}/square_01_traj_veh_filtered.csv: {said}"):
        read(folder)


def test_errors_of_tracks_name_the_file_and_the_id_in_it(tmp_path):
    def repeated(text: str) -> str:
        return text + text.splitlines()[-1] + "\n"

    folder = crowded(tmp_path / "cars", repeated)
    with pytest.raises(RecordingError, match=r"square_01_traj_veh_filtered.csv: track 1 has frame 62 twice"):
        read(folder)


def test_speeds_of_cars_may_lag_behind_their_positions(tmp_path):
    """In a median of cars up to a factor of two, of pedestrians up to one of 1.25."""
    folder = crowded(tmp_path / "cars", lambda text: scaled(text, {"vel_est": 0.55}))
    assert read(folder).tracks.speed[-1] == 0.0
    walking = scaled(pedestrians(), {"vx_est": 0.7, "vy_est": 0.7})
    with pytest.raises(RecordingError, match=r"positions move 1\.43 times as fast as vx_est and vy_est say"):
        read(write(tmp_path / "walks", ped=walking))


def test_only_the_number_at_the_end_of_a_name_is_left_out_of_the_place(tmp_path):
    for name in ("north_square_01", "north_road_02"):
        write(tmp_path, name)
    assert [source.group for source in crowd(tmp_path)] == ["north_road", "north_square"]
