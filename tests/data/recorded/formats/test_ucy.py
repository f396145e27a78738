"""UCY pedestrians: the columns, the time step, headings of standing pedestrians, and bad files."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from epo_lightning.data.recorded.clock import stretches
from epo_lightning.data.recorded.formats.ucy import ucy
from epo_lightning.data.recorded.tracks import RecordingError
from epo_lightning.registry import ConfigError, lookup
from epo_lightning.scene import KINDS

SHARED = Path(os.environ.get("EPO_SHARED", "../shared")) / "data/ucy"
ROWS = """
   1  7   0.0 0.0 5.0   1.0 0.0  0.5
   11 7   0.4 0.0 5.2   1.0 0.0  0.5
   21 7   0.8 0.0 5.4   0.0 0.0  0.0
   11 3  -1.0 0.0 2.0   0.0 0.0  0.0
   21 3  -1.0 0.0 2.0   0.0 0.0 -1.0
   31 5   9.0 0.0 9.0   0.0 0.0  0.0
"""


def write(folder: Path, content: str | bytes) -> Path:
    (folder / "square").mkdir(parents=True, exist_ok=True)
    path = folder / "square/obsmat.txt"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(folder: Path, content: str | bytes = ROWS):
    path = write(folder, content)
    (source,) = ucy(folder)
    assert (source.name, source.group, source.files) == ("square", "square", (path,))
    return source.read()


def test_ucy_is_a_registered_format():
    assert lookup("format", "ucy") is ucy


def test_columns_are_read_as_tracks(tmp_path):
    recording = read(tmp_path)
    tracks = recording.tracks
    assert (recording.name, recording.group, recording.lanes) == ("square", "square", None)
    assert not recording.dropped
    assert tracks.rate == 2.5
    assert tracks.ids.tolist() == [3, 5, 7]
    assert tracks.agent.tolist() == [0, 0, 1, 2, 2, 2]
    assert tracks.frame.tolist() == [1, 2, 3, 0, 1, 2]
    assert tracks.position[3:].tolist() == [[0.0, 5.0], [0.4, 5.2], [0.8, 5.4]]
    assert tracks.velocity[1].tolist() == [0.0, -1.0]
    assert tracks.size.tolist() == [[0.5, 0.5]] * 3
    assert [KINDS[kind] for kind in tracks.kind] == ["pedestrian"] * 3
    # A pedestrian that stops keeps its heading; one that starts has none before, nor has one that never walks.
    walked = np.arctan2(0.5, 1.0)
    np.testing.assert_allclose(tracks.heading, [0.0, -np.pi / 2, 0.0, walked, walked, walked])


def test_the_order_of_rows_does_not_matter(tmp_path):
    expected = read(tmp_path).tracks
    shuffled = read(tmp_path, "\r\n".join(sorted(ROWS.splitlines(), reverse=True))).tracks
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(shuffled, name), value)


def test_frames_six_apart_give_the_annotation_rate(tmp_path):
    tracks = read(tmp_path, "6 1 0 0 0 1 0 0\n12 1 1 0 0 1 0 0\n24 1 3 0 0 1 0 0\n30 1 4 0 0 1 0 0").tracks
    assert tracks.rate == pytest.approx(25 / 6)
    assert tracks.frame.tolist() == [0, 1, 3, 4]


def walk(rate: float, step: int, frames: list[int], speed: float = 1.2, trust: float = 1.0) -> str:
    """Two pedestrians that walk straight on, annotated in some frames of a video; velocities are ``trust`` times the true
    ones."""
    rows = [
        f"{frame} {id} {speed * frame / rate:.6f} 0 {id} {trust * speed:.6f} 0 0" for frame in frames for id in (1, 2)
    ]
    return "\n".join(rows)


@pytest.mark.parametrize(
    ("rate", "step", "trust"), [(25.0, 10, 1.0), (15.0, 6, 1.0), (15.0, 6, 0.947), (30.0, 12, 1.05), (50.0, 20, 1.0)]
)
def test_the_frame_rate_of_the_video_follows_from_displacements_and_velocities(tmp_path, rate, step, trust):
    """ETH's two recordings have 15 and 25 Hz. Velocities are estimates, so they may differ by some percent."""
    tracks = read(tmp_path, walk(rate, step, list(range(780, 780 + 20 * step, step)), trust=trust)).tracks
    assert tracks.rate == pytest.approx(2.5)


def test_an_unusual_frame_rate_is_refused_unless_it_is_set(tmp_path):
    write(tmp_path, walk(41.0, 10, list(range(0, 200, 10))))
    with pytest.raises(RecordingError, match=r"agree at 41 video frames per second.* data\.options\.video_rate"):
        ucy(tmp_path)[0].read()
    assert ucy(tmp_path, video_rate=41)[0].read().tracks.rate == pytest.approx(4.1)
    for rate in ("25", 0.0, float("nan"), False):
        with pytest.raises(ConfigError, match=r"data\.options\.video_rate must be frames per second"):
            ucy(tmp_path, video_rate=rate)


def test_shifts_of_the_annotation_cut_tracks_and_are_counted(tmp_path):
    """No two steps of a track have different lengths: a shift leaves a gap, and what follows is a new stretch."""
    frames = [*range(780, 840, 6), *range(837, 900, 6), *range(904, 960, 6)]
    recording = read(tmp_path, walk(15.0, 6, frames))
    tracks = recording.tracks
    assert recording.dropped == {"shifts of the annotated frames, where tracks are cut": 2}
    assert len(tracks) == 2 * len(frames)
    for agent in (0, 1):
        mine = tracks.agent == agent
        steps = np.diff(tracks.frame[mine])
        assert sorted(set(steps.tolist())) == [1, 2]
        np.testing.assert_allclose(np.diff(tracks.position[mine, 0])[steps == 1], 1.2 * 0.4, atol=1e-5)
    clock, dropped = stretches(tracks, 0.4, None, 2)
    assert dropped["gaps in tracks"] == 4
    assert (clock.count >= 10).all()


def test_rows_between_the_annotated_frames_are_left_out_and_counted(tmp_path):
    frames = list(range(1, 201, 10))
    content = walk(25.0, 10, frames)
    expected = read(tmp_path, content).tracks
    recording = read(tmp_path, content + "\n54 1 0 0 0 0 0 0\n58 2 0 0 0 0 0 0\n133 1 0 0 0 0 0 0")
    assert recording.dropped == {"rows between the annotated frames": 3}
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(recording.tracks, name), value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "the file is empty; rows of frame, pedestrian, x"),
        ("\n  \n", "the file is empty"),
        (b"\xff\xfe\x00", "the file is no text .*fetch it again"),
        (ROWS.replace("9.0", "nine"), "row 7: x is 'nine'; a finite number was expected"),
        (ROWS + "31 5 9.0", "row 8: there are 3 columns; frame, pedestrian, x, z, y, vx, vz, vy were expected"),
        (ROWS.replace("9.0", "1_000"), "row 7: x is '1_000'"),
        (ROWS.replace("9.0", "nan"), "row 7: x is 'nan'; a finite number was expected"),
        (ROWS.replace("31 5", "31.5 5"), "row 7: frame is '31.5'; a whole number"),
        (ROWS.replace("31 5", "31 1e12"), r"row 7: pedestrian is '1e12'; a whole number up to 1e\+09 was expected"),
        (ROWS.replace("31 5", "21 7"), "track 7 has frame 2 twice: is its id that of two agents"),
        (ROWS + ROWS, "track 3 has frame 1 twice: is its id that of two agents"),
        (ROWS.replace("9.0", "9e9"), r"position \[9000000000.0, 9000000000.0\] of track 5 .* another unit"),
        (ROWS.replace("-1.0", "-999"), "velocity"),
        ("1 1 0 0 0 0 0 0\n1 2 0 0 0 0 0 0", "all rows are of one frame"),
        ("0 1 0 0 0 0 0 0\n100 1 0 0 0 0 0 0", "a frame rate of 0.25 Hz"),
        ("0 1 0 5 0 1 .5 0\n10 1 .4 5.2 0 1 .5 0", "y is 0 in all rows, and z is not the same: z is up.* are y and z"),
        (
            "0 1 0 0 5 1 .5 0\n10 1 .4 0 5.2 1 .4 0",
            "vy is 0 in all rows, and vz is not the same.* are vy and vz exchanged",
        ),
    ],
)
def test_invalid_files_are_refused(tmp_path, content, message):
    with warnings.catch_warnings(), pytest.raises(RecordingError, match=f"obsmat.txt.*{message}"):
        warnings.simplefilter("error")
        read(tmp_path, content)


def test_invalid_folders_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"there is no obsmat.txt in this folder"):
        ucy(tmp_path)
    write(tmp_path / "a", ROWS)
    write(tmp_path / "b", ROWS)
    with pytest.raises(RecordingError, match="a folder of the same name: rename one"):
        ucy(tmp_path)


def test_a_byte_order_mark_is_no_number(tmp_path):
    expected = read(tmp_path).tracks
    marked = read(tmp_path, b"\xef\xbb\xbf" + ROWS.lstrip("\n").encode()).tracks
    np.testing.assert_array_equal(marked.position, expected.position)


def test_links_are_recordings_of_their_own_folder_and_those_to_nowhere_are_refused(tmp_path):
    target = write(tmp_path / "store", ROWS)
    home = tmp_path / "home"
    for name, to in (("linked", target), ("nowhere", tmp_path / "none"), ("loop", Path("obsmat.txt"))):
        (home / name).mkdir(parents=True)
        (home / name / "obsmat.txt").symlink_to(to)
    (home / "folder" / "obsmat.txt").mkdir(parents=True)
    sources = {source.name: source for source in ucy(home)}
    assert list(sources) == ["linked", "loop", "nowhere"]
    assert len(sources["linked"].read().tracks) == 6
    for name in ("loop", "nowhere"):
        with pytest.raises(RecordingError, match=f"{name}/obsmat.txt: the file cannot be read"):
            sources[name].read()


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"no recordings of UCY in {SHARED}")
def test_the_real_recordings_are_read():
    recordings = {source.name: source.read() for source in ucy(SHARED)}
    counts = {name: (len(each.tracks), len(each.tracks.ids)) for name, each in recordings.items()}
    assert counts == {"zara01": (5024, 148), "zara02": (9537, 204)}
    for recording in recordings.values():
        tracks = recording.tracks
        assert tracks.rate == 2.5
        same = np.diff(tracks.agent) == 0
        assert (np.diff(tracks.frame)[same] == 1).all()
        moved = np.diff(tracks.position, axis=0)[same] * tracks.rate
        assert np.median(np.linalg.norm(moved - tracks.velocity[:-1][same], axis=1)) < 0.01
        assert tracks.speed.min() >= 0
        assert 0.5 < np.median(tracks.speed) < 2.0


def test_people_who_stand_say_no_frame_rate(tmp_path):
    frames = list(range(0, 180, 6))
    standing = [
        f"{frame} {id} {0.01 * (k % 2)} 0 {id} 0.05 0 0" for id in range(3, 9) for k, frame in enumerate(frames)
    ]
    assert read(tmp_path, "\n".join([walk(15.0, 6, frames), *standing])).tracks.rate == pytest.approx(2.5)


def test_two_frames_of_their_own_phase_are_mistakes_and_three_are_a_series(tmp_path):
    frames, phase = [*range(1, 101, 10), *range(151, 251, 10)], (104, 114, 124)
    for count in (2, 3):
        rows = "\n".join(f"{frame} 1 {1.2 * frame / 25} 0 1 1.2 0 0" for frame in phase[:count])
        found = read(tmp_path, f"{walk(25.0, 10, frames)}\n{rows}").dropped
        shifts = {"shifts of the annotated frames, where tracks are cut": 2}
        assert found == ({"rows between the annotated frames": 2} if count == 2 else shifts)


def test_the_shortest_series_is_left_out_first(tmp_path):
    """The frames 1 and 11 belong to the others once 14 is gone."""
    content = walk(25.0, 10, list(range(1, 201, 10)))
    recording = read(tmp_path, content + "\n14 1 0 0 0 0 0 0")
    assert recording.dropped == {"rows between the annotated frames": 1}
    assert len(recording.tracks) == len(content.splitlines())


def test_a_shift_after_a_pause_keeps_the_length_of_the_pause(tmp_path):
    tracks = read(tmp_path, walk(15.0, 6, [*range(780, 840, 6), *range(863, 923, 6)])).tracks
    assert sorted(set(np.diff(tracks.frame[tracks.agent == 0]).tolist())) == [1, 5]


def test_a_recording_in_the_current_folder_has_the_name_of_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(write(tmp_path, ROWS).parent)
    assert [source.name for source in ucy(Path())] == ["square"]
