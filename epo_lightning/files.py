"""Files that are written as a whole, so that a reader never sees an incomplete one, and whose errors name the file."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from epo_lightning.registry import ConfigError


@contextmanager
def whole_file(path: Path, suffix: str = "") -> Iterator[Path]:
    """A new, empty file beside ``path``, which replaces ``path`` at the end and is deleted after an exception.

    It has the permissions that the umask leaves. Every OSError names ``path``.

    Args:
        path: path of the final file; its folder is created.
        suffix: suffix of the temporary file's name, for programs that choose a format by it.
    """
    temporary = path.with_name(f".{path.name}-{secrets.token_hex(4)}{suffix}")
    with errors_naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.touch(0o666, exist_ok=False)
            yield temporary
            temporary.replace(path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


@contextmanager
def errors_naming(path: Path) -> Iterator[None]:
    """Context in which every OSError names ``path``; the system's own error for a full disk names no file."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # not an error of the operating system: the message is complete
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_file(path: Path, content: str | bytes | memoryview) -> None:
    """Write ``path`` completely or not at all; text in UTF-8.

    Raises:
        OSError: the folder is read-only or the disk is full; it names ``path``.
    """
    with whole_file(path) as temporary, temporary.open("wb") as file:
        file.write(content.encode("utf-8") if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content`` as indented JSON with sorted keys, atomically."""
    write_file(path, json.dumps(content, indent=2, sort_keys=True, allow_nan=True) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        ConfigError: the file is missing or is not JSON.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON ({error}); was it edited, or copied incompletely?") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} holds no JSON object")
    return content
