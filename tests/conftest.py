"""Fixtures of all tests: one thread, and runtime checks of the shapes in annotations."""

from __future__ import annotations

import os
import signal

# A shell that starts the tests in the background has them ignore SIGINT. Their child processes would ignore it as well, and
# could not be interrupted by tests.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from jaxtyping import install_import_hook

# Everything that speaks the alphabet of shapes; compiled kernels take no decorators.
CHECKED = (
    "batch",
    "scene",
    "forecast",
    "game",
    "solvers",
    "encoders",
    "backbones",
    "decoders",
    "forecasters",
    "losses",
    "objectives",
    "metrics",
    "optimizers",
)
install_import_hook([f"epo_lightning.{name}" for name in CHECKED], "typechecker.check")

import hypothesis
import pytest
import torch
import typechecker

torch.set_num_threads(1)
# No test asserts a time: on a busy machine, any example can take long.
hypothesis.settings.register_profile("epo", deadline=None)
hypothesis.settings.load_profile("epo")


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    typechecker.begin()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call() -> None:
    typechecker.begin()  # whatever the fixtures have called
