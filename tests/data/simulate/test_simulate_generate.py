"""Folders of simulated recordings: complete or absent, equal for any number of workers, continued after a kill."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from epo_lightning.data import cache
from epo_lightning.data.simulate import config, generate, make_recordings
from epo_lightning.data.simulate.demand import STYLES, Style
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.data.simulate.traffic import Traffic
from epo_lightning.registry import ConfigError, lookup

FREE = "8bbdc1b0f23c"
"""Beginning of the digest of the default configuration, which is part of the name of existing folders."""
SMALL = config(seed=3, recordings=2, minutes=0.25, layouts=[2])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_configuration_is_plain_and_names_everything_that_matters():
    base = config()
    assert json.loads(json.dumps(base)) == base
    assert base["layouts"] == [layout.id for layout in LAYOUTS]
    others = [config(seed=1), config(recordings=1), config(minutes=1.0), config(layouts=[0])]
    assert len({cache.digest(each) for each in (base, *others)}) == 5
    assert config(layouts=[3, 1, 1]) == config(layouts=[1, 3])


def test_free_traffic_keeps_the_configuration_of_older_versions_and_dense_traffic_has_its_own():
    assert config(traffic="free") == config()
    assert "traffic" not in config()
    assert cache.digest(config())[:12] == FREE
    dense = config(traffic="dense")
    assert json.loads(json.dumps(dense)) == dense
    assert dense["traffic"]["every"] == STYLES["dense"].every
    assert {**dense, "traffic": None} == {**config(), "traffic": None}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"layouts": [0, 99]}, "unknown layout 99: known are 0, 1"),
        ({"layouts": []}, "layouts is empty"),
        ({"traffic": "denser"}, r"unknown data\.traffic 'denser': did you mean 'dense'"),
        ({"recordings": 0}, "recordings is 0"),
        ({"minutes": 0.01}, "minutes is 0.01"),
        ({"minutes": float("nan")}, "minutes is nan"),
    ],
)
def test_invalid_simulation_settings_are_refused(wrong: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        config(**wrong)


def finished(folder: Path, of: dict[str, Any]) -> Path:
    """A folder like a finished one, with one file."""
    (folder / "data").mkdir(parents=True)
    file = folder / "data" / "00_tracks.csv"
    file.write_text("trackId\n")
    files = {"data/00_tracks.csv": {"bytes": file.stat().st_size, "sha256": cache.file_digest(file)}}
    (folder / cache.MANIFEST).write_text(json.dumps({"hash": cache.digest(of), "config": of, "files": files}))
    return folder


def test_a_folder_that_is_there_is_not_made_again(tmp_path: Path):
    folder = finished(tmp_path / "there", SMALL)
    before = contents(folder)
    assert make_recordings(folder, SMALL) == folder
    assert contents(folder) == before


def test_it_waits_for_another_process_that_makes_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "there"
    with ThreadPoolExecutor(1) as thread:
        with cache.locked(folder):
            making = thread.submit(make_recordings, folder, SMALL)
            said = ""
            while "waiting for it" not in said:
                assert not making.done(), "it did not wait"
                said += capsys.readouterr().err
                time.sleep(0.01)
            finished(folder, SMALL)
        assert making.result() == folder


def test_other_folders_are_not_overwritten(tmp_path: Path):
    folder = finished(tmp_path / "there", SMALL)
    with pytest.raises(cache.CacheError, match="another configuration"):
        make_recordings(folder, config(seed=4))
    (folder / "data" / "00_tracks.csv").write_text("")
    with pytest.raises(cache.CacheError, match=r"00_tracks\.csv is missing or truncated; delete the folder"):
        make_recordings(folder, SMALL)
    (folder / cache.MANIFEST).write_text("{")
    with pytest.raises(cache.CacheError, match="not a readable manifest"):
        make_recordings(folder, SMALL)


def test_every_recording_and_every_seed_has_traffic_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    drawn: list[tuple[int, ...]] = []

    def simulate(place: Layout, seed: Sequence[int], seconds: float, folder: Path, style: Style) -> Traffic:
        drawn.append(tuple(np.random.default_rng(seed).integers(2**31, size=3).tolist()))
        raise ConfigError("the seed is all that is asked for")

    monkeypatch.setattr(generate, "simulate", simulate)
    for seed, number in itertools.product((3, 4), range(3)):
        with pytest.raises(ConfigError, match="all that is asked for"):
            generate.record(tmp_path, "", number, LAYOUTS[2], seed, 2.0)
    assert len(set(drawn)) == 6


def test_recordings_with_many_implausible_vehicles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
    monkeypatch.setattr(generate, "MOST_DROPPED", -1.0)
    with pytest.raises(ConfigError, match=r"recording 0 on layout diverge: 0 of \d+ vehicles move implausibly"):
        generate.record(tmp_path, "", 0, LAYOUTS[2], 3, 2.0)


def test_recordings_without_lane_changes_are_refused(tmp_path: Path):
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
    with pytest.raises(ConfigError, match=r"no vehicle changes lane in 0\.04 s: use more minutes"):
        generate.record(tmp_path, "", 0, LAYOUTS[2], 3, 0.04)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("libsumo", reason="SUMO cannot be loaded", exc_type=ImportError)
    return make_recordings(tmp_path_factory.mktemp("two") / "set", SMALL, workers=2, progress=False)


@pytest.mark.slow
def test_a_generated_set_has_all_files(made: Path):
    manifest = generate.verify(made, SMALL)
    files = contents(made)
    assert set(manifest["files"]) == set(files) - {cache.MANIFEST}
    assert [path for path in made.iterdir() if path.name.startswith(".")] == []
    assert {path.name for path in made.parent.iterdir()} <= {"set", ".set.lock"}  # a lock file may stay
    assert all(row["lane_changes"] > 0 for row in manifest["recordings"].values())
    assert files["data/00_tracks.csv"] != files["data/01_tracks.csv"]
    read = [source.read() for source in lookup("format", "exid")(made)]
    assert [recording.group for recording in read] == ["2", "2"]
    for name, recording in zip(("00", "01"), read, strict=True):
        assert len(recording.tracks.ids) == manifest["recordings"][name]["vehicles"]


@pytest.mark.slow
def test_a_killed_generation_continues_to_the_same_bytes(made: Path, tmp_path: Path):
    """One worker, killed after the first recording: the second run keeps it, and equals the run of two workers."""
    folder = tmp_path / "set"
    program = (
        "from pathlib import Path\n"
        "from epo_lightning.data.simulate import make_recordings\n"
        "if __name__ == '__main__':\n"
        f"    make_recordings(Path({str(folder)!r}), {SMALL!r}, workers=1, progress=False)\n"
    )
    (tmp_path / "run.py").write_text(program)
    process = subprocess.Popen([sys.executable, str(tmp_path / "run.py")], cwd=Path.cwd())
    work = tmp_path / f".set-{cache.digest(SMALL)[:12]}"
    deadline = time.monotonic() + 120
    while not (work / ".00.done").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not folder.exists()
    first = work / "data" / "00_tracks.csv"
    written = first.stat().st_mtime_ns
    assert make_recordings(folder, SMALL, workers=1, progress=False) == folder
    assert (folder / "data" / "00_tracks.csv").stat().st_mtime_ns == written
    assert contents(folder) == contents(made)


@pytest.mark.slow
def test_a_damaged_recording_is_made_again(made: Path, tmp_path: Path):
    work = tmp_path / f".set-{cache.digest(SMALL)[:12]}"
    (work / "data").mkdir(parents=True)
    manifest = generate.verify(made, SMALL)
    for number in ("00", "01"):
        files = {name: entry for name, entry in manifest["files"].items() if name.startswith(f"data/{number}")}
        for name in files:
            os.link(made / name, work / name)
        (work / f".{number}.done").write_text(
            json.dumps({**manifest["recordings"][number], "config": cache.digest(SMALL), "files": files})
        )
    (work / "data" / "01_tracks.csv").unlink()
    (work / "data" / "01_tracks.csv").write_text("cut off")
    make_recordings(tmp_path / "set", SMALL, workers=1, progress=False)
    assert contents(tmp_path / "set") == contents(made)
