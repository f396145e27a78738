"""The code that made a result: the commit of the checkout, a hash of the Python files, and the versions of packages."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import subprocess
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from epo_lightning.experiment.config.compose import PACKAGE
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.kernel.build import fingerprint

CODE = ("epo_lightning", "conf", "sweeps", "pyproject.toml")
"""Code and settings in a checkout. Changes elsewhere, such as outputs of earlier commands, decide on no result."""
READERS = ("report", "explore", "drive")
"""Folders of the package that only read runs; changes there change no result."""
PACKAGES = ("epo_lightning", "torch", "lightning", "hydra-core", "omegaconf", "torchmetrics", "numpy", "numba")


def versions() -> dict[str, str | None]:
    """Versions of the packages on which results depend; None for those that are not installed.

    The version of the compiled layer is a hash of its sources. Without it, PyTorch solves the same games with other
    rounding errors, after which a training may end at other scores. ``code`` is :func:`code`.
    """
    found: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    built = not isinstance(interface.find(), str)
    return {**found, "compiled layer": f"{fingerprint():x}" if built else None, "code": code()}


@functools.cache
def code() -> str:
    """Hash of the Python files on which results depend, as they were when a process first asked for it.

    They are those of this package without :data:`READERS`, and those of the packages and modules that register parts.
    """
    files = {name: path for name, path in _python_files(PACKAGE) if Path(name).parts[0] not in READERS}
    for entry in entry_points(group="epo_lightning.parts"):
        top = entry.module.partition(".")[0]
        with contextlib.suppress(ImportError, ValueError):  # what is missing has an error when its part is looked up
            found = find_spec(top)
            if found is None:
                continue
            if found.submodule_search_locations is None:
                files[top] = Path(found.origin or "")
            for folder in found.submodule_search_locations or ():
                files |= {f"{top}: {name}": path for name, path in _python_files(Path(folder))}
    total = hashlib.sha256()
    for name, path in files.items():
        if path.is_file():  # locks of editors are links without a target
            total.update(f"{name}\n".encode() + hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:16]


def _python_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Python files in and below a folder with their relative paths, in their order; hidden ones are left out."""
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder)
        if not any(part.startswith(".") for part in name.parts):
            yield str(name), path


def of_other_code(record: Mapping[str, Any]) -> bool:
    """Whether a run began with other code than the present one; False for runs of versions that did not record it."""
    recorded = record.get("versions")
    return isinstance(recorded, Mapping) and recorded.get("code", code()) != code()


def commit() -> str | None:
    """The checkout's commit, with a ``+`` if code or settings were changed or added since; None outside a checkout."""
    root = PACKAGE.parent
    if not (root / ".git").exists():
        return None
    try:
        head = subprocess.run(["git", "-C", root, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run(
            ["git", "-C", root, "status", "--porcelain", "--", *CODE], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+" if changes.stdout.strip() else "")
