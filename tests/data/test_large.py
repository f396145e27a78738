"""Splits that may not fit in memory: mapped and checked once, and read in blocks; the scenes are those of a small split."""

from __future__ import annotations

import mmap
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from data.recorded.test_parts import tables
from epo_lightning.data import cache, datamodule
from epo_lightning.data.datamodule import BatchSampler, Share, epoch_generator, order_in_blocks
from epo_lightning.data.mapped import mapped, not_finite, read_ahead
from epo_lightning.data.recorded import scenes as scenes_module
from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.tables import joined


@pytest.fixture
def columns() -> dict[str, torch.Tensor]:
    draw = np.random.default_rng(0)
    found = joined([tables(draw, 3, True) for _ in range(40)]).columns()
    return {name: torch.from_numpy(values) for name, values in found.items()}


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every file and every split counts as large."""
    monkeypatch.setattr(cache, "LARGE", 1)
    monkeypatch.setattr(scenes_module, "LARGE", 1)
    monkeypatch.setattr(scenes_module, "BLOCK", 1500)
    monkeypatch.setattr(datamodule, "TOGETHER", 3)


def written(root: Path, columns: dict[str, torch.Tensor]) -> Path:
    return cache.write(root / "roads-1", {"train": columns, "val": {"a": torch.ones(3)}}, {"seed": 1}, {})


def test_mapped_tensors_are_those_of_the_package(tmp_path, columns):
    path = written(tmp_path, columns) / "train.safetensors"
    found = mapped(path, list(columns))
    assert set(found) == set(columns)
    for name, tensor in columns.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)
        read_ahead(found[name][1:])


def test_the_system_is_asked_for_all_pages_of_a_piece_and_for_none_of_an_empty_one(tmp_path, columns, monkeypatch):
    file = mapped(written(tmp_path, columns) / "train.safetensors", ["history", "kind"])
    asked: list[tuple[int, int, int]] = []
    system = SimpleNamespace(madvise=lambda begin, size, advice: asked.append((begin.value, size.value, advice)))
    monkeypatch.setattr("epo_lightning.data.mapped.ctypes.CDLL", lambda _: system)
    for piece in (file["history"][2:5], file["kind"][1:], file["history"]):
        read_ahead(piece)
        begin, size, advice = asked.pop()
        assert begin % mmap.PAGESIZE == 0
        assert 0 <= piece.data_ptr() - begin < mmap.PAGESIZE
        assert begin + size == piece.data_ptr() + piece.numel() * piece.element_size()
        assert advice == mmap.MADV_WILLNEED
    read_ahead(file["history"][:0])
    assert not asked
    del system.madvise
    read_ahead(file["history"])  # a system without this call


@pytest.mark.usefixtures("large")
def test_a_large_file_is_checked_once_and_again_when_it_changes(tmp_path, columns, monkeypatch):
    folder = written(tmp_path, columns)
    file, digests = folder / "train.safetensors", []
    digest = cache.file_digest
    monkeypatch.setattr(cache, "file_digest", lambda path: digests.append(path.name) or digest(path))
    for _ in range(2):
        assert torch.equal(cache.load(folder, "train")["history"], columns["history"])
    assert digests == ["train.safetensors"]
    cache.load(folder, "val")
    assert digests == ["train.safetensors", "val.safetensors"], "files are remembered one by one"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    os.utime(file, (1, 1))
    with pytest.raises(cache.CacheError, match="not the checksum of its manifest"):
        cache.load(folder, "train")


@pytest.mark.usefixtures("large")
def test_a_large_file_with_numbers_that_are_not_finite_is_never_accepted(tmp_path, columns):
    columns["centre"][5, 1] = torch.inf
    folder = written(tmp_path, columns)
    for _ in range(2):
        with pytest.raises(cache.CacheError, match="'centre' is not finite in 1 records, first 5"):
            cache.load(folder, "train")


def test_numbers_are_checked_piece_by_piece(monkeypatch):
    monkeypatch.setattr("epo_lightning.data.mapped.PIECE", 24)
    values = torch.zeros(11, 3)
    assert not_finite(values) == (0, -1)
    values[4, 1] = values[4, 2] = values[5, 0] = values[9, 0] = torch.nan
    assert not_finite(values) == (3, 4)
    assert not_finite(values[:, 0]) == (2, 5)
    assert not_finite(torch.zeros(0, 3)) == (0, -1)


@given(count=st.integers(1, 200), block=st.integers(1, 30), seed=st.integers(0, 99))
def test_an_order_in_blocks_has_every_scene_once_and_few_blocks_at_a_time(count, block, seed):
    order, groups = order_in_blocks(count, block, epoch_generator(seed, 3))
    again, _ = order_in_blocks(count, block, epoch_generator(seed, 3))
    assert torch.equal(order, again)
    assert sorted(order.tolist()) == list(range(count))
    begin = 0
    for group in groups:
        assert len(group) <= datamodule.TOGETHER
        size = sum(min(block, count - number * block) for number in group.tolist())
        assert set((order[begin : begin + size] // block).tolist()) == set(group.tolist())
        begin += size


@pytest.mark.usefixtures("large")
def test_scenes_of_a_large_split_are_read_ahead_of_their_batches_and_are_the_same(tmp_path, columns, monkeypatch):
    data = RecordedScenes(cache.load(written(tmp_path, columns), "train"), 0.2, "aligned", [""] * 40)
    block = data.block
    assert block is not None
    assert len(data) > 4 * datamodule.TOGETHER * block, "several groups"
    asked: set[int] = set()
    known = data.read_ahead
    monkeypatch.setattr(data, "read_ahead", lambda a, b: asked.update(range(a, b + 1)) or known(a, b))
    sampler = BatchSampler(data, 2, shuffle=True, seed=0)
    seen = []
    for epoch in range(2):
        sampler.set_epoch(epoch)
        asked.clear()
        seen.append([])
        for number, indices in enumerate(sampler):
            assert set(indices.tolist()) <= asked, "a batch is used after its scenes were asked for"
            ahead = (number * 2 // (datamodule.TOGETHER * block) + 2) * datamodule.TOGETHER * block - block
            assert len(asked) >= min(len(data), ahead), "the next blocks were asked for"
            assert len(asked) <= (number * 2 // (datamodule.TOGETHER * block) + 3) * datamodule.TOGETHER * block
            seen[-1] += indices.tolist()
    assert seen[0] != seen[1]
    assert sorted(seen[0]) == sorted(set(seen[0]))
    assert len(seen[0]) == len(sampler) * 2
    small = RecordedScenes(columns, 0.2, "aligned", [""] * 40)
    small.block = None
    indices = torch.tensor(seen[0][:7])
    for name, value in vars(small[indices]).items():
        other = getattr(data[indices], name)
        assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other
    in_order = BatchSampler(data, 2, shuffle=False, seed=0)
    assert torch.equal(torch.cat(list(in_order)), torch.arange(len(data)))


@pytest.mark.parametrize(("first", "last"), [(0, 0), (3, 9), (17, 17), (40, -1)])
def test_all_rows_of_the_scenes_that_are_read_ahead_are_asked_for_and_no_others(columns, monkeypatch, first, last):
    asked: dict[str, set[int]] = {}

    def ask(piece: torch.Tensor) -> None:
        (name,) = (name for name, tensor in columns.items() if tensor.data_ptr() <= piece.data_ptr() < end_of(tensor))
        begin = (piece.data_ptr() - columns[name].data_ptr()) // columns[name][:1].nbytes
        asked.setdefault(name, set()).update(range(begin, begin + len(piece)))

    def end_of(tensor: torch.Tensor) -> int:
        return tensor.data_ptr() + tensor.nbytes

    columns["lanes"][17] = -1  # a scene without lanes
    scenes = list(range(first, last + 1 if last >= 0 else len(columns["agents"])))
    monkeypatch.setattr(scenes_module, "read_ahead", ask)
    RecordedScenes(columns, 0.2, "aligned", [""] * 40).read_ahead(scenes[0], scenes[-1])
    rows = {name: [row for row in columns[name][scenes].flatten().tolist() if row >= 0] for name in ("agents", "lanes")}
    between = {name: set(range(min(used), max(used) + 1)) if used else set() for name, used in rows.items()}
    of_agents = ("history", "history_mask", "future", "future_mask", "size", "kind", "track")
    of_agents += ("candidates", "references", "reference_speed", "lines")
    expected = {name: set(scenes) for name in ("agents", "lanes", "centre", "direction", "recording", "frame")}
    expected |= {"polylines": between["lanes"], **dict.fromkeys(of_agents, between["agents"])}
    assert asked == {name: wanted for name, wanted in expected.items() if wanted}


@pytest.mark.usefixtures("large")
@pytest.mark.parametrize("part", [0.5, 0.97])  # in the second one, the last block is not full
def test_a_share_of_a_large_split_is_read_in_blocks(tmp_path, columns, monkeypatch, part):
    data = RecordedScenes(cache.load(written(tmp_path, columns), "train"), 0.2, "aligned", [""] * 40)
    share, asked = Share(data, part), set()
    assert share.block == round(data.block * len(share) / len(data))
    monkeypatch.setattr(data, "read_ahead", lambda a, b: asked.update(range(a, b + 1)))
    for indices in BatchSampler(share, 2, shuffle=True, seed=0):
        assert set(share.chosen[indices].tolist()) <= asked


def test_a_small_split_is_shuffled_as_a_whole(columns, monkeypatch):
    data = RecordedScenes(columns, 0.2, "aligned", [""] * 40)
    assert data.block is None
    size = sum(tensor.nbytes for tensor in columns.values())
    for limit, block in ((size, 10), (size + 1, None)):
        monkeypatch.setattr(scenes_module, "LARGE", limit)
        monkeypatch.setattr(scenes_module, "BLOCK", size * 10 // len(data) + 1)
        assert RecordedScenes(columns, 0.2, "aligned", [""] * 40).block == block
    order = torch.cat(list(BatchSampler(data, 1, shuffle=True, seed=5)))
    assert torch.equal(order, torch.randperm(len(data), generator=epoch_generator(5, 0)))


@pytest.mark.usefixtures("large")
def test_a_large_file_of_which_some_columns_were_read_is_not_known_to_be_finite(tmp_path, columns):
    columns["centre"][5, 1] = torch.inf
    folder = written(tmp_path, columns)
    cache.load(folder, "train", ("direction",))
    with pytest.raises(cache.CacheError, match="'centre' is not finite in 1 records"):
        cache.load(folder, "train")
