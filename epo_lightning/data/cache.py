"""Data sets on disk: one folder per configuration, named by the hash of that configuration and never incomplete.

A data set is a folder ``<kind>-<hash12>/`` with one ``.safetensors`` file per split and a ``manifest.json`` that records the
configuration and every file's size and SHA-256. The folder is assembled under a hidden name beside its final place and then
renamed, so a reader never sees an incomplete one. An existing folder is never written into: a broken one is reported, and
the user decides whether to delete it.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import json
import multiprocessing
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from epo_lightning.data.mapped import mapped, not_finite
from epo_lightning.files import write_file as write_whole_file
from epo_lightning.registry import ConfigError

FORMAT = 1
"""Version of the layout. A data set of another version is refused."""
MANIFEST = "manifest.json"
LARGE = 1 << 31
"""Size [bytes] from which on a split's file is memory-mapped, and its checksum computed only once."""
SPLITS = ("train", "val", "test")
PACKAGES = ("epo_lightning", "numba", "numpy", "safetensors", "torch")


class CacheError(ConfigError):
    """Error for a data set that is missing, broken or of another configuration; names the file and the remedy."""


def default_root() -> Path:
    """Folder of the data sets unless a configuration names one: $EPO_CACHE, or ``cache`` in the current folder."""
    return Path(os.environ.get("EPO_CACHE") or "cache")


def digest(config: Mapping[str, Any]) -> str:
    """SHA-256 of a configuration of plain values; the order of its keys does not matter."""
    return hashlib.sha256(json.dumps(config, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that compute or write a data set."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Context with a lock on a folder, so that only one process at a time makes it.

    A second process prints that it waits, and waits; afterwards it must check again whether the folder exists. The lock is a
    file beside the folder; the operating system releases it when the process ends, for whatever reason.

    Raises:
        RuntimeError: a worker process executes the script that started it, as the script lacks a ``__main__`` guard.
    """
    # Such a worker would wait here for ever for the lock of its parent: the error of Python itself comes only later, when
    # the worker starts a process.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise RuntimeError("a script that generates data must do so below `if __name__ == '__main__':`")
    with writing(folder.parent):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder.with_name(f".{folder.name}.lock"))
        try:
            lock.acquire(timeout=0)
        except Timeout:
            print(f"{folder} is being made by another process: waiting for it", file=sys.stderr, flush=True)
            lock.acquire()
    try:
        yield
    finally:
        lock.release()


def make_once(folder: Path, make: Callable[[], Any]) -> bool:
    """Call ``make`` under the folder's lock, unless the folder exists; returns whether it was called.

    An existing folder is not locked, so that a cache may be read-only once its data sets are made.
    """
    if folder.exists():
        return False
    with locked(folder):
        if folder.exists():
            return False
        make()
        return True


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Context in which a failed write, for instance on a full disk, becomes an OSError that names ``path``.

    The operating system names no file when a disk is full, and safetensors does not even raise an OSError then.
    """
    try:
        yield
    except (OSError, SafetensorError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        number = (error.errno if isinstance(error, OSError) else None) or errno.EIO
        advice = "make room, or set data.root to another folder"
        if number in (errno.EEXIST, errno.ENOTDIR, errno.EACCES, errno.EROFS):
            advice = "set data.root to a folder that can be written"
        with suppress(OSError):  # of a folder that may not be searched, or of a name that is too long
            for link in (path, *path.parents):
                if link.is_symlink() and not link.exists():
                    advice = (
                        f"{link} is a link to {link.readlink()}, which does not exist: make that folder, or remove the "
                        "link"
                    )
        raise OSError(
            number, f"cannot write ({reason or error}): {advice}; finished work is kept", str(path)
        ) from error


def write_file(path: Path, content: bytes) -> None:
    """Write a file so that it is complete or absent, whenever the process is killed.

    Raises:
        OSError: the disk is full or read-only; the message names the file.
    """
    with writing(path):
        path.parent.stat()  # a worker that outlives its command must not make a deleted folder again
        write_whole_file(path, content)


def write(
    folder: Path,
    splits: Mapping[str, Mapping[str, Tensor]],
    config: Mapping[str, Any],
    report: Mapping[str, Any],
    texts: Mapping[str, str] | None = None,
) -> Path:
    """Write a data set, unless it exists already. The caller holds the lock of the folder, see :func:`locked`.

    Args:
        folder: final place of the data set.
        splits: tensors by name for every split; the first dimension is the record.
        config: plain values from which the data set was made.
        report: plain values that describe it.
        texts: further files for people, by name; they are not checked when the data set is read.

    Raises:
        CacheError: the folder exists, but holds a broken data set or one of another configuration.
        OSError: the disk is full or read-only.
    """
    if folder.exists():
        verify(folder, config=config)
        return folder
    work = folder.with_name(f".{folder.name}-unfinished")
    with writing(folder):
        shutil.rmtree(work, ignore_errors=True)  # files that a killed process left
        work.mkdir(parents=True)
        try:
            files = {}
            for split, tensors in splits.items():
                path = work / f"{split}.safetensors"
                path.touch()
                mode = path.stat().st_mode  # permissions by the umask; safetensors would make the file private
                save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path)
                path.chmod(mode)
                files[path.name] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
            manifest = {
                "format": FORMAT,
                "hash": digest(config),
                "config": config,
                "files": files,
                "packages": versions(),
                "report": report,
            }
            for name, text in (texts or {}).items():
                (work / name).write_text(text, encoding="utf-8")
            (work / MANIFEST).write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n", encoding="utf-8")
            work.replace(folder)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    return folder


def _broken(what: str, folder: Path, command: str) -> CacheError:
    return CacheError(
        f"{what}; delete the folder {folder} and make it again" + (f" with `{command}`" if command else "")
    )


def differing(asked: Any, found: Any, key: str = "") -> list[str]:
    """Descriptions of the entries in which two configurations differ, such as ``pool.seed (1 instead of 0)``."""
    if isinstance(asked, Mapping) and isinstance(found, Mapping):
        names = [name for name in sorted({*asked, *found}) if asked.get(name) != found.get(name)]
        return [line for name in names for line in differing(asked.get(name), found.get(name), f"{key}.{name}")]
    if isinstance(asked, Mapping | list | tuple) or isinstance(found, Mapping | list | tuple):
        return [key.lstrip(".")]
    return [f"{key.lstrip('.')} ({found!r} instead of {asked!r})"]


def manifest(folder: Path, command: str = "", config: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The manifest of a data set.

    Args:
        folder: folder of the data set.
        command: the command that makes the data set, for error messages.
        config: configuration that the data set must have been made from; None accepts any.

    Raises:
        CacheError: no data set, an unreadable manifest, one of another format, or of another configuration.
    """
    if not folder.is_dir():
        hint = f"; make it with `{command}`" if command else ""
        raise CacheError(f"no {folder.name.rpartition('-')[0]} data at {folder}{hint}")
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found, name = content["format"], content["hash"]
        [(facts["bytes"], facts["sha256"]) for facts in content["files"].values()], content["config"]
    except FileNotFoundError:
        raise _broken(f"{path} is missing, so the data beside it is not a complete data set", folder, command) from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _broken(f"{path} is not a readable manifest ({type(error).__name__}: {error})", folder, command) from None
    if found != FORMAT:
        raise _broken(f"{path} has format {found}, this version reads format {FORMAT}", folder, command)
    if name != digest(content["config"]):
        raise _broken(f"{path} was altered: its hash is not that of its configuration", folder, command)
    if config is not None and name != digest(config):
        keys = ", ".join(differing(json.loads(json.dumps(config)), content["config"])[:3])
        raise _broken(f"{folder} holds the data set of another configuration: it differs in {keys}", folder, command)
    return content


def is_set(folder: Path) -> bool:
    """Whether a folder is a data set, broken or not."""
    return (folder / MANIFEST).is_file() and any(folder.glob("*.safetensors"))


def configs(root: Path, kind: str) -> list[tuple[Path, dict[str, Any]]]:
    """Folders and configurations of the data sets of a kind in a cache, sorted by name; broken ones are left out."""
    found = []
    for folder in sorted(root.glob(f"{glob.escape(kind)}-*")):
        try:
            config = manifest(folder)["config"]
        except CacheError:
            continue
        if folder.name == f"{kind}-{digest(config)[:12]}":
            found.append((folder, config))
    return found


def verify_file(folder: Path, split: str, command: str = "", config: Mapping[str, Any] | None = None) -> Path:
    """The path of a split's file after a check of its checksum, and of the sizes of all files that exist.

    A checksum takes a few tenths of a second per 100 MB at most.

    The checksum of a large file that :func:`load` has checked is not computed again, unless the file has changed since.

    Raises:
        CacheError: as :func:`manifest`, or a file that is missing or truncated, or this one is altered.
    """
    files = manifest(folder, command, config)["files"]
    path = folder / f"{split}.safetensors"
    if path.name not in files:
        raise CacheError(f"{folder} has no split {split!r}; it has " + ", ".join(Path(name).stem for name in files))
    if not path.is_file():
        raise _broken(f"{path} is missing", folder, command)
    # Of all splits: a damaged test split is found before a training. One that was put away is missed when it is read.
    for file, expected in ((folder / name, facts["bytes"]) for name, facts in files.items()):
        if file.is_file() and file.stat().st_size != expected:
            raise _broken(f"{file} has {file.stat().st_size} bytes instead of {expected}", folder, command)
    checksum = files[path.name]["sha256"]
    if not _is_checked(path, checksum) and file_digest(path) != checksum:
        raise _broken(
            f"{path} has the right size but not the checksum of its manifest: it was altered", folder, command
        )
    return path


def verify(folder: Path, command: str = "", config: Mapping[str, Any] | None = None) -> None:
    """Check every file of a data set.

    Raises:
        CacheError: as :func:`verify_file`.
    """
    for name in manifest(folder, command, config)["files"]:
        verify_file(folder, Path(name).stem, command)


def load(
    folder: Path,
    split: str,
    names: tuple[str, ...] | None = None,
    command: str = "",
    config: Mapping[str, Any] | None = None,
) -> dict[str, Tensor]:
    """Tensors of a split, all of them or those in ``names``, after a check of the file and that all numbers are finite.

    The tensors of a large file are memory-mapped and must not be written to; the file need not fit in memory.

    Raises:
        CacheError: as :func:`verify_file`, or a number that is not finite.
    """
    path = verify_file(folder, split, command, config)
    large = path.stat().st_size >= LARGE
    try:
        with safe_open(path, framework="np" if large else "pt") as file:
            wanted = names or tuple(file.keys())
            tensors = mapped(path, wanted) if large else {name: file.get_tensor(name) for name in wanted}
    except SafetensorError as error:
        raise _broken(f"{path} cannot be read ({error})", folder, command) from None
    sha256 = manifest(folder)["files"][path.name]["sha256"] if large else ""
    if large and _is_checked(path, sha256):
        return tensors
    for name, tensor in tensors.items():
        if tensor.is_floating_point():
            count, first = not_finite(tensor)
            if count:
                raise _broken(
                    f"split {split!r} in {path}: tensor {name!r} is not finite in {count} records, first {first}",
                    folder,
                    command,
                )
    if large and names is None:
        _remember(path, sha256)
    return tensors


def _checks(path: Path) -> Path:
    """File beside a data set that remembers which of its large files were checked."""
    return path.parent.with_name(f".{path.parent.name}.checked.json")


def _state(path: Path, sha256: str) -> list[Any]:
    found = path.stat()
    return [found.st_size, found.st_mtime_ns, sha256]


def _is_checked(path: Path, sha256: str) -> bool:
    """Whether a large file was checked before and has not changed since."""
    if path.stat().st_size < LARGE:
        return False
    try:
        return bool(json.loads(_checks(path).read_text(encoding="utf-8")).get(path.name) == _state(path, sha256))
    except (OSError, ValueError, AttributeError):
        return False


def _remember(path: Path, sha256: str) -> None:
    """Remember that a large file was checked."""
    try:
        known = json.loads(_checks(path).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        known = {}
    with suppress(OSError):  # a cache may be read-only once its data sets are made
        write_file(_checks(path), json.dumps({**known, path.name: _state(path, sha256)}).encode())
