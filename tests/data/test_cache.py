"""A set is complete and sound, or there is one sentence that says what, where and what to do."""

from __future__ import annotations

import json

import pytest
import torch

from epo_lightning.data import cache
from epo_lightning.registry import ConfigError

COMMAND = "epo generate data=rpi"


@pytest.fixture
def folder(tmp_path):
    splits = {name: {"a": torch.arange(6.0).view(3, 2), "b": torch.arange(3)} for name in ("train", "test")}
    return cache.write(tmp_path / "rpi-123", splits, {"seed": 1}, {"size": 3})


def test_round_trip(folder):
    tensors = cache.load(folder, "train")
    assert torch.equal(tensors["a"], torch.arange(6.0).view(3, 2))
    assert torch.equal(tensors["b"], torch.arange(3))
    assert list(cache.load(folder, "test", ("b",))) == ["b"]
    manifest = cache.manifest(folder)
    assert (manifest["report"], manifest["config"]) == ({"size": 3}, {"seed": 1})
    assert manifest["hash"] == cache.digest({"seed": 1})
    assert [path.name for path in folder.parent.iterdir()] == ["rpi-123"], "a temporary folder was left behind"


def test_a_sound_set_is_never_written_again(folder):
    before = (folder / "train.safetensors").stat().st_mtime_ns
    cache.write(folder, {"train": {"a": torch.zeros(1)}}, {"seed": 2}, {})
    assert (folder / "train.safetensors").stat().st_mtime_ns == before


def test_a_failing_write_leaves_nothing(tmp_path):
    with pytest.raises(TypeError):
        cache.write(tmp_path / "rpi-1", {"train": {"a": torch.zeros(1)}}, {"seed": object()}, {})
    assert not list(tmp_path.iterdir())


def test_missing(tmp_path):
    with pytest.raises(cache.CacheError, match=r"^no RPI data at .*rpi-9; make it with `epo generate data=rpi`$"):
        cache.load(tmp_path / "rpi-9", "train", command=COMMAND)
    assert issubclass(cache.CacheError, ConfigError)


def truncated(folder):
    path = folder / "train.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    return r"train.safetensors has \d+ bytes instead of \d+"


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


def of_another_format(folder):
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format": 99}))
    return "manifest.json has format 99, this version reads format 1"


@pytest.mark.parametrize(
    "damage", [truncated, altered, deleted, without_manifest, with_broken_manifest, of_another_format]
)
def test_damage_is_named_and_not_overwritten(folder, damage):
    message = damage(folder)
    for use in (
        lambda: cache.load(folder, "train", command=COMMAND),
        lambda: cache.write(folder, {"train": {"a": torch.zeros(1)}}, {}, {}),
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


def test_unknown_split(folder):
    with pytest.raises(cache.CacheError, match="has no split 'valid'; it has test, train"):
        cache.load(folder, "valid")


def test_root_follows_the_environment(monkeypatch):
    monkeypatch.setenv("EPO_CACHE", "elsewhere")
    assert str(cache.default_root()) == "elsewhere"
    monkeypatch.delenv("EPO_CACHE")
    assert str(cache.default_root()) == "cache"
