"""The code that made a result: the commit of the checkout, and the versions of packages."""

from __future__ import annotations

import contextlib
import subprocess
from importlib.metadata import PackageNotFoundError, version

from epo_lightning.experiment.config.compose import PACKAGE
from epo_lightning.solvers.gauss_newton.kernel import interface
from epo_lightning.solvers.gauss_newton.kernel.build import fingerprint

CODE = ("epo_lightning", "conf", "sweeps", "pyproject.toml")
"""Code and settings in a checkout. Changes elsewhere, such as outputs of earlier commands, decide on no result."""
PACKAGES = ("epo_lightning", "torch", "lightning", "hydra-core", "omegaconf", "torchmetrics", "numpy", "numba")


def versions() -> dict[str, str | None]:
    """Versions of the packages on which results depend; None for those that are not installed.

    The version of the compiled layer is a hash of its sources. Without it, PyTorch solves the same games with other
    rounding errors, after which a training may end at other scores.
    """
    found: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    built = not isinstance(interface.find(), str)
    return {**found, "compiled layer": f"{fingerprint():x}" if built else None}


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
