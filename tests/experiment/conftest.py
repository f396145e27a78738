"""Runs on the tiny data set, in a folder of their own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from experiment import tiny

from epo_lightning import cli

TINY = ("data=tiny", "budget=smoke", "callbacks.progress=none")
"""The paper's rows in a second."""

Epo = Callable[..., int]


@pytest.fixture
def epo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Epo]:
    """Run a command line in an empty folder; returns its exit status."""
    monkeypatch.chdir(tmp_path)
    handlers = list(logging.getLogger().handlers)

    def run(*words: str) -> int:
        try:
            cli.main([f"--config-dir={tiny.CONF}", *words])
        except SystemExit as done:
            return int(done.code or 0)
        return 0

    yield run
    logging.getLogger().handlers[:] = handlers  # Hydra's own write to what this test's output was


@pytest.fixture
def refused(epo: Epo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command line that must be refused: one message, exit status 2, and no new file. Returns the message."""

    def run(*words: str) -> str:
        before = sorted(tmp_path.rglob("*"))
        capsys.readouterr()
        status = epo(*words)
        captured = capsys.readouterr()
        assert status == 2, captured
        message = captured.err.strip()
        assert message.startswith("epo: "), message
        assert "Traceback" not in message
        assert "\n" not in message
        assert sorted(tmp_path.rglob("*")) == before
        return message

    return run
