"""Parts of a data set of recordings: files of consecutive recordings, which processes and machines extract independently.

A part is complete or absent, so that any number of jobs may work on the parts of one folder at the same time, and a job
that is killed loses only the part that it works on. The data set is then made of the parts in the order of the recordings,
and so its bytes do not depend on the jobs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from safetensors import safe_open

from epo_lightning.data.cache import CacheError
from epo_lightning.data.recorded.duplicates import Drives
from epo_lightning.data.recorded.extraction import RAW, Extracted, extract_to_file, outcomes
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.data.workers import Report, finished

MOST = 10_000
"""Largest number of parts: file systems slow down with millions of files."""


class PartTask(NamedTuple):
    """Arguments of :func:`~epo_lightning.data.recorded.extraction.extract_to_file`, which explains them."""

    sources: Sequence[RecordingSource]
    windows: WindowConfig
    has_map: bool
    file: Path
    strict: bool
    keep: bool


Launch = Callable[[Sequence[PartTask], Report], None]
"""Function that has parts extracted and reports them, and returns when all of them are there."""
Value = TypeVar("Value")


class Parts:
    """The parts of a data set: one file per recording, or per some recordings if there are more than ``MOST``.

    Args:
        folder: folder of the files.
        sources: the recordings, in order.
    """

    def __init__(self, folder: Path, sources: Sequence[RecordingSource]) -> None:
        self.folder = folder
        self.size = max(1, -(-len(sources) // MOST))
        self.members = [sources[first : first + self.size] for first in range(0, len(sources), self.size)]
        self.files = [folder / f"{number:05d}.safetensors" for number in range(len(self.members))]
        self._place = {source.name: divmod(index, self.size) for index, source in enumerate(sources)}
        self._open: tuple[Path, Any] | None = None

    def missing(self) -> list[int]:
        """Numbers of the parts that are absent, unreadable, or have a recording that could not be read.

        The files of the latter are deleted, so that afterwards a part is done if its file is there.
        """
        found = []
        for number, file in enumerate(self.files):
            known = outcomes(file)
            if known is None or any(outcome.problem is not None for outcome in known):
                file.unlink(missing_ok=True)
                found.append(number)
        return found

    def tasks(self, windows: WindowConfig, has_map: bool, strict: bool, keep: bool) -> list[PartTask]:
        """The missing parts, each as the arguments of the function that extracts it."""
        return [
            PartTask(self.members[number], windows, has_map, self.files[number], strict, keep)
            for number in self.missing()
        ]

    def extract(self, tasks: Sequence[PartTask], workers: int | None, progress: bool, launch: Launch | None) -> None:
        """Extract parts into their files.

        Args:
            tasks: the parts, see :meth:`tasks`.
            workers: processes; None for one per core.
            progress: whether to report progress.
            launch: function that has the parts extracted by jobs elsewhere; None for processes of this machine.

        Raises:
            CacheError: a worker was killed.
        """
        unit, before = "recording" if self.size == 1 else "part", len(self.files) - len(tasks)
        report = Report(tasks, lambda task: task.file, unit, "extracting", "extracted", before, progress)
        if launch and tasks:
            launch(tasks, report)
        else:
            for _ in finished(
                extract_to_file, tasks, workers, report, f"finished recordings are kept in {self.folder}"
            ):
                pass

    def extracted(self) -> dict[str, Extracted]:
        """Outcome of every recording by name.

        Raises:
            CacheError: a part is absent or unreadable.
        """
        found: dict[str, Extracted] = {}
        for file, members in zip(self.files, self.members, strict=True):
            known = outcomes(file)
            if known is None:
                raise CacheError(f"{file} is missing or cannot be read: run the same command again")
            found.update(zip((source.name for source in members), known, strict=True))
        return found

    def tables(self, name: str) -> SceneTables | None:
        """The scenes of a recording; None if it has none."""
        columns = self._columns(name, lambda word: not word.startswith(f"{RAW} "))
        return SceneTables(**columns) if columns else None

    def lanes(self, name: str) -> int:
        """Number of lanes per scene of a recording with scenes."""
        content, before = self._content(name)
        return int(content.get_slice(f"{before}lanes").get_shape()[1])

    def drives(self, name: str) -> Drives:
        """The recorded rows of a recording, which must have been kept."""
        columns = self._columns(name, lambda word: word.startswith(f"{RAW} "))
        return Drives.of({word.removeprefix(f"{RAW} "): values for word, values in columns.items()})

    def _columns(self, name: str, wanted: Callable[[str], bool]) -> dict[str, np.ndarray]:
        """Some columns of a recording by their names."""
        content, before = self._content(name)
        words = [key.removeprefix(before) for key in content.keys() if key.startswith(before)]  # noqa: SIM118
        return {word: content.get_tensor(before + word) for word in words if wanted(word)}

    def _content(self, name: str) -> tuple[Any, str]:
        """The opened file of a recording, and the first characters of the names of its columns."""
        part, number = self._place[name]
        if self._open is None or self._open[0] != self.files[part]:
            # Recordings are read in order, so that the last file is mostly the next one, too.
            self._open = self.files[part], safe_open(self.files[part], framework="np")
        return self._open[1], f"{number} "


class Lazy(Mapping[str, Value]):
    """Mapping whose values are read when they are asked for, and not kept.

    Args:
        names: the keys.
        read: function from a key to its value.
    """

    def __init__(self, names: Iterable[str], read: Callable[[str], Value]) -> None:
        self.names, self.read = dict.fromkeys(names), read

    def __getitem__(self, name: str) -> Value:
        if name not in self.names:
            raise KeyError(name)
        return self.read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)
