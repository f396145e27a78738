"""A data set is complete and undamaged, or one error names the problem, the file and the remedy."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import stat
import subprocess
import sys
from subprocess import PIPE

import pytest
import torch
from safetensors import SafetensorError

from epo_lightning.data import cache
from epo_lightning.registry import ConfigError

COMMAND = "epo generate data=rpi"


@pytest.fixture
def folder(tmp_path):
    splits = {name: {"a": torch.arange(6.0).view(3, 2), "b": torch.arange(3)} for name in ("train", "test")}
    return cache.write(tmp_path / "rpi-123", splits, {"seed": 1}, {"size": 3})


def test_a_written_set_is_read_back(folder):
    tensors = cache.load(folder, "train")
    assert torch.equal(tensors["a"], torch.arange(6.0).view(3, 2))
    assert torch.equal(tensors["b"], torch.arange(3))
    assert list(cache.load(folder, "test", ("b",))) == ["b"]
    manifest = cache.manifest(folder)
    assert (manifest["report"], manifest["config"]) == ({"size": 3}, {"seed": 1})
    assert manifest["hash"] == cache.digest({"seed": 1})
    assert [path.name for path in folder.parent.iterdir()] == ["rpi-123"], "a temporary folder was left behind"


def test_a_complete_set_is_never_written_again(folder):
    before = (folder / "train.safetensors").stat().st_mtime_ns
    cache.write(folder, {"train": {"a": torch.zeros(1)}}, {"seed": 1}, {})
    assert (folder / "train.safetensors").stat().st_mtime_ns == before


def test_a_failing_write_leaves_nothing(tmp_path):
    with pytest.raises(TypeError):
        cache.write(tmp_path / "rpi-1", {"train": {"a": torch.zeros(1)}}, {"seed": object()}, {})
    assert not list(tmp_path.iterdir())


def test_a_missing_set_is_refused_with_the_command(tmp_path):
    with pytest.raises(
        cache.CacheError,
        match=r"^no own-set data at .*own-set-9; make it with `epo generate data=rpi`$",
    ):
        cache.load(tmp_path / "own-set-9", "train", command=COMMAND)
    assert issubclass(cache.CacheError, ConfigError)


def truncated(folder):
    path = folder / "train.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    return r"train.safetensors has \d+ bytes instead of \d+"


def truncated_test(folder):
    path = folder / "test.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    return r"test.safetensors has \d+ bytes instead of \d+"


def altered(folder):
    path = folder / "train.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    return "train.safetensors has the right size but not the checksum"


def deleted(folder):
    (folder / "train.safetensors").unlink()
    return "train.safetensors is missing"


def without_manifest(folder):
    (folder / "manifest.json").unlink()
    return "manifest.json is missing"


def with_broken_manifest(folder):
    (folder / "manifest.json").write_text("{")
    return "manifest.json is not a readable manifest"


def with_a_broken_entry(folder):
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "files": {**content["files"], "test.safetensors": {}}}))
    return "manifest.json is not a readable manifest"


def of_another_format(folder):
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format": 99}))
    return "manifest.json has format 99, this version reads format 1"


def with_another_configuration(folder):
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "config": {"seed": 2}}))
    return "manifest.json was altered"


@pytest.mark.parametrize(
    "damage",
    [
        truncated,
        truncated_test,
        altered,
        deleted,
        without_manifest,
        with_broken_manifest,
        with_a_broken_entry,
        of_another_format,
        with_another_configuration,
    ],
)
def test_damage_is_named_and_not_overwritten(folder, damage):
    message = damage(folder)
    for use in (
        lambda: cache.load(folder, "train", command=COMMAND),
        lambda: cache.write(folder, {"train": {"a": torch.zeros(1)}}, {"seed": 1}, {}),
    ):
        with pytest.raises(cache.CacheError, match=message) as error:
            use()
        assert "delete the folder" in str(error.value)
        assert "\n" not in str(error.value)


def test_numbers_that_are_not_finite_are_located(tmp_path):
    states = torch.zeros(5, 2, 3)
    states[3, 1, 0] = float("nan")
    folder = cache.write(tmp_path / "rpi-1", {"val": {"states": states}}, {}, {})
    with pytest.raises(
        cache.CacheError, match=r"split 'val' in .*: tensor 'states' is not finite in 1 records, first 3"
    ):
        cache.load(folder, "val")


def test_an_unknown_split_is_refused(folder):
    with pytest.raises(cache.CacheError, match="has no split 'valid'; it has test, train"):
        cache.load(folder, "valid")


def test_root_follows_the_environment(monkeypatch):
    monkeypatch.setenv("EPO_CACHE", "elsewhere")
    assert str(cache.default_root()) == "elsewhere"
    monkeypatch.delenv("EPO_CACHE")
    assert str(cache.default_root()) == "cache"


def test_a_data_set_of_another_configuration_is_refused(folder):
    """A folder that was copied or renamed holds sound files, but not those that were asked for."""
    asked = {"seed": 2, "sizes": [1]}
    for use in (
        lambda: cache.manifest(folder, config=asked),
        lambda: cache.load(folder, "train", config=asked),
        lambda: cache.verify(folder, config=asked),
        lambda: cache.write(folder, {"train": {"a": torch.zeros(1)}}, asked, {}),
    ):
        with pytest.raises(
            cache.CacheError, match=r"another configuration: it differs in seed \(1 instead of 2\), sizes;"
        ):
            use()
    assert len(cache.load(folder, "train", config={"seed": 1})) == 2


@pytest.mark.parametrize(("umask", "folders", "files"), [(0o077, 0o700, 0o600), (0o002, 0o775, 0o664)])
def test_permissions_follow_the_umask(tmp_path, umask, folders, files):
    before = os.umask(umask)
    try:
        with cache.locked(tmp_path / "rpi-1"):
            made = cache.write(tmp_path / "rpi-1", {"train": {"a": torch.zeros(1)}}, {}, {})
        cache.write_file(tmp_path / "part", b"1")
    finally:
        os.umask(before)
    assert stat.S_IMODE(made.stat().st_mode) == folders
    for path in (*made.iterdir(), tmp_path / "part", tmp_path / ".rpi-1.lock"):
        assert stat.S_IMODE(path.stat().st_mode) == files, path.name


def test_leftovers_of_a_killed_process_are_removed(tmp_path):
    (tmp_path / ".rpi-1-unfinished").mkdir()
    (tmp_path / ".rpi-1-unfinished" / "train.safetensors").write_bytes(b"half")
    cache.verify(cache.write(tmp_path / "rpi-1", {"val": {"a": torch.zeros(1)}}, {}, {}))
    assert [path.name for path in tmp_path.iterdir()] == ["rpi-1"]


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as the operating system does, without a name

    def full_too(*_):
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr("epo_lightning.files.os.fsync", full)
    monkeypatch.setattr(cache, "save_file", full_too)
    for use, name in (
        (lambda: cache.write_file(tmp_path / "game", b"1"), "game"),
        (lambda: cache.write(tmp_path / "rpi-1", {"val": {"a": torch.zeros(1)}}, {}, {}), "rpi-1"),
    ):
        with pytest.raises(OSError, match=r"No space left on device.*make room") as error:
            use()
        assert error.value.filename == str(tmp_path / name)
        assert not list(tmp_path.iterdir())


def test_a_worker_whose_folder_was_deleted_does_not_make_it_again(tmp_path):
    with pytest.raises(FileNotFoundError) as error:
        cache.write_file(tmp_path / "parts" / "0", b"1")
    assert error.value.filename == str(tmp_path / "parts" / "0")
    assert not list(tmp_path.iterdir())


def test_a_path_that_cannot_be_looked_at_is_refused_with_advice(tmp_path):
    """Looking for a link in such a path fails like the write itself."""
    folder = tmp_path / ("x" * 300)
    with (
        pytest.raises(OSError, match=r"cannot write .*set data\.root to another folder; finished work is kept"),
        cache.writing(folder),
    ):
        folder.mkdir()


@pytest.mark.parametrize("place", ["cache", "cache/rpi-1"])
def test_a_link_to_nowhere_is_named_with_its_remedy(tmp_path, place):
    link = tmp_path / place
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path / "gone")
    folder = tmp_path / "cache" / "rpi-1"

    def make():
        cache.write(folder, {"val": {"a": torch.zeros(1)}}, {}, {})

    with pytest.raises(
        OSError, match=rf"{place} is a link to .*gone, which does not exist: make that folder, or remove"
    ):
        cache.make_once(folder, make)


def test_a_process_waits_while_another_one_makes_the_folder(tmp_path):
    code = (
        "import pathlib\n"
        "from epo_lightning.data import cache\n"
        f"folder = pathlib.Path({str(tmp_path / 'set')!r})\n"
        "print(cache.make_once(folder, folder.mkdir))\n"
    )
    with cache.locked(tmp_path / "set"):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=PIPE, stderr=PIPE, text=True)
        assert "set is being made by another process: waiting for it" in process.stderr.readline()
        assert [path.name for path in tmp_path.iterdir()] == [".set.lock"]
        (tmp_path / "set").mkdir()
    assert process.communicate(timeout=60) == ("False\n", "")


def test_a_script_that_its_worker_runs_again_is_refused_instead_of_waiting_for_itself(tmp_path, monkeypatch):
    # Python sets this in a spawned process while it imports the main module.
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(RuntimeError, match="__main__"):
        cache.make_once(tmp_path / "set", lambda: None)


def test_an_empty_name_of_the_root_in_the_environment_is_none(monkeypatch):
    monkeypatch.setenv("EPO_CACHE", "")
    assert str(cache.default_root()) == "cache"


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        *((number, "set data.root to a folder that can be written") for number in (errno.EACCES, errno.EROFS)),
        *((number, "make room, or set data.root to another folder") for number in (errno.ENOSPC, errno.EDQUOT)),
    ],
)
def test_the_advice_fits_the_reason_for_which_nothing_can_be_written(tmp_path, number, advice):
    with pytest.raises(OSError, match=advice) as error, cache.writing(tmp_path / "a"):
        raise OSError(number, os.strerror(number))
    assert error.value.errno == number


def test_a_manifest_names_the_versions_that_made_the_data_set(folder):
    assert cache.manifest(folder)["packages"] == cache.versions()
    assert {"python", "torch", "numpy"} <= cache.versions().keys()


def test_a_data_set_that_was_renamed_is_not_found_in_the_cache(tmp_path):
    config = {"seed": 1}
    made = cache.write(tmp_path / f"rpi-{cache.digest(config)[:12]}", {"val": {"a": torch.zeros(1)}}, config, {})
    assert cache.configs(tmp_path, "rpi") == [(made, config)]
    made.rename(tmp_path / "rpi-copy")
    assert not cache.configs(tmp_path, "rpi")
