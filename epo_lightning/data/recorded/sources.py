"""Recordings of a folder: their listing with the options of a format, and the fingerprints of their files."""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.registry import ConfigError, lookup, nearest

PIECE, PIECES = 1 << 14, 64
"""Size [bytes] and number of the pieces of a file that enter its checksum; files up to 1 MB are covered completely."""


def with_options(format: str, options: Mapping[str, Any]) -> Callable[[Path], list[RecordingSource]]:
    """The function that lists the recordings of a format, with the options of the format.

    Raises:
        ConfigError: an unknown format, or an option that it does not have.
    """
    list_sources = lookup("format", format)
    known = list(inspect.signature(list_sources).parameters)[1:]
    for name in options:
        if name not in known:
            raise ConfigError(f"unknown key data.options.{name} for format {format!r}: {nearest(name, known)}")
    return partial(list_sources, **options)


def absent() -> Recording:
    """Stand-in for the reader of a recording whose files are absent.

    Raises:
        ConfigError: always.
    """
    raise ConfigError("the recordings are absent: only the data set that was extracted from them exists")


def fingerprint(file: Path) -> list[Any]:
    """Name, size and checksum of a file. In large files only evenly spaced pieces are read, because they have gigabytes."""
    size, checksum = file.stat().st_size, 0
    with file.open("rb") as content:
        for place in range(0, size, max(PIECE, (size - PIECE) // PIECES)):
            content.seek(place)
            checksum = zlib.crc32(content.read(PIECE), checksum)
    return [file.name, size, checksum]
