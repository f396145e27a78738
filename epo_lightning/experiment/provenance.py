"""The code that made a result: the commit of the checkout, a hash of the Python files, and the versions of packages."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import subprocess
from collections.abc import Mapping
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

    They are those of this package without :data:`READERS`, and those of other packages that register parts: a module of a
    package with all files beside it, and a module of its own alone.
    """
    files = {f"{path.relative_to(PACKAGE)}": path for path in sorted(PACKAGE.rglob("*.py"))}
    files = {name: path for name, path in files.items() if Path(name).parts[0] not in READERS}
    for entry in entry_points(group="epo_lightning.parts"):
        found = None
        with contextlib.suppress(ImportError):  # an error of its own when the part is looked up
            found = find_spec(entry.module)
        if found is not None and found.origin is not None:
            file = Path(found.origin)
            beside = sorted(file.parent.rglob("*.py")) if found.parent else [file]
            files |= {f"{entry.module}: {path.relative_to(file.parent)}": path for path in beside}
    total = hashlib.sha256()
    for name, path in files.items():
        total.update(f"{name}\n".encode() + hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:16]


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
