"""Names and splits of data sets stay what they are: others would make all data sets again and change all tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from epo_lightning.data import cache
from epo_lightning.data.recorded.sources import PIECES, fingerprint, warn_of_copies
from epo_lightning.data.recorded.splits import SplitRule
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.versions import identifying_settings, of_older_versions
from epo_lightning.data.recorded.windows import WindowConfig

SOURCES = [RecordingSource(f"{group}-{n}", group, (), list) for n, group in enumerate("aabbccddeeffgghhiijj")]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("windows", "has_map", "options", "reader", "duplicates", "digest"),
    [
        (WindowConfig(), True, {}, "", "keep", "a634638d46f2"),
        (WindowConfig(lane_change=False), False, {}, "", "keep", "f69f26b0861f"),
        (
            WindowConfig(lines=8, off_lane="agent", interpolate=True),
            *(True, {"rate": 24.0}, "abc", "once", "eef505b7eb2d"),
        ),
    ],
)
def test_settings_have_the_digest_that_they_had(windows, has_map, options, reader, duplicates, digest):
    settings = identifying_settings("roads", "exid", windows, has_map, options, reader, duplicates)
    assert cache.digest(settings)[:12] == digest


def test_every_setting_has_a_digest_of_its_own():
    plain = {"dataset": "roads", "format": "exid", "windows": WindowConfig(), "has_map": True, "options": {}}
    plain |= {"reader": "", "duplicates": "keep"}
    changes = {"dataset": "streets", "format": "highd", "windows": WindowConfig(every=2), "has_map": False}
    changes |= {"options": {"rate": 24.0}, "reader": "abc", "duplicates": "once"}
    assert changes.keys() == plain.keys()
    digests = {cache.digest(identifying_settings(**{**plain, key: value})) for key, value in changes.items()}
    assert len(digests | {cache.digest(identifying_settings(**plain))}) == len(changes) + 1


def test_data_sets_of_all_earlier_versions_are_known_as_older_ones():
    now = {"version": 4, "map": True}
    assert [config["version"] for config in of_older_versions(now)] == [1, 2, 3]
    older = of_older_versions({**now, "reader": "abc"})
    assert [(config["version"], "reader" in config) for config in older] == [
        *((version, True) for version in (1, 2, 3)),
        *((version, False) for version in (1, 2, 3, 4)),
    ]


@pytest.mark.parametrize(
    ("test", "val_by", "seed", "validation", "tested"),
    [
        (None, "recording", 0, "a-0 b-3 c-5 d-6", "f-10 f-11 j-18 j-19"),
        (None, "group", 0, "h-14 h-15 i-16 i-17", "f-10 f-11 j-18 j-19"),
        (("b",), "recording", 1, "c-4 d-6 g-12 j-18", "b-2 b-3"),
    ],
)
def test_splits_are_drawn_as_they_were(test, val_by, seed, validation, tested):
    """A fifth of ten groups is tested, and a quarter of the recordings or groups that are left validates."""
    found = SplitRule(test, 0.2, 0.25, val_by, seed).of(SOURCES)
    names = {split: " ".join(source.name for source in held) for split, held in found.items()}
    assert (names["val"], names["test"]) == (validation, tested)
    assert names["train"].split() == [s.name for s in SOURCES if s not in found["val"] + found["test"]]


@pytest.mark.parametrize("val_by", ["recording", "group"])
def test_small_shares_leave_one_group_for_tests_and_one_unit_for_validation(val_by):
    found = SplitRule(None, 0.01, 0.01, val_by, 0).of(SOURCES)
    assert len(found["test"]) == 2
    assert len(found["val"]) == (1 if val_by == "recording" else 2)


def test_the_first_and_last_bytes_of_a_large_file_are_in_its_fingerprint(tmp_path):
    content = bytearray(PIECES * 50_000)
    found = []
    for place in (0, -1, None):
        (tmp_path / "a").write_bytes(content)
        found.append(fingerprint(tmp_path / "a"))
        if place is not None:
            content[place] = 1
    assert len({checksum for _, _, checksum in found}) == 3


def test_recordings_of_one_file_are_no_copies_of_each_other(recwarn):
    of_shard = [RecordingSource(name, "s", (Path("s"),), list) for name in ("s-0", "s-1")]  # type: ignore[arg-type]
    warn_of_copies(of_shard, [[source.name, "s", [["s", 9, 1]]] for source in of_shard])
    assert not recwarn
    of_files = [RecordingSource(name, name, (Path(name),), list) for name in ("a", "b")]  # type: ignore[arg-type]
    with pytest.warns(UserWarning, match=r"1 recordings are copies of others .*\(b of a\)"):
        warn_of_copies(of_files, [[source.name, source.name, [[source.name, 9, 1]]] for source in of_files])
