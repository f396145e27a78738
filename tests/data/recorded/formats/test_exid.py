"""exiD folders: all contents are read as written, and errors in them are named."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from data.recorded.formats.exid_files import (
    SETTING,
    drive,
    meta_of,
    read_recording_meta,
    read_tracks,
    read_tracks_meta,
    road,
    write,
)
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded.formats.exid_tables import TRACKS
from epo_lightning.data.recorded.formats.levelx import exid
from epo_lightning.registry import lookup
from epo_lightning.scene import KINDS


def read(folder):
    (source,) = exid(folder)
    return source.read()


@pytest.mark.parametrize("version", ["2.0", "2.1"])
@pytest.mark.parametrize("inner", [False, True])
def test_written_tracks_are_read_back(tmp_path, version, inner):
    tracks = drive()
    write(tmp_path, tracks, version=version)
    (source,) = lookup("format", "exid")(tmp_path / "data" if inner else tmp_path)
    assert (source.name, source.group) == ("07", "2")
    assert all(file.is_file() for file in source.files)
    assert len(source.files) == 4
    recording = source.read()
    table = recording.tracks
    assert (recording.name, recording.group, recording.dropped) == ("07", "2", {})
    assert table.rate == 25.0
    assert table.ids.tolist() == [10, 11, 12]
    assert [KINDS[kind] for kind in table.kind] == ["car", "truck", "van"]
    np.testing.assert_array_equal(table.size, [[4.5, 1.9]] * 3)
    np.testing.assert_array_equal(table.agent, tracks["trackId"] - 10)
    np.testing.assert_array_equal(table.frame, tracks["frame"])
    np.testing.assert_array_equal(table.position, tracks.select("xCenter", "yCenter"))
    np.testing.assert_array_equal(table.velocity, tracks.select("xVelocity", "yVelocity"))
    np.testing.assert_allclose(table.heading, np.deg2rad(tracks["heading"]), atol=1e-12)
    assert recording.lanes.ids.tolist() == [1, 2, 3, 4, 5, 6]
    np.testing.assert_array_equal(recording.lanes.speed_limit, np.full(6, 27.78))


def test_files_may_lie_directly_in_the_folder(tmp_path):
    write(tmp_path)
    for file in (tmp_path / "data").iterdir():
        file.rename(tmp_path / file.name)
    (tmp_path / "data").rmdir()
    assert len(read(tmp_path).tracks) == 36


def test_all_columns_are_read(tmp_path):
    tracks = drive()
    write(tmp_path, tracks.select(reversed(tracks.columns)))
    table = read_tracks(tmp_path / "data" / "07_tracks.csv")
    assert table.columns == list(TRACKS) == tracks.columns
    assert table.schema == dict(TRACKS)
    for name in tracks.columns[:18]:
        assert table[name].to_list() == tracks[name].to_list(), name
    first, second, fourth = table.row(0, named=True), table.row(1, named=True), table.row(3, named=True)
    assert fourth["latLaneCenterOffset"] == [-1.0, 2.75]
    assert fourth["laneWidth"] == [3.75, 3.75]
    assert fourth["laneletId"] == [1, 4]
    assert fourth["leftAlongsideId"] == [11, 12]
    assert fourth["rightAlongsideId"] == [11]
    assert table["laneChange"].to_list() == tracks["laneChange"].cast(pl.Boolean).to_list()
    missing_first = {"laneletId", "latLaneCenterOffset", "lonLaneletPos", "laneletLength", "leftAlongsideId"}
    missing_first |= {"rightAlongsideId", "odrRoadId", "odrLaneId", "leadTHW", "leadTTC", "rearId", "leftLeadId"}
    missing_first |= {"leftRearId", "rightLeadId", "rightRearId"}
    assert {name for name, value in first.items() if value is None} == missing_first
    assert (first["leadDHW"], first["leadDV"], first["leadId"]) == (20.0, -1.0, 11), "-1 m/s is a difference of speeds"
    assert {second[name] for name in ("leadDHW", "leadDV", "leadId")} == {None}
    assert (second["latLaneCenterOffset"], second["odrLaneId"]) == ([-1.0], -1), "-1 is a value in both"
    assert (second["lonLaneletPos"], second["laneletLength"]) == ([4.0], [100.0])
    meta = read_tracks_meta(tmp_path / "data" / "07_tracksMeta.csv")
    assert meta.to_dicts()[1]["class"] == "truck"
    setting = read_recording_meta(tmp_path / "data" / "07_recordingMeta.csv")
    assert setting.row(0, named=True) == SETTING


def test_optional_columns_may_be_absent(tmp_path):
    absent = {"odrRoadId", "odrSectionNo", "odrLaneId"}
    setting = {key: value for key, value in SETTING.items() if key != "exportVersion"}
    write(tmp_path, drive().drop(absent), setting=setting)
    table = read_tracks(tmp_path / "data" / "07_tracks.csv")
    assert set(TRACKS) - set(table.columns) == absent
    assert "exportVersion" not in read_recording_meta(tmp_path / "data" / "07_recordingMeta.csv").columns
    assert len(read(tmp_path).tracks) == 36


def test_rows_may_be_sorted_by_frame(tmp_path):
    write(tmp_path / "a")
    write(tmp_path / "b", drive().sort("frame", maintain_order=True))
    ours, sorted_ = read(tmp_path / "a").tracks, read(tmp_path / "b").tracks
    for name in ("agent", "frame", "position", "heading"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(sorted_, name))


def test_quotes_and_other_line_ends_are_read(tmp_path):
    write(tmp_path)
    for file in (tmp_path / "data").iterdir():
        head, *rows = file.read_text().splitlines()
        head = ",".join(f'"{name}"' for name in head.split(","))
        file.write_text("\ufeff" + "\r\n".join([head, *rows]), encoding="utf-8")
    meta = tmp_path / "data" / "07_tracksMeta.csv"
    meta.write_text(meta.read_text().replace("car", '"car"').replace("1.9", '"1.9"'))
    recording = read(tmp_path)
    assert len(recording.tracks) == 36
    assert [KINDS[kind] for kind in recording.tracks.kind] == ["car", "truck", "van"]


def test_heading_is_unwrapped_per_track(tmp_path):
    around = drive().with_columns(heading=(pl.col("heading") + 720 - 3.5) % 360)
    assert (np.abs(np.diff(around["heading"])) > 300).any()
    write(tmp_path, around)
    table = read(tmp_path).tracks
    inside = np.diff(table.agent) == 0
    assert np.abs(np.diff(table.heading)[inside]).max() < 0.1
    np.testing.assert_allclose(np.exp(1j * table.heading), np.exp(1j * np.deg2rad(around["heading"].to_numpy())))
    first = np.flatnonzero(np.diff(table.agent, prepend=-1))
    np.testing.assert_allclose(table.heading[first], np.deg2rad(around["heading"].to_numpy())[first])


def test_left_out_content_is_counted(tmp_path):
    tracks = drive()
    meta = meta_of(tracks, ("motorcycle", "Zeppelin", "car"))
    meta = meta.with_columns(
        pl.when(pl.col("class") == "motorcycle").then(0.0).otherwise(pl.col(c)).alias(c) for c in ("width", "length")
    )
    osm = road()
    osm.lanelet(1, 2, subtype="walkway")
    write(tmp_path, tracks.filter(pl.col("frame") != 3), meta, SETTING | {"speedLimit": -1.0}, osm)
    recording = read(tmp_path)
    assert [KINDS[kind] for kind in recording.tracks.kind] == ["motorcycle", "other", "car"]
    np.testing.assert_array_equal(recording.tracks.size, [[2.2, 0.9], [4.5, 1.9], [4.5, 1.9]])
    assert recording.dropped == {
        "agents of a class that is unknown, taken as 'other'": 1,
        "motorcycles without a size, taken as 2.2 x 0.9 m": 1,
        "frames missing inside tracks": 1,
        "lanelets that are not for vehicles": 1,
    }
    assert np.isnan(recording.lanes.speed_limit).all()


def test_frames_missing_inside_tracks_may_be_counted_in_the_metadata_or_not(tmp_path):
    tracks = drive()
    gaps = tracks.filter((pl.col("trackId") != 10) | ~pl.col("frame").is_in([3, 4, 7]))
    for name, meta in (("span", meta_of(tracks)), ("rows", meta_of(gaps))):
        write(tmp_path / name, gaps, meta)
        assert read(tmp_path / name).dropped == {"frames missing inside tracks": 3}


def test_tracks_longer_than_the_recording_are_refused(tmp_path):
    """Frames end 1.8 s after a duration of one second; tracks may be a second longer than stated."""
    write(tmp_path / "long", drive(frames=60), setting=SETTING | {"duration": 1.0})
    with pytest.raises(
        RecordingError, match=r"frame 69 lies after the duration of 1\.0 s at the frameRate of 25\.0 Hz"
    ):
        read(tmp_path / "long")
    write(tmp_path / "short", drive(frames=40), setting=SETTING | {"duration": 1.0})
    assert read(tmp_path / "short").tracks.frame.max() == 49


def test_a_recording_of_exid_states_its_speed_limit(tmp_path):
    write(tmp_path, setting={key: value for key, value in SETTING.items() if key != "speedLimit"})
    with pytest.raises(RecordingError, match=r"07_recordingMeta\.csv: there is no column speedLimit"):
        exid(tmp_path)


def test_every_recording_is_listed_with_its_own_map(tmp_path):
    write(tmp_path)
    data = tmp_path / "data"
    for number, location in ((12, 22), (100, 2)):
        for file in sorted(data.glob("07_*")):
            table = pl.read_csv(file, infer_schema=False).with_columns(recordingId=pl.lit(str(number)))
            if "locationId" in table.columns:
                table = table.with_columns(locationId=pl.lit(str(location)))
            table.write_csv(data / file.name.replace("07", str(number)))
    (tmp_path / "maps/lanelet2/22_x").mkdir()
    (tmp_path / "maps/lanelet2/22_x/location22.osm").write_text(str(road()))
    sources = exid(tmp_path)
    assert [(source.name, source.group) for source in sources] == [("07", "2"), ("12", "22"), ("100", "2")]
    assert [source.files[-1].name for source in sources] == ["location2.osm", "location22.osm", "location2.osm"]
    assert sources[2].read().name == "100"


def at(row, **values):
    """A change of some values of one row of the tracks."""
    return lambda tracks: (
        tracks.with_row_index()
        .with_columns(
            pl.when(pl.col("index") == row).then(pl.lit(value)).otherwise(pl.col(name)).alias(name)
            for name, value in values.items()
        )
        .drop("index")
    )


def scaled(factor, *names):
    return lambda tracks: tracks.with_columns(pl.col(name) * factor for name in names)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop("xCenter"), r"07_tracks.csv: there is no column xCenter$"),
        (lambda t: t.rename({"yCenter": "yCentre"}), r"there is no column yCenter; is it 'yCentre'\?"),
        (
            lambda t: t.with_columns(pl.col("xCenter").cast(pl.String)).pipe(at(4, xCenter="abc")),
            r"07_tracks.csv, row 6: xCenter is 'abc'; a number",
        ),
        (
            lambda t: t.with_columns(pl.col("frame").cast(pl.String)).pipe(at(4, frame="4.5")),
            r"row 6: frame is '4.5'; a whole number",
        ),
        (at(4, xCenter=None), r"row 6: there is no xCenter"),
        (at(4, xCenter=float("nan")), r"position \[nan, .* of track 10 in frame 4 .* finite"),
        (at(4, xCenter=float("inf")), r"position \[inf, .* of track 10 in frame 4 .* finite"),
        (at(4, xCenter=1e12), r"at most 1e\+07 m: is it in another unit"),
        (at(4, xVelocity=500.0), r"velocity \[500.0, .* is it in another unit"),
        (at(4, xCenter=500.0), r"track 10 jumps from .* after its frame 3"),
        (at(4, heading=1e9), r"row 6: heading is 1000000000.0; degrees"),
        (at(4, heading=float("nan")), r"row 6: heading is nan; degrees"),
        (at(4, heading=400.0), r"row 6: heading is 400.0; degrees"),
        (at(4, frame=-1), r"row 6: frame -1 was expected in 0"),
        (at(4, frame=2), r"frame 2 of track 10 comes after its frame 3: frames of a track must increase"),
        (at(4, frame=3), r"track 10 has frame 3 twice"),
        (at(4, trackId=99), r"row 6: trackId 99 is not in 07_tracksMeta.csv"),
        (at(4, recordingId=8), r"row 6: recordingId is not 7 as in 07_recordingMeta.csv: .* mixed up"),
        (
            lambda t: t.filter(pl.col("trackId") != 11),
            r"trackId 11 of 07_tracksMeta.csv is not in it \(1 of 3 are not\): was the file cut off",
        ),
        (
            lambda t: t.head(-2),
            r"track 12 has 10 frames from 10 to 19, but 07_tracksMeta.csv promises 12 from 10 to 21",
        ),
        (lambda t: t.tail(-2), r"track 10 has 10 frames from 2 to 11, but"),
        (
            lambda t: t.with_columns(
                trackId=pl.when((pl.col("trackId") == 11) & (pl.col("frame") < 7)).then(10).otherwise("trackId")
            ),
            "frame 5 of track 10 comes after its frame 11: frames of a track must increase",
        ),
        (lambda t: t.head(0), r"there are no rows in it"),
        (scaled(3.6, "xVelocity", "yVelocity"), r"positions move 0.278 times as fast as xVelocity"),
        (scaled(0.3048, "xCenter", "yCenter"), r"positions move 0.305 times as fast"),
        (lambda t: t.with_columns(pl.col("heading") + 90), r"headings differ by 90 degrees"),
        (
            lambda t: t.with_columns(pl.col("yCenter") + 50),
            r"location2.osm: 100% of the positions of 07_tracks.csv are more than 10 m",
        ),
        (
            lambda t: t.with_columns(pl.col("yCenter") + 50 * (pl.col("trackId") > 10)),
            r"location2.osm: 67% of the positions of 07_tracks.csv are more than 10 m",
        ),
    ],
)
def test_invalid_tracks_are_refused(tmp_path, change, message):
    tracks = drive()
    write(tmp_path, change(tracks), meta_of(tracks))
    with pytest.raises(RecordingError, match=message):
        read(tmp_path)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"frameRate": 10.0}, r"frame 21 lies after the duration of 0.4 s|positions move 0.4 times as fast"),
        (
            {"duration": 0.2, "frameRate": 10.0},
            r"frame 21 lies after the duration of 0.2 s at the frameRate of 10.0 Hz",
        ),
        ({"frameRate": 0.0}, "a frame rate of 0.0 Hz"),
        ({"frameRate": "fast"}, r"07_recordingMeta.csv, row 2: frameRate is 'fast'; a number was expected"),
        ({"frameRate": None}, r"row 2: there is no frameRate"),
        ({"speedLimit": 100.0}, r"row 2: speedLimit is 100.0; metres per second or -1 .*km/h"),
        ({"locationId": "../../etc"}, r"row 2: locationId is '../../etc'; a whole number was expected"),
        ({"locationId": -2}, "locationId is -2"),
        ({"locationId": 3}, r"there is no map of its locationId 3: maps/lanelet2/3_\*/location3.osm or"),
        ({"recordingId": 8}, r"07_tracks.csv, row 2: recordingId is not 8"),
        ({"xUtmOrigin": float("inf")}, r"xUtmOrigin is inf; a finite number"),
        ({"xUtmOrigin": SETTING["xUtmOrigin"] + 3000.0}, r"location2.osm: 100% of the positions"),
    ],
)
def test_invalid_settings_are_refused(tmp_path, setting, message):
    write(tmp_path, setting=SETTING | setting)
    with pytest.raises(RecordingError, match=message):
        read(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: pl.concat([m, m.head(1)]), r"07_tracksMeta.csv: trackId 10 has two rows"),
        (lambda m: m.head(2), r"07_tracks.csv, row 26: trackId 12 is not in 07_tracksMeta.csv"),
        (lambda m: m.with_columns(numFrames=pl.col("numFrames") + 1), r"promises 13 from 0 to 11"),
        (lambda m: m.with_columns(length=pl.lit(0.0)), r"length and width \[0.0, 1.9\] of track 10"),
        (lambda m: m.with_columns(length=pl.lit(450.0)), r"length and width .* are they in another unit"),
        (lambda m: m.with_columns(recordingId=pl.lit(6)), r"07_tracksMeta.csv, row 2: recordingId is not 7"),
    ],
)
def test_invalid_metadata_is_refused(tmp_path, change, message):
    write(tmp_path, meta=change(meta_of(drive())))
    with pytest.raises(RecordingError, match=message):
        read(tmp_path)


@pytest.mark.parametrize("name", ["07_tracks.csv", "07_tracksMeta.csv", "07_recordingMeta.csv"])
def test_missing_empty_and_truncated_files_are_refused(tmp_path, name):
    write(tmp_path)
    file = tmp_path / "data" / name
    whole = file.read_bytes()
    file.write_bytes(b"")
    with pytest.raises(RecordingError, match=rf"{name}: there are no rows in it"):
        read(tmp_path)
    row = whole.count(b"\n")
    file.write_bytes(whole[: whole.rindex(b",")])
    with pytest.raises(
        RecordingError, match=rf"{name}, row {row}: \d+ fields where the header has \d+: was the file cut off"
    ):
        read(tmp_path)
    head, _, body = whole.partition(b"\n")
    file.write_bytes(b"recordingId," + head + b"\n" + b"7," + body.replace(b"\n", b"\n7,").removesuffix(b"7,"))
    with pytest.raises(RecordingError, match="there are 2 columns called recordingId: keep one"):
        read(tmp_path)
    file.unlink()
    with pytest.raises(RecordingError, match=rf"{name}: there is no such file, but others of recording 07"):
        exid(tmp_path)


def test_folders_without_recordings_or_with_two_maps_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="there is no such folder"):
        exid(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"there is no recording in it: files called NN_tracks.csv"):
        exid(tmp_path)
    write(tmp_path)
    (tmp_path / "maps/lanelet2/2_copy.osm").write_text(str(road()))
    (tmp_path / "maps/lanelet2/2_aachen_brand.png").touch()
    (tmp_path / "maps/lanelet2/2_folder.osm").mkdir()
    assert exid(tmp_path)[0].files[-1].name == "location2.osm"
    (tmp_path / "maps/lanelet2/2_aachen_brand/location2.osm").rename(tmp_path / "maps/lanelet2/2_other.osm")
    with pytest.raises(RecordingError, match=r"several maps of location 2 \(2_copy.osm, 2_other.osm\): keep one"):
        exid(tmp_path)
