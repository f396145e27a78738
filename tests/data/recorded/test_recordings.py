"""Recordings as a data module: splits without leaks, a complete or absent cache, errors with a remedy."""

from __future__ import annotations

import functools
import os
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from metrics.slow_interaction import interact

from epo_lightning.data import cache
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded import sources
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.sources import SHIPPED, code_of, fingerprint
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.registry import ConfigError, parts, register

from .roads import FOUR, curve, recording

WINDOWS = {"dt": 0.2}
US101 = Path(os.environ.get("EPO_SHARED", Path(__file__).parents[4] / "shared")) / "data" / "us101"
READ: list[str] = []
"""Recordings that were read, in order."""


@register("format", "roads")
def roads(folder: Path) -> list[RecordingSource]:
    """Files ``<group>-<number>.road``; what is in them is how far the road is turned."""

    def source(file: Path) -> RecordingSource:
        def read():
            READ.append(file.stem)
            if (folder / "stop").exists() and file.stem == "b-5":
                raise RecordingError(file, "the disk is full: make room")
            text = file.read_text()
            if text == "empty":
                return recording(vehicles=FOUR[:2], name=file.stem)
            return recording(curve(800.0, float(text)), name=file.stem)

        return RecordingSource(file.stem, file.stem.partition("-")[0], (file,), read)

    return [source(file) for file in folder.glob("*.road")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "roads"
    made.mkdir()
    for number, group in enumerate("aaabbbccc"):
        (made / f"{group}-{number}.road").write_text(str(0.1 * number))
    return made


def data(folder: Path, **changes) -> RecordedData:
    arguments = {"dataset": "roads", "format": "roads", "windows": WINDOWS, "test": ["a"], "batch_size": 8}
    where = {"folder": str(folder), "root": str(folder.parent / "cache")}
    return RecordedData(**{**arguments, **where, **changes})


@pytest.mark.parametrize(("lines", "map", "version"), [(None, True, 2), (8, True, 4), (8, False, 2)])
def test_lines_through_junctions_have_a_version_of_their_own(folder, lines, map, version):
    module = data(folder, windows={**WINDOWS, "lines": lines, "lane_change": False}, map=map)
    assert module.config["version"] == version
    digests = [
        cache.digest({"set": {**module.config, "version": older}, "frame": module.frame})[:16]
        for older in range(1, version)
    ]
    assert all(module.is_older(digest) for digest in digests)
    assert not module.is_older(module.digest)
    changed = data(folder, windows={**WINDOWS, "lines": lines, "lane_change": False, "every": 2}, map=map)
    assert not any(changed.is_older(digest) for digest in digests)


def test_generate_once_then_train_from_the_cache(folder):
    module = data(folder)
    made = module.generate(workers=1, progress=False)
    written = made.stat().st_mtime_ns
    assert module.generate(workers=1, progress=False) == made
    assert made.stat().st_mtime_ns == written
    assert not list(made.parent.glob(".*parts*"))
    module.setup("fit")
    batch = next(iter(module.train_dataloader()))
    assert batch.history.shape == (8, 4, 10, 4)
    assert batch.lanes.shape == (8, 32, 10, 4)
    assert batch.goal_candidates.shape == (8, 4, module.task.candidates, 2)
    report = module.report()
    names = report["recordings"]
    assert {name[0] for name in names["test"]} == {"a"}
    assert not set(names["train"]) & set(names["val"])
    assert report["train"]["scenes"] == len(module.dataset("train")) > 0


def test_validation_and_test_scenes_are_calm_or_interactive_and_the_data_set_is_the_same(folder):
    module = data(folder)
    module.generate(workers=1, progress=False)
    assert module.task.subsets == ("calm", "interactive")
    assert "subset" not in cache.load(module.folder, "test")
    for split, known in (("train", False), ("val", True), ("test", True)):
        scenes = module.open(split)
        assert (scenes[torch.arange(3)].subset is not None) is known
    assert "calm" not in str(module.config), "the subset is computed from the scenes, it is no part of the data set"


@pytest.mark.skipif(not US101.is_dir(), reason="no US-101 recordings")
def test_real_traffic_equals_the_slow_definition(tmp_path):
    windows = {"dt": 0.2, "smoothing": 1.0, "every": 5}
    module = RecordedData("us101", "commonroad", str(US101), windows, val_by="group", seed=4, root=str(tmp_path))
    module.generate(workers=1, progress=False)
    scenes = module.open("test")
    batch = scenes[torch.arange(len(scenes))]
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    for row in range(len(scenes)):
        expected = any(interact(batch.to(torch.double), row, i, j, "box") for i, j in pairs)
        assert bool(batch.subset[row]) == expected


def test_splits_are_drawn_by_group_where_none_is_named(folder):
    drawn = data(folder, test=None, val_by="group").splits(data(folder).sources())
    groups = [{source.group for source in drawn[part]} for part in ("train", "val", "test")]
    assert [len(group) for group in groups] == [1, 1, 1]
    assert set.union(*groups) == set("abc")
    other = {
        tuple(s.name for s in data(folder, test=None, seed=seed).splits(data(folder).sources())["test"])
        for seed in range(9)
    }
    assert len(other) > 1


def test_all_recordings_are_one_split_of_a_data_set_of_its_own(folder):
    module, usual = data(folder), data(folder)
    module.whole = True
    made = module.generate(workers=1, progress=False)
    assert module.digest != usual.digest
    assert made != usual.generate(workers=1, progress=False)
    assert sorted(file.name for file in made.glob("*.safetensors")) == ["all.safetensors"]
    assert len(module.report()["recordings"]["all"]) == 9
    scenes = module.open("all")
    splits = [usual.open(split) for split in ("train", "val", "test")]
    assert len(scenes) == sum(map(len, splits))
    assert scenes[torch.arange(len(scenes))].subset is not None
    copied = data(made)
    copied.whole = True
    assert copied.digest == module.digest
    one = folder.parent / "one"
    one.mkdir()
    shutil.copy(folder / "a-0.road", one)
    alone = data(one, test=None)
    alone.whole = True
    alone.generate(workers=1, progress=False)
    assert len(alone.open("all")) > 0


def test_the_digest_has_a_later_setting_of_windows_only_if_it_is_set(folder):
    plain, set_ = data(folder), data(folder, windows={"dt": 0.2, "interpolate": False})
    assert "interpolate" not in plain.config["windows"]
    assert plain.digest == set_.digest
    assert data(folder, windows={"dt": 0.2, "interpolate": True}).digest != plain.digest


def test_extraction_continues_after_an_error(folder, tmp_path):
    one = data(folder).generate(workers=1, progress=False)
    again = data(folder, root=str(tmp_path / "again"))
    (folder / "stop").touch()
    READ.clear()
    with pytest.raises(ConfigError, match="the disk is full"):
        again.generate(workers=1, progress=False, strict=True)
    before = len(READ)
    (folder / "stop").unlink()
    two = again.generate(workers=1, progress=False)
    assert before < 9
    assert len(READ) == 9 + 1  # only the one that failed was read twice
    for part in ("train", "val", "test"):
        assert (one / f"{part}.safetensors").read_bytes() == (two / f"{part}.safetensors").read_bytes()


def test_the_digest_depends_on_the_contents_of_the_files(folder):
    before = data(folder).digest
    assert data(folder).digest == before
    assert data(folder, frame="fixed").digest != before
    assert data(folder, windows={"dt": 0.2, "radius": 50.0}).digest != before
    (folder / "a-0.road").write_text("3.0")
    assert data(folder).digest != before


def test_the_digest_depends_on_the_file_of_an_own_format_and_on_no_shipped_one(folder, tmp_path):
    """Scenes of an earlier reader are not taken for those of a mended one; shipped formats have a version instead."""
    file, found = tmp_path / "mine.py", []
    text = "from pathlib import Path\n\ndef mine(folder: Path) -> list:\n    return shown(folder)\n"
    for content in (text, text + "\n# a comment\n", text.replace("return", "return [] or")):
        file.write_text(content)
        module = {"__name__": "elsewhere", "shown": roads}
        exec(compile(content, file, "exec"), module)
        register("format", "mine")(functools.wraps(module["mine"])(functools.partial(module["mine"])))
        found.append(data(folder, format="mine"))
    digests = [each.digest for each in found]
    assert digests[0] == digests[1] != digests[2]
    before = {key: value for key, value in found[0].config.items() if key != "reader"}
    assert found[0].is_older(found[0]._digest(before)), "the digest that it had when readers did not count"
    assert not found[2].is_older(digests[0])
    assert set(SHIPPED) <= set(parts("format"))
    assert not any(code_of(name) for name in SHIPPED)


def test_fingerprints_cover_small_files_and_samples_of_large_ones(tmp_path):
    file = tmp_path / "tracks.csv"
    for size in (1, 1000, 900_000):
        content = bytearray(np.random.default_rng(0).bytes(size))
        file.write_bytes(content)
        before = fingerprint(file)
        content[size // 2] ^= 1
        file.write_bytes(content)
        assert fingerprint(file) != before
    large = bytearray(20_000_000)
    file.write_bytes(large)
    before = fingerprint(file)
    large[9_000_000:10_000_000] = b"1" * 1_000_000
    file.write_bytes(large)
    assert fingerprint(file) != before


def test_fingerprints_of_many_files_are_remembered_until_a_file_changes(folder, monkeypatch):
    expected = data(folder).digest
    opened: list[str] = []
    monkeypatch.setattr(sources, "fingerprint", lambda file: opened.append(file.stem) or fingerprint(file))
    assert data(folder).digest == expected
    assert len(opened) == 9
    monkeypatch.setattr(sources, "MANY", 8)
    root, long_ago = folder.parent / "cache", 1_000_000_000
    for file in folder.iterdir():
        os.utime(file, (long_ago, long_ago))
    for count in (9, 0, 0):
        opened.clear()
        assert data(folder).digest == expected
        assert len(opened) == count
    (folder / "b-3.road").write_text("0.9")  # of the same size, and just now
    for _ in range(2):
        opened.clear()
        changed = data(folder).digest
        assert changed != expected
        assert opened == ["b-3"], "a time of change of a moment ago is not trusted"
    (memo,) = root.glob(".fingerprints-*.json")
    for damage in ("[", "[1]", '{"a": 1}'):
        memo.write_text(damage)
        opened.clear()
        assert data(folder).digest == changed
        assert len(opened) == 9
    os.utime(folder / "b-3.road", (long_ago, long_ago + 1))
    (folder / "b-3.road").write_text("0.33")
    os.utime(folder / "b-3.road", (long_ago, long_ago + 1))
    assert data(folder).digest != changed, "another size"


def test_a_split_without_scenes_is_an_error_with_the_reasons(folder):
    for file in folder.glob("a-*.road"):
        file.write_text("empty")
    with pytest.raises(ConfigError, match=r"'test' of roads has no scene .*too few agents around: \d+"):
        data(folder).generate(workers=1, progress=False)


def test_recordings_of_a_single_group_need_others(folder):
    for file in (*folder.glob("b-*"), *folder.glob("c-*")):
        file.unlink()
    with pytest.raises(ConfigError, match=r"3 recording\(s\) in 1 group\(s\) are too few: .* of another group"):
        data(folder, test=None).generate(workers=1, progress=False)


def test_recordings_without_scenes_keep_their_place(folder):
    (folder / "a-0.road").write_text("empty")
    module = data(folder)
    module.generate(workers=1, progress=False)
    module.setup("test")
    test = module.dataset("test")
    known, scene = test.provenance(range(len(test))), test[torch.arange(len(test))]
    assert {entry["recording"] for entry in known} == {"a-1", "a-2"}
    tracks = {name: recording(curve(800.0, turn)).tracks for name, turn in (("a-1", 0.1), ("a-2", 0.2))}
    for index, entry in enumerate(known):
        of = tracks[entry["recording"]]
        *origin, angle = scene.frame[index].tolist()
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for i, track in enumerate(entry["tracks"]):
            row = np.flatnonzero((of.ids[of.agent] == track) & (of.frame == entry["frame"]))
            position = rotation @ scene.current[index, i, :2].double().numpy() + origin
            np.testing.assert_allclose(position, of.position[row[0]], atol=1e-2)


def test_missing_data_and_misspelt_keys_name_the_remedy(folder, tmp_path):
    for changes, message in (
        ({"windows": {"dt": 0.2, "horzion": 20}}, "did you mean 'horizon'"),
        ({"windows": {"agents": 2.5}}, "data.windows.agents must be a whole number"),
        ({"windows": {"lane_change": 1}}, "data.windows.lane_change must be true or false, not 1"),
        ({"windows": {"radius": "far"}}, "data.windows.radius must be a number or null, not 'far'"),
        ({"format": "raods"}, "did you mean 'roads'"),
        ({"frame": "moving"}, "unknown data.frame"),
        (
            {"dataset": "../roads"},
            r"data\.dataset must be a name without slashes.* not '\.\./roads': folders in the cache",
        ),
        ({"dataset": ""}, r"data\.dataset must be a name"),
        ({"map": False}, "lane_change asks for lanes"),
        ({"val_share": 1.5}, "share between 0 and 1"),
    ):
        with pytest.raises(ConfigError, match=message):
            data(folder, **changes)
    with pytest.raises(ConfigError, match=r"no folder .*nowhere with roads .* point data\.folder at the recordings"):
        _ = RecordedData("roads", "roads", str(tmp_path / "nowhere"), WINDOWS).config
    with pytest.raises(ConfigError, match=r"which no recording has: .*known: a, b, c"):
        data(folder, test=["d"]).generate(progress=False)
    with pytest.raises(ConfigError, match=r"data\.test is empty: name one or more of the groups a, b, c"):
        data(folder, test=[]).generate(progress=False)
    with pytest.raises(ConfigError, match="no recording is left for train, val"):
        data(folder, test=["a", "b", "c"]).generate(progress=False)
    (tmp_path / "bare").mkdir()
    with pytest.raises(ConfigError, match="holds no recording in the format 'roads'"):
        data(tmp_path / "bare").generate(progress=False)
    with pytest.raises(cache.CacheError, match=r"epo generate data=roads"):
        data(folder).setup("fit")


def test_one_of_several_processes_extracts_and_the_others_wait(folder):
    READ.clear()
    with ThreadPoolExecutor(3) as pool:
        made = list(pool.map(lambda _: data(folder).generate(workers=1, progress=False), range(3)))
    assert len(set(made)) == 1
    assert len(READ) == 9


def test_training_needs_the_extracted_data_set_but_not_the_recordings(folder):
    made = data(folder).generate(workers=1, progress=False)
    before = data(folder).digest
    shutil.rmtree(folder)
    module = data(folder)
    with pytest.warns(
        UserWarning, match=r"no folder .*roads: the data set .* is used, which was extracted .* from 9 recordings"
    ):
        assert (module.folder, module.digest) == (made, before)
    assert module.generate(workers=1, progress=False) == made
    module.setup("fit")
    assert next(iter(module.train_dataloader())).history.shape == (8, 4, 10, 4)
    for other in ({"windows": {"dt": 0.2, "radius": 50.0}}, {"test": ["b"]}, {"test": ["d"]}, {"dataset": "streets"}):
        with pytest.raises(ConfigError, match=r"no folder .*roads with (roads|streets) recordings, and no data set"):
            data(folder, **other).setup("fit")
    with pytest.raises(ConfigError, match="no data set that was extracted"):
        data(folder, root=str(folder.parent / "elsewhere")).setup("fit")


def test_one_of_several_extracted_data_sets_is_chosen_by_its_folder(folder):
    one = data(folder)
    one.generate(workers=1, progress=False)
    (folder / "a-0.road").unlink()
    two = data(folder)
    two.generate(workers=1, progress=False)
    shutil.rmtree(folder)
    with pytest.raises(ConfigError, match="several data sets were extracted with these settings") as error:
        data(folder).setup("fit")
    for module, count in ((one, 9), (two, 8)):
        assert f"data.folder={module.folder} ({count} recordings)" in str(error.value)
        chosen = data(module.folder, root=str(folder.parent / "cache"))
        chosen.setup("test")
        assert (chosen.folder, chosen.digest) == (module.folder, module.digest)
        moved = module.folder.rename(folder.parent / f"moved-{count}")
        assert data(moved, root=str(folder.parent / "cache")).digest == module.digest
    with pytest.raises(ConfigError, match=r"other settings: it differs in windows\.radius \(60\.0 instead of 50\.0\)"):
        data(moved, windows={"dt": 0.2, "radius": 50.0}).setup("fit")


def test_a_recording_is_reported_when_it_is_extracted(folder, capfd):
    data(folder).generate(workers=1, progress=True)
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[0] == "extracting recordings, 9 to do"
    assert re.fullmatch(r"recording 3 of 9 extracted, \d+ s, about \d+ s left", lines[3])
    assert re.fullmatch(r"recording 9 of 9 extracted, \d+ s", lines[9])
    data(folder).generate(workers=1, progress=True)
    assert not capfd.readouterr().err


def test_a_broken_file_is_named_by_the_worker_that_reads_it(tmp_path):
    for number in range(4):
        file = tmp_path / "crowds" / f"place-{number}" / "obsmat.txt"
        file.parent.mkdir(parents=True)
        file.write_text("0 1 0.0 0.0 0.0 1.0 0.0 0.0\n10 1 0.4 0.0 0.0 1.0 0.0 0.0\n")
    file.write_text("0 1 0.0 0.0 zero 1.0 0.0 0.0\n")
    module = data(
        tmp_path / "crowds", format="ucy", map=False, windows={"dt": 0.4, "lane_change": False}, test=["place-0"]
    )
    with pytest.raises(RecordingError, match=r"place-3/obsmat\.txt, row 1: y is 'zero'; a finite number"):
        module.generate(workers=2, progress=False, strict=True)
