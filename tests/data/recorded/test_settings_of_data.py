"""Settings of recorded data reach the task, the scenes and the table of recordings; what a reader does wrong is named."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from epo_lightning.data import cache
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded import parts, summary
from epo_lightning.data.recorded.extraction import extract_to_file, outcomes
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.routes import LINES, PER_LINE
from epo_lightning.data.recorded.splits import SplitRule
from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.metrics.functional import interactive_scenes
from epo_lightning.registry import ConfigError, register

from .roads import curve, recording


@register("format", "avenues")
def avenues(folder: Path) -> list[RecordingSource]:
    """Files ``<group>-<number>.avenue`` with the road's turn."""
    return [
        RecordingSource(file.stem, file.stem[0], (file,), partial(recording, curve(800.0, float(file.read_text()))))
        for file in folder.glob("*.avenue")
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "avenues"
    made.mkdir()
    for number, group in enumerate("aabbb"):
        (made / f"{group}-{number}.avenue").write_text(str(0.3 * number))
    return made


def data(folder: Path, **changes: Any) -> RecordedData:
    words = {"windows": {"dt": 0.2}, "test": ["a"], "root": str(folder.parent / "cache"), **changes}
    return RecordedData("avenues", "avenues", str(folder), **words)


def test_settings_reach_the_task_and_the_scenes(folder):
    windows = {"dt": 0.4, "history": 4, "horizon": 6, "agents": 3, "least_agents": 2, "lines": 5, "lane_change": False}
    module = data(folder, windows=windows, frame="fixed", shape="disc", scale=35.0)
    module.generate(workers=1, progress=False)
    task, scene = module.task, module.open("test")[torch.arange(6)]
    assert (task.dt, task.history, task.horizon, task.candidates) == (0.4, 4, 6, 5 * PER_LINE)
    assert (task.map, task.shape, task.scale) == (True, "disc", 35.0)
    assert (scene.dt, scene.history.shape, scene.future.shape) == (0.4, (6, 3, 4, 4), (6, 3, 6, 4))
    assert scene.goal_candidates.shape == (6, 3, task.candidates, 2)
    assert (scene.frame[:, 2] == 0).all(), "axes of the recording"
    whole = module.open("test")
    every = whole[torch.arange(len(whole))]
    assert torch.equal(every.subset, interactive_scenes(every, "disc").long())
    aligned = data(folder, windows=windows)
    aligned.generate(workers=1, progress=False)
    assert (aligned.open("test")[torch.arange(6)].frame[:, 2] != 0).all()
    assert data(folder).task.candidates == LINES * PER_LINE


def test_the_subset_follows_the_shape_of_the_agents(folder):
    given = []
    for shape in ("box", "disc"):
        module = data(folder, shape=shape, frame="fixed")
        module.generate(workers=1, progress=False)
        scenes = module.open("val")
        assert scenes.shape == shape
        given.append(module.folder)
    assert given[0] == given[1], "the same data set"


def test_without_a_map_scenes_have_no_lanes_and_no_goals(folder):
    module = data(folder, windows={"dt": 0.2, "lane_change": False}, map=False)
    module.generate(workers=1, progress=False)
    scene = module.open("train")[torch.arange(3)]
    assert scene.lanes is scene.goal_candidates is scene.references is scene.reference_speed is None
    assert (module.task.map, module.task.candidates) == (False, 0)


def test_a_share_of_recorded_scenes_is_used(folder):
    data(folder).generate(workers=1, progress=False)
    whole, part = data(folder), data(folder, share=0.25)
    for module in (whole, part):
        module.setup("fit")
    assert len(part.dataset("train")) == round(0.25 * len(whole.dataset("train")))


def test_the_command_names_a_cache_that_is_not_the_usual_one(folder, monkeypatch):
    own = f"epo generate data=avenues data.folder={folder}"
    assert data(folder).command == f"{own} data.root={folder.parent / 'cache'}"
    monkeypatch.setenv("EPO_CACHE", str(folder.parent / "cache"))
    assert data(folder).command == own


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("scale", 0.0, r"data\.scale must be positive, not 0\.0"),
        ("scale", float("inf"), r"data\.scale must be positive, not inf"),
        ("test_share", 0.0, r"data\.test_share must be a share between 0 and 1, not 0\.0"),
        ("val_share", 1.0, r"data\.val_share must be a share between 0 and 1, not 1\.0"),
        ("shape", "circle", r"unknown data\.shape 'circle'"),
        ("val_by", "map", r"unknown data\.val_by 'map'"),
    ],
)
def test_settings_that_cannot_be_are_refused(folder, key, value, message):
    with pytest.raises(ConfigError, match=message):
        data(folder, **{key: value})


def test_a_file_in_the_place_of_the_folder_is_named(folder):
    with pytest.raises(ConfigError, match=r"a-0\.avenue is a file: data\.folder takes the folder that it lies in"):
        data(folder / "a-0.avenue").sources()


def test_the_table_of_recordings_has_their_seconds_and_agents(folder):
    with (data(folder).generate(workers=1, progress=False) / summary.FILE).open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert [row["recording"] for row in rows] == ["a-0", "a-1", "b-2", "b-3", "b-4"]
    for row in rows:
        assert (row["group"], row["recorded [s]"], row["agents"], row["problem"]) == (
            row["recording"][0],
            "10.0",
            "4",
            "",
        )
        assert 0 <= float(row["ends far from all lanes given"]) <= 1


def test_a_damaged_data_set_is_named_when_it_is_made_again(folder):
    made = data(folder).generate(workers=1, progress=False)
    (made / "val.safetensors").write_bytes(b"damaged")
    with pytest.raises(cache.CacheError, match=r"val\.safetensors has 7 bytes instead of"):
        data(folder).generate(workers=1, progress=False)


def changed(change: Callable[[Recording], Recording]) -> Recording:
    return change(recording())


def failing(_: Recording) -> Recording:
    raise MemoryError("too little memory")


def without_calibration(_: Recording) -> Recording:
    try:
        Path("calibration.yaml").read_text()
    except OSError as error:
        raise RecordingError("calibration.yaml", "it cannot be read") from error
    raise AssertionError


WINDOWS = WindowConfig(lane_change=False)


def outcome(file: Path, change: Callable[[Recording], Recording], windows: WindowConfig = WINDOWS):
    """The outcome of the extraction of one changed recording."""
    extract_to_file(
        [RecordingSource("road", "r", (Path("a.csv"),), partial(changed, change))], windows, True, file, False
    )
    (found,) = outcomes(file)
    return found


def test_lanes_that_cannot_be_are_an_error_of_the_recording(tmp_path):
    found = outcome(
        tmp_path / "part",
        lambda of: dataclasses.replace(of, lanes=dataclasses.replace(of.lanes, left=of.lanes.left[:-1])),
    )
    assert found.problem is not None
    assert found.problem.startswith("a.csv")
    assert not found.counts


def test_doubts_about_tracks_are_among_the_warnings(tmp_path):
    def too_fast(of: Recording) -> Recording:
        return dataclasses.replace(of, tracks=dataclasses.replace(of.tracks, velocity=0.3 * of.tracks.velocity))

    (said,) = outcome(tmp_path / "part", too_fast).about["warnings"]
    assert "agents move 3.3 times as fast in their positions" in said
    assert not outcome(tmp_path / "same", lambda of: of).about["warnings"]


def test_too_little_memory_is_no_error_of_the_recording(tmp_path):
    with pytest.raises(MemoryError, match="too little memory"):
        outcome(tmp_path / "part", failing)


def test_a_file_of_the_reader_that_is_missing_is_an_error_of_the_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "calibration.yaml: it cannot be read" in outcome(tmp_path / "part", without_calibration).problem


def test_a_split_without_scenes_repeats_the_warnings_of_its_recordings():
    sources = [RecordingSource(name, name, (), recording) for name in "abc"]
    rule = SplitRule(("a",), 0.1, 0.1, "recording", 0)
    counts = {"a": {"windows": 5, "no lane change": 5, "scenes": 0}, "b": {"scenes": 3}, "c": {"scenes": 3}}
    warned = {"a": ["the map is odd", "the tracks are odd", "no more"], "b": ["not of this split"], "c": []}
    with pytest.raises(ConfigError) as error:
        rule.refuse_empty("roads", sources, rule.of(sources), counts, warned)
    said = str(error.value)
    assert "no lane change: 5" in said
    assert "Warning of a: the map is odd Warning of a: the tracks are odd" in said
    assert "no more" not in said
    assert "not of this split" not in said


@pytest.mark.parametrize(("most", "word", "count"), [(10, "recording", 5), (3, "part", 3)])
def test_progress_counts_what_was_extracted_before(folder, monkeypatch, capsys, most, word, count):
    monkeypatch.setattr(parts, "MOST", most)
    module = data(folder)
    made = parts.Parts(folder, module.sources())
    tasks = made.tasks(module.windows, True, True, False)
    made.extract(tasks[1:], 1, True, None)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(",")[0] for line in lines] == [
        f"extracting {word}s",
        *(f"{word} {number} of {count} extracted" for number in range(2, count + 1)),
    ]
    assert made.missing() == [0]


def test_a_recording_that_could_not_be_read_is_read_again(folder):
    made = parts.Parts(folder, [RecordingSource("road", "r", (), partial(changed, without_calibration))])
    (task,) = made.tasks(WINDOWS, True, False, False)
    extract_to_file(*task)
    assert made.extracted()["road"].problem is not None
    assert made.missing() == [0]
    assert not made.files[0].exists()
