"""Recordings of a folder: their listing with the options of a format, and the fingerprints of their files.

A fingerprint is read from the file. Of many files, fingerprints are remembered in the cache together with the files' sizes
and times of change, because reading a million files would take longer than starting a training.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import json
import time
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

from epo_lightning.data import cache
from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.registry import ConfigError, lookup, place
from epo_lightning.schema import check_part

PIECE, PIECES = 1 << 14, 64
"""Size [bytes] and number of the pieces of a file that enter its checksum; files up to 1 MB are covered completely."""
MANY = 1000
"""Largest number of files that are all read again whenever their fingerprints are needed."""
RECENT = 10.0
"""Age [s] up to which a file's time of change is not trusted: another change may have the same time."""
THREADS = 8
"""Number of files that are read at once."""


SHIPPED = (
    "argoverse2",
    "commonroad",
    "crowd",
    "exid",
    "highd",
    "ind",
    "interaction",
    "round",
    "ucy",
    "unid",
    "waymo",
)
"""Formats of this package, whose changes are counted by the version of data sets."""


def code_of(format: str) -> str:
    """Hash of the file in which a format of one's own is defined, of which no version is known; empty for shipped formats.

    It is part of the identity of data sets, so that scenes of an earlier reader are not taken for those of a mended one.
    Lines that are empty or comments do not count, nor do other files that this one imports.
    """
    if format in SHIPPED:
        return ""
    part = inspect.unwrap(lookup("format", format))
    while isinstance(part, partial):
        part = inspect.unwrap(part.func)
    try:
        file = inspect.getfile(part if inspect.isroutine(part) or inspect.isclass(part) else type(part))
        lines = Path(file).read_text(encoding="utf-8").splitlines()
    except (OSError, TypeError, UnicodeDecodeError):  # defined in an interactive session
        return ""
    kept = [line.rstrip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    return hashlib.sha256("\n".join(kept).encode()).hexdigest()[:12]


def with_options(format: str, options: Mapping[str, Any]) -> Callable[[Path], list[RecordingSource]]:
    """The function that lists the recordings of a format, with the options of the format.

    Raises:
        ConfigError: an unknown format, an option that it does not have, or a value of another type than the option's.
    """
    list_sources = lookup("format", format)
    folder = next(iter(inspect.signature(list_sources).parameters))
    check_part("format", {"name": format, **options}, [folder], "data.options")
    return partial(list_sources, **options)


def listed(
    list_sources: Callable[[Path], list[RecordingSource]], folder: Path, *, dataset: str, format: str, root: Path
) -> list[RecordingSource]:
    """The recordings of a folder, sorted by name.

    Args:
        list_sources: function that lists them, see :func:`with_options`.
        folder: the folder.
        dataset, format, root: name of the data set, name of its format and folder of the cache, for messages.

    Raises:
        ConfigError: the folder is missing or holds no recording, the function returns something else, or the name of a file
            is not UTF-8.
    """
    if folder.is_file():
        raise ConfigError(f"{folder} is a file: data.folder takes the folder that it lies in")
    if not folder.is_dir():
        raise ConfigError(
            f"no folder {folder} with {dataset} recordings, and no data set that was extracted from such "
            f"recordings in {root}: point data.folder at the recordings, or unpack them there"
        )
    found = sorted(_checked(list_sources(folder), format), key=lambda source: source.name)
    if not found:
        raise ConfigError(f"{folder} holds no recording in the format {format!r}: is it the right folder?")
    _check_names(found)
    return found


def _checked(returned: Any, format: str) -> list[RecordingSource]:
    """Recordings that the function of a format returned.

    Raises:
        ConfigError: it returned something else; the message names its file.
    """
    what = "None" if returned is None else type(returned).__name__
    if isinstance(returned, Iterable):
        found = list(returned)
        others = {type(entry).__name__ for entry in found if not isinstance(entry, RecordingSource)}
        if not others:
            return found
        what += f" of {', '.join(sorted(others))}"
    raise ConfigError(
        f"{place(lookup('format', format))}: format {format!r} returned {what}; a list of RecordingSource was expected"
        + (": is a return missing?" if returned is None else "")
    )


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


def fingerprints(files: Sequence[Path], root: Path) -> dict[Path, list[Any]]:
    """Fingerprint of every file.

    Of more than ``MANY`` files, those are not read whose size and time of change are the remembered ones.

    Args:
        files: the files.
        root: folder of the cache, in which fingerprints are remembered.
    """
    if len(files) <= MANY:
        return {file: fingerprint(file) for file in files}
    paths = [str(file.absolute()) for file in files]
    memo = root / f".fingerprints-{hashlib.sha256(min(paths).encode()).hexdigest()[:12]}.json"
    known: dict[str, list[int]] = {}
    with contextlib.suppress(OSError, ValueError, TypeError):
        known = dict(json.loads(memo.read_text(encoding="utf-8")))

    def entry(file: Path, path: str) -> list[int]:
        """Size, time of change [ns] and checksum of a file."""
        found = file.stat()
        remembered = known.get(path)
        if remembered and remembered[:2] == [found.st_size, found.st_mtime_ns]:
            return remembered
        return [found.st_size, found.st_mtime_ns, fingerprint(file)[2]]

    with ThreadPool(THREADS) as pool:
        entries = pool.starmap(entry, zip(files, paths, strict=True), chunksize=64)
    before = (time.time() - RECENT) * 1e9
    kept = {path: entry for path, entry in zip(paths, entries, strict=True) if entry[1] < before}
    if kept != known:
        with contextlib.suppress(OSError):  # a cache may be read-only once its data sets are made
            root.mkdir(parents=True, exist_ok=True)
            cache.write_file(memo, json.dumps(kept).encode())
    return {file: [file.name, size, checksum] for file, (size, _, checksum) in zip(files, entries, strict=True)}


def _check_names(sources: Sequence[RecordingSource]) -> None:
    """Refuse names that cannot be written.

    Raises:
        ConfigError: the name of a file is not UTF-8.
    """
    for source in sources:
        try:
            source.name.encode()
        except UnicodeEncodeError:
            raise ConfigError(f"the name of the recording {source.name!a} is not UTF-8: rename its files") from None


def altered(before: Sequence[Any], now: Sequence[Any]) -> list[str]:
    """Names of the recordings whose files differ between two identities of the same recordings."""
    return [entry[0] for entry, its in zip(before, now, strict=True) if entry != its]


def warn_of_copies(sources: Sequence[RecordingSource], identity: Sequence[Any]) -> None:
    """Warn of recordings that have the same content in files of their own."""
    first: dict[str, RecordingSource] = {}
    copies = []
    for source, (_, _, files) in zip(sources, identity, strict=True):
        one = first.setdefault(json.dumps([[size, checksum] for _, size, checksum in files]), source)
        if one.files != source.files:  # the recordings of a shard have its file in common
            copies.append(f"{source.name} of {one.name}")
    if copies:
        warnings.warn(
            f"{len(copies)} recordings are copies of others and may be in other splits ({', '.join(copies[:3])}): remove "
            "them, or choose data.duplicates=once",
            stacklevel=3,
        )
