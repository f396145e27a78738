"""The scenes of all splits, gathered from those of their recordings, which need not fit in memory together."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from epo_lightning.data import cache
from epo_lightning.data.recorded.extraction import Extracted
from epo_lightning.data.recorded.parts import Parts
from epo_lightning.data.recorded.summary import by_unit, describe
from epo_lightning.data.recorded.surroundings import FAR
from epo_lightning.data.recorded.tables import INDEX_OF, SceneTables, shifted


class Spool:
    """Columns that grow by appended rows, each in a file of its own.

    Args:
        folder: folder of the files; it must not exist.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self._files: dict[str, BinaryIO] = {}
        self._rows: Counter[str] = Counter()
        self._like: dict[str, np.ndarray] = {}

    def append(self, columns: Mapping[str, np.ndarray]) -> None:
        """Append rows to some columns.

        Raises:
            ValueError: rows of another dtype or shape than those before.
        """
        for name, values in columns.items():
            if name not in self._files:
                self._files[name] = (self.folder / name).open("wb")
                self._like[name] = np.empty((0, *values.shape[1:]), values.dtype)
            like = self._like[name]
            if (values.dtype, values.shape[1:]) != (like.dtype, like.shape[1:]):
                raise ValueError(
                    f"rows of column {name!r} are {values.dtype} {list(values.shape[1:])}, and those before "
                    f"{like.dtype} {list(like.shape[1:])}"
                )
            self._files[name].write(np.ascontiguousarray(values).data)
            self._rows[name] += len(values)

    def columns(self) -> dict[str, np.ndarray]:
        """All columns, memory-mapped. Nothing can be appended afterwards."""
        found = {}
        for name, file in self._files.items():
            file.close()
            like = self._like[name]
            shape = (self._rows[name], *like.shape[1:])
            # r+, because torch warns of arrays that are read-only. Nothing writes to them.
            full = 0 not in shape
            found[name] = np.memmap(file.name, like.dtype, "r+", shape=shape) if full else np.empty(shape, like.dtype)
        return found


@contextmanager
def gathered(
    splits: Mapping[str, Sequence[str]],
    tables: Mapping[str, SceneTables | None],
    counts: Mapping[str, Mapping[str, int]],
    extracted: Mapping[str, Extracted],
    parts: Parts,
) -> Iterator[tuple[dict[str, dict[str, Tensor]], dict[str, dict[str, Any]]]]:
    """The scenes of every split and a report about them, as :func:`gather` gives them.

    The tensors are in files beside the parts, which are deleted at the end of the context.

    Args:
        splits: names of the recordings of each split.
        tables, counts, extracted: scenes, counts and outcome of each recording, as for :func:`gather`.
        parts: the parts of the data set.

    Raises:
        OSError: the disk is full or read-only.
    """
    folder = parts.folder / "columns"
    shutil.rmtree(folder, ignore_errors=True)  # files that a killed process left
    try:
        tensors, about = {}, {}
        with cache.writing(folder):
            for split, held in splits.items():
                widest = max(parts.lanes(name) for name in held if counts[name].get("scenes"))
                tensors[split], about[split] = gather(held, tables, counts, extracted, widest, folder / split)
        yield tensors, about
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def gather(
    names: Sequence[str],
    tables: Mapping[str, SceneTables | None],
    counts: Mapping[str, Mapping[str, int]],
    extracted: Mapping[str, Extracted],
    widest: int,
    folder: Path,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The scenes of a split as memory-mapped tensors, and a report about them.

    Args:
        names: recordings of the split, one or more with scenes.
        tables: scenes of each recording, which are asked for once, in the order of ``names``.
        counts: windows, windows that were left out by reason, and scenes of each recording.
        extracted: outcome of the extraction of each recording.
        widest: largest number of lanes of a scene of the split.
        folder: folder to make for the files of the tensors, which may be deleted when the tensors are no longer used.
    """
    total: Counter[str] = Counter()
    before = Counter(dict.fromkeys(INDEX_OF.values(), 0))
    spool = Spool(folder)
    for number, name in enumerate(names):
        total.update(counts[name])
        found = tables[name]
        if found is None:
            # A recording without scenes still has its place in the order of recordings.
            spool.append({"origin": np.zeros((1, 2))})
            continue
        columns = shifted(found, before, widest)
        columns["recording"] = np.full(len(found), number, dtype=np.int32)
        spool.append(columns)
        before.update({field: len(getattr(found, field)) for field in before})
    gathered = spool.columns()
    about = {**by_unit(total), **describe(SceneTables(**gathered))}
    moving = sum(extracted[name].about.get("moving agents", 0) for name in names)
    if moving:
        far = sum(extracted[name].about.get("ends far from lanes", 0) for name in names) / moving
        about[f"moving agents that end over {FAR:g} m from all lanes given"] = far
    return {name: torch.from_numpy(values) for name, values in gathered.items()}, about
