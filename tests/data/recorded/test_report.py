"""Nothing is left out in silence: broken recordings, empty splits, cut maps, and the report of every recording."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.data import cache
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded import summary
from epo_lightning.data.recorded.extraction import extract_to_file
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.splits import SplitRule
from epo_lightning.data.recorded.tables import joined, selected
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.windows import WindowConfig, extract
from epo_lightning.registry import ConfigError, register

from .roads import FOUR, curve, recording

CHANGES = {
    "mapless": lambda found: dataclasses.replace(found, lanes=None),
    "unchecked": lambda found: dataclasses.replace(
        found, tracks=dataclasses.replace(found.tracks, velocity=np.nan * found.tracks.velocity)
    ),
    "failing": lambda found: dataclasses.replace(found, unknown=1),
    "uneven": lambda found: dataclasses.replace(
        found, tracks=dataclasses.replace(found.tracks, frame=found.tracks.frame[:-5])
    ),
}
"""Mistakes of a format of one's own, which follow the road's turn in a file."""


@register("format", "streets")
def streets(folder: Path) -> list[RecordingSource]:
    """Files ``<group>-<number>.road`` with the road's turn, ``empty`` for a road without scenes or ``broken``."""

    def source(file: Path) -> RecordingSource:
        def read():
            try:
                text = file.read_text()
            except OSError as error:
                raise RecordingError(file, f"the file cannot be read: {error.strerror}") from error
            if text.startswith("broken"):
                raise RecordingError(file, f"the turn is {text!r}; a number was expected")
            vehicles = FOUR[:2] if text == "empty" else FOUR
            turn, _, change = text.partition(" ")
            found = recording(curve(800.0, 0.0 if text == "empty" else float(turn)), vehicles, name=file.stem)
            return CHANGES[change](found) if change else found

        return RecordingSource(file.stem, file.stem.partition("-")[0], (file,), read)

    return [source(file) for file in folder.glob("*.road")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "streets"
    made.mkdir()
    for number, group in enumerate("aaabbbccc"):
        (made / f"{group}-{number}.road").write_text(str(0.1 * number))
    return made


def data(folder: Path, **changes) -> RecordedData:
    arguments = {"dataset": "streets", "format": "streets", "windows": {"dt": 0.2}, "test": ["a"], "batch_size": 8}
    where = {"folder": str(folder), "root": str(folder.parent / "cache")}
    return RecordedData(**{**arguments, **where, **changes})


def rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / summary.FILE).open(newline="") as text:
        return {row["recording"]: row for row in csv.DictReader(text)}


def test_a_broken_recording_is_left_out_named_and_never_taken_for_the_whole_folder(folder):
    whole = data(folder)
    whole.generate(workers=1, progress=False)
    (folder / "b-4.road").write_text("broken")
    module = data(folder)
    made = module.generate(workers=1, progress=False)
    assert made != whole.folder
    assert module.digest != whole.digest
    assert "b-4" not in [name for split in module.config["splits"].values() for name in split]
    assert [name for name, *_ in module.config["recordings"]] == [
        f"{g}-{n}" for n, g in enumerate("aaabbbccc") if n != 4
    ]
    assert [name for name, *_ in module.config["skipped"]] == ["b-4"]
    report = module.report()
    assert "the turn is 'broken'; a number was expected" in report["skipped"]["b-4"]
    assert rows(made)["b-4"]["split"] == "left out"
    assert any("not read: " in line and "b-4" in line for line in module.summary())
    # Neither the whole folder nor the folder without that file is the same data set.
    (folder / "b-4.road").unlink()
    fewer = data(folder)
    fewer.generate(workers=1, progress=False)
    assert len({module.digest, whole.digest, fewer.digest}) == 3
    for split in ("train", "val", "test"):
        name = f"{split}.safetensors"
        assert (made / name).read_bytes() == (fewer.folder / name).read_bytes()


def test_a_file_that_changes_while_it_is_read_makes_no_data_set(folder):
    def change_and_extract(tasks, report):
        (folder / "b-4.road").write_text("0.77")
        for task in tasks:
            extract_to_file(*task)

    with pytest.raises(ConfigError, match="files of b-4 have changed while they were read"):
        data(folder).generate(progress=False, launch=change_and_extract)
    assert not list((folder.parent / "cache").glob("streets-*"))
    data(folder).generate(workers=1, progress=False)


def test_a_file_that_the_system_cannot_read_is_not_taken_for_a_broken_one(folder):
    def lose_and_extract(tasks, report):
        (folder / "b-4.road").unlink()
        for task in tasks:
            extract_to_file(*task)

    with pytest.raises(RecordingError, match=r"b-4.road.*cannot be read: No such file"):
        data(folder).generate(progress=False, launch=lose_and_extract)


def test_copies_of_a_recording_are_named(folder):
    (folder / "c-9.road").write_bytes((folder / "a-0.road").read_bytes())
    with pytest.warns(UserWarning, match="1 recordings are copies.*c-9 of a-0.*data.duplicates=once"):
        data(folder).generate(workers=1, progress=False)


def test_a_name_that_is_not_utf_8_is_refused_at_once(folder):
    try:
        (Path(os.fsdecode(os.fsencode(folder) + b"/c-\xff.road"))).write_text("0.5")
    except OSError:
        pytest.skip("this file system refuses such names itself")
    with pytest.raises(ConfigError, match=r"'c-\\udcff' is not UTF-8: rename"):
        data(folder).generate(workers=1, progress=False)


def test_training_finds_the_data_set_without_the_broken_recording_and_says_so(folder):
    (folder / "b-4.road").write_text("broken")
    made = data(folder).generate(workers=1, progress=False)
    again = data(folder)
    with pytest.warns(UserWarning, match=r"1 of 9 recordings in .* could not be read .* left out: b-4; mend or remove"):
        assert again.folder == made
    again.setup("fit")
    assert again.generate(workers=1, progress=False) == made
    for path in folder.glob("*.road"):
        path.unlink()
    folder.rmdir()
    with pytest.warns(UserWarning, match="was extracted with these settings from 8 recordings"):
        assert data(folder).folder == made


def test_another_broken_file_or_a_mended_one_is_another_data_set(folder):
    (folder / "b-4.road").write_text("broken")
    first = data(folder).generate(workers=1, progress=False)
    (folder / "b-4.road").write_text("broken in another way")
    other = data(folder).generate(workers=1, progress=False)
    (folder / "b-4.road").write_text("0.4")
    whole = data(folder)
    mended = whole.generate(workers=1, progress=False)
    assert len({first, other, mended}) == 3
    assert "skipped" not in whole.config
    assert "skipped" not in whole.report()


@pytest.mark.filterwarnings("ignore:.*could not be read")
def test_strict_refuses_a_broken_recording_also_after_it_was_left_out(folder):
    (folder / "b-4.road").write_text("broken")
    for attempt in range(2):
        with pytest.raises(RecordingError, match=r"b-4\.road: the turn is 'broken'"):
            data(folder).generate(workers=1, progress=False, strict=True)
        if not attempt:
            data(folder).generate(workers=1, progress=False)


def test_a_folder_of_broken_recordings_is_an_error_with_the_first_reason(folder):
    for file in folder.glob("*.road"):
        file.write_text("broken")
    with pytest.raises(RecordingError, match=r"no recording can be read; the first one: .*a-0\.road: the turn is"):
        data(folder).generate(workers=1, progress=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("mapless", "the recording has no map: set data.map=false, or give it one"),
        ("unchecked", r"velocity \[nan, nan\] of track 7 in frame 0 was expected to be finite"),
        ("failing", r"its reader fails at .*\.py:\d+, TypeError"),
        ("uneven", r"frame has the shape \(\d+,\); \(\d+,\) was expected, because agent has \d+ entries"),
    ],
)
def test_a_recording_without_a_map_or_with_impossible_tracks_is_left_out_and_named(folder, change, said):
    (folder / "b-4.road").write_text(f"0.4 {change}")
    with pytest.raises(RecordingError, match=rf"b-4.*: {said}"):
        data(folder).generate(workers=1, progress=False, strict=True)
    made = data(folder)
    made.generate(workers=1, progress=False)
    (problem,) = made.report()["skipped"].values()
    assert re.search(said, problem)


def test_every_recording_has_a_row_whose_windows_add_up(folder):
    (folder / "b-3.road").write_text("empty")
    module = data(folder)
    made = module.generate(workers=1, progress=False)
    found = rows(made)
    assert sorted(found) == [f"{g}-{n}" for n, g in enumerate("aaabbbccc")]
    for row in found.values():
        count = {name: int(row[name]) for name in summary.COUNTED}
        assert count[summary.MOMENTS] == count["windows"] + sum(count[name] for name in summary.BEFORE)
        assert count["windows"] == count["scenes"] + sum(count[name] for name in summary.LOST)
        assert float(row["seconds"]) >= 0
    assert int(found["b-3"]["scenes"]) == 0
    report = module.report()
    for split in ("train", "val", "test"):
        for name in summary.COUNTED:
            assert report[split].get(name, 0) == sum(int(r[name]) for r in found.values() if r["split"] == split)
    table = summary.per_recording(module.folder)
    assert len(table) == 1 + 9 + 1
    assert any("b-3" in line and "too few agents around: " in line for line in table)
    lines = summary.by_split(report)
    for name in (summary.MOMENTS, "windows", "scenes", "less: too few agents around"):
        assert sum(line.strip().startswith(name) for line in lines) == 1
    cache.verify(made)


def test_reports_of_older_versions_are_still_printed():
    split = {"windows": 30, "gaps in tracks": 2, "no lane change": 10, "scenes": 20, "agents per scene": 4.0}
    splits = dict.fromkeys(("train", "val", "test"), split)
    lines = summary.by_split({**splits, "recordings": {name: ["a"] for name in splits}})
    assert [line.split("  ")[1] for line in lines[1:]] == [
        *("recordings", "windows", "less: no lane change", "less: gaps in tracks", "scenes", "agents per scene"),
    ]


def test_an_empty_split_names_its_recordings_the_seed_and_what_to_change(folder):
    for file in folder.glob("[bc]-*.road"):
        if file.stem != "b-3":
            file.write_text("empty")
    with pytest.raises(ConfigError) as error:
        data(folder, test=None, test_share=0.34, val_by="group", seed=0).generate(workers=1, progress=False)
    text = str(error.value)
    assert "has no scene (" in text
    assert "too few agents around: " in text
    assert "data.seed=0" in text
    assert "data.test" in text
    assert "None of data.seed=0..99" in text, "only two groups have scenes"
    (folder / "c-8.road").write_text("0.8")
    seeds = {}
    for seed in range(6):
        module = data(folder, test=None, test_share=0.34, val_share=0.18, val_by="recording", seed=seed)
        try:
            module.generate(workers=1, progress=False)
            seeds[seed] = None
        except ConfigError as error:
            seeds[seed] = str(error)
    bad = [text for text in seeds.values() if text]
    assert bad
    for text in bad:
        names = text.partition("Its recordings are ")[2].partition(". ")[0]
        assert all(name.partition("-")[0] in "abc" for name in names.split(", "))
        advised = [
            int(word.partition("=")[2].strip(","))
            for word in text.partition("Set ")[2].split()
            if word.startswith("data.seed=")
        ]
        assert advised
        for seed in advised:
            module = data(folder, test=None, test_share=0.34, val_share=0.18, seed=seed)
            assert module.generate(workers=1, progress=False), "the advice helps"


def test_too_few_recordings_are_listed_with_their_groups(folder):
    with pytest.raises(
        ConfigError, match=r"no recording is left for train, val.* Group a: a-0, a-1, a-2; group b: b-3"
    ) as error:
        data(folder, test=["a", "b", "c"]).generate(progress=False)
    assert "data.test=null" in str(error.value)
    assert "Set data.seed=" not in str(error.value), "the seed does not matter where all groups are in the test split"


@given(
    st.lists(st.sampled_from("abcdef"), min_size=3, max_size=12),
    st.integers(0, 50),
    st.sampled_from(["recording", "group"]),
)
@settings(max_examples=40)
def test_splits_are_disjoint_and_complete(groups, seed, val_by):
    sources = [RecordingSource(f"{group}-{number}", group, (), lambda: None) for number, group in enumerate(groups)]  # type: ignore[arg-type]
    found = SplitRule(None, 0.3, 0.3, val_by, seed).of(sources)
    names = [source.name for held in found.values() for source in held]
    assert sorted(names) == sorted(source.name for source in sources)
    tested = {source.group for source in found["test"]}
    assert not tested & {source.group for part in ("train", "val") for source in found[part]}


def test_selected_scenes_are_the_same_scenes_with_their_own_agents_only():
    of = recording()
    whole, _ = extract(of, WindowConfig())
    kept = np.arange(len(whole)) % 3 == 1
    part = selected(whole, kept)
    for new, old in enumerate(np.flatnonzero(kept)):
        for mine, its in zip(part.agents[new], whole.agents[old], strict=True):
            assert (mine < 0) == (its < 0)
            for name in ("history", "future", "track", "candidates", "references"):
                np.testing.assert_array_equal(getattr(part, name)[mine], getattr(whole, name)[its])
    assert set(part.agents[part.agents >= 0]) == set(range(len(part.history)))
    assert selected(whole, np.zeros(len(whole), dtype=bool)) is None
    both = joined([part, whole])
    assert len(both) == len(part) + len(whole)


def test_strict_is_for_recordings(folder, tmp_path):
    from epo_lightning.experiment.verbs import generate_and_print

    with pytest.raises(ConfigError, match="strict=true refuses recordings that cannot be read, and data=rpi has no"):
        generate_and_print({"data": {"name": "rpi", "root": str(tmp_path)}, "strict": True}, [])


def test_generate_prints_the_table_and_the_recordings_that_were_left_out(folder, capsys):
    from epo_lightning.experiment.verbs import generate_and_print

    (folder / "b-4.road").write_text("broken")
    section = {"name": "recordings", "dataset": "streets", "format": "streets", "folder": str(folder), "test": ["a"]}
    section |= {"windows": {"dt": 0.2}, "root": str(folder.parent / "cache")}
    generate_and_print({"data": section, "workers": 1, "progress": False}, [])
    shown = capsys.readouterr().out
    assert "left out: b-4: " in shown
    assert "less: near the beginning or end of a track" in shown
    table = [line for line in shown.splitlines() if line.startswith("  a-0")]
    assert len(table) == 1
    assert table[0].split()[:2] == ["a-0", "test"]
    assert json.loads((next((folder.parent / "cache").glob("streets-*")) / "manifest.json").read_text())["report"][
        "skipped"
    ]
