"""The report of a data set: statistics of its scenes, and a line for every recording."""

from __future__ import annotations

import numpy as np

from data.recorded.test_parts import tables
from epo_lightning.data.recorded import summary
from epo_lightning.data.recorded.clock import TOO_SHORT
from epo_lightning.data.recorded.extraction import Extracted
from epo_lightning.data.recorded.summary import describe, per_recording, rows_of, to_csv
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.windows import AT_ENDS, MOMENTS, NO_CHANGE


def test_the_way_to_the_nearest_goal_is_that_of_agents_whose_end_was_observed():
    draw = np.random.default_rng(3)
    scenes = max(
        (tables(draw, 2, False) for _ in range(20)), key=lambda of: len(of.history) + of.future_mask[:, -1].sum()
    )
    seen = scenes.future_mask[:, -1]
    assert 1 < seen.sum() < len(seen)
    way = [
        min(np.hypot(*(goal - end)) for goal in goals)
        for goals, end, known in zip(scenes.candidates, scenes.future[:, -1, :2], seen, strict=True)
        if known
    ]
    found = describe(scenes)["way to the nearest goal candidate [m], mean and 95th percentile"]
    np.testing.assert_allclose(found, [np.mean(way), np.percentile(way, 95)], rtol=1e-6)


def test_a_line_says_why_a_recording_has_fewer_scenes(tmp_path):
    counts = {
        "a": {MOMENTS: 90, TOO_SHORT: 30, AT_ENDS: 60, "gaps in tracks": 2},
        "b": {MOMENTS: 90, TOO_SHORT: 30, AT_ENDS: 20, "windows": 40, NO_CHANGE: 25, "scenes": 15},
    }
    about = {"agents": 5, "recorded": 12.34, "seconds": 0.5, "warnings": ["the map is odd", "so are the tracks"]}
    extracted = {
        "a": Extracted(counts["a"], {**about, "warnings": []}),
        "b": Extracted(counts["b"], {**about, "moving agents": 8, "ends far from lanes": 2}),
        "c": Extracted({}, {"seconds": 0.1, "warnings": ["not said"]}, "the file is odd"),
    }
    sources = [RecordingSource(name, name, (), list) for name in "abc"]  # type: ignore[arg-type]
    rows = rows_of(sources, {"train": sources[:1], "val": sources[1:2]}, extracted, counts)
    assert [(row["split"], row["recorded [s]"], row["problem"]) for row in rows] == [
        ("train", "12.3", ""),
        ("val", "12.3", ""),
        ("left out", "", "the file is odd"),
    ]
    (tmp_path / summary.FILE).write_text(to_csv(rows))
    _, *lines, last = per_recording(tmp_path)
    assert last == f"  all columns in {tmp_path / summary.FILE}"
    why = [line.split("0.50  ")[-1].split("0.10  ")[-1] for line in lines]
    assert why == [
        f"{TOO_SHORT}: 30, {AT_ENDS}: 60, gaps in tracks: 2",
        f"{NO_CHANGE}: 25, warning: the map is odd; so are the tracks",
        "not read: the file is odd",
    ]
    assert "25%" in lines[1]


def test_a_long_table_is_cut_and_says_how_many_recordings_follow(tmp_path):
    sources = [RecordingSource(f"r{number:03d}", "g", (), list) for number in range(summary.SHOWN + 3)]  # type: ignore[arg-type]
    extracted = {source.name: Extracted({}, {"warnings": []}) for source in sources}
    (tmp_path / summary.FILE).write_text(to_csv(rows_of(sources, {"all": sources}, extracted, {})))
    lines = per_recording(tmp_path)
    assert [line.strip() for line in lines[-2:]] == ["and 3 more", f"all columns in {tmp_path / summary.FILE}"]
    assert len(lines) == 1 + summary.SHOWN + 2
