"""Sets of records on disk: one folder per configuration, named by its hash, complete or not there at all.

A set is ``<kind>-<hash12>/`` with one ``.safetensors`` file per split and a ``manifest.json`` that names every file's size
and SHA-256. It is assembled in a temporary folder beside it and renamed, so a reader never sees half of one. A folder that
exists is never written into: what is broken is reported, and deleting it is the user's decision.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from epo_lightning.registry import ConfigError

FORMAT = 1
"""Version of the layout. A set of another version is refused."""
MANIFEST = "manifest.json"
PACKAGES = ("epo_lightning", "numba", "numpy", "safetensors", "torch")


class CacheError(ConfigError):
    """A set that is missing or broken: the message says what, where and what to do."""


def default_root() -> Path:
    """Where sets are kept unless a configuration says otherwise: $EPO_CACHE, or ``cache`` in the current folder."""
    return Path(os.environ.get("EPO_CACHE") or "cache")


def digest(config: Mapping[str, Any]) -> str:
    """SHA-256 of a configuration of plain values; the order of its keys does not matter."""
    return hashlib.sha256(json.dumps(config, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """What made a set: Python and the packages that computed or wrote it."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Only one process at a time makes a folder; another waits, says so, and should look again whether it is there now.

    The lock beside the folder goes with the process that holds it, however that ends.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        print(f"{folder} is being made by another process: waiting for it", file=sys.stderr)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def write(
    folder: Path, splits: Mapping[str, Mapping[str, Tensor]], config: Mapping[str, Any], report: Mapping[str, Any]
) -> Path:
    """Write a set, unless it is there already.

    Args:
        folder: where it shall be.
        splits: tensors by name, records first, of every split by name.
        config: what the set was made from; plain values.
        report: what there is to say about it; plain values.

    Raises:
        CacheError: a folder is there, but not a sound set.
    """
    if folder.exists():
        verify(folder)
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        files = {}
        for split, tensors in splits.items():
            path = temporary / f"{split}.safetensors"
            save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path)
            path.chmod(0o644)
            files[path.name] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        manifest = {
            "format": FORMAT,
            "hash": digest(config),
            "config": config,
            "files": files,
            "packages": versions(),
            "report": report,
        }
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n")
        temporary.chmod(0o755)
        try:
            temporary.replace(folder)
        except OSError:
            if not folder.exists():
                raise
            verify(folder)  # somebody else finished the same set first
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder


def _broken(what: str, folder: Path, command: str) -> CacheError:
    return CacheError(
        f"{what}; delete the folder {folder} and make it again" + (f" with `{command}`" if command else "")
    )


def manifest(folder: Path, command: str = "") -> dict[str, Any]:
    """The manifest of a set.

    Args:
        folder: of the set.
        command: what makes the set, for error messages.

    Raises:
        CacheError: no set, an unreadable manifest, or one of another format.
    """
    if not folder.is_dir():
        kind = folder.name.partition("-")[0].upper()
        hint = f"; make it with `{command}`" if command else ""
        raise CacheError(f"no {kind} data at {folder}{hint}")
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text())
        found = content["format"]
        content["files"], content["config"]
    except FileNotFoundError:
        raise _broken(f"{path} is missing, so the data beside it is not a complete set", folder, command) from None
    except (ValueError, KeyError, TypeError) as error:
        raise _broken(f"{path} is not a readable manifest ({type(error).__name__}: {error})", folder, command) from None
    if found != FORMAT:
        raise _broken(f"{path} has format {found}, this version reads format {FORMAT}", folder, command)
    return content


def verify_file(folder: Path, split: str, command: str = "") -> Path:
    """The path of a split's file after a look at its size and checksum (a few tenths of a second per 100 MB at most).

    Raises:
        CacheError: as :func:`manifest`, or a file that is missing, truncated or altered.
    """
    files = manifest(folder, command)["files"]
    path = folder / f"{split}.safetensors"
    if path.name not in files:
        raise CacheError(f"{folder} has no split {split!r}; it has " + ", ".join(Path(name).stem for name in files))
    expected = files[path.name]
    if not path.is_file():
        raise _broken(f"{path} is missing", folder, command)
    if path.stat().st_size != expected["bytes"]:
        raise _broken(f"{path} has {path.stat().st_size} bytes instead of {expected['bytes']}", folder, command)
    if file_digest(path) != expected["sha256"]:
        raise _broken(
            f"{path} has the right size but not the checksum of its manifest: it was altered", folder, command
        )
    return path


def verify(folder: Path, command: str = "") -> None:
    """Check every file of a set.

    Raises:
        CacheError: as :func:`verify_file`.
    """
    for name in manifest(folder, command)["files"]:
        verify_file(folder, Path(name).stem, command)


def load(folder: Path, split: str, names: tuple[str, ...] | None = None, command: str = "") -> dict[str, Tensor]:
    """Tensors of a split, all of them or those in ``names``, after checking the file and that all numbers are finite.

    Raises:
        CacheError: as :func:`verify_file`, or a number that is not finite.
    """
    path = verify_file(folder, split, command)
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in (names or file.keys())}
    except SafetensorError as error:
        raise _broken(f"{path} cannot be read ({error})", folder, command) from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point():
            bad = ~tensor.isfinite().flatten(1).all(1) if tensor.dim() > 1 else ~tensor.isfinite()
            if bad.any():
                first = int(torch.nonzero(bad)[0])
                raise _broken(
                    f"split {split!r} in {path}: tensor {name!r} is not finite in {int(bad.sum())} records, first {first}",
                    folder,
                    command,
                )
    return tensors
