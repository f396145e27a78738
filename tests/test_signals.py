"""What a command prints beside its result: warnings, and a line when SIGTERM or Ctrl-C stops it, with the exit status."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from epo_lightning import cli
from epo_lightning.registry import ConfigError


@pytest.mark.parametrize("verb", ["generate", "train", "evaluate", "predict", "report", "sweep", "config"])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_verb_prints_a_message(
    verb: str,
    number: signal.Signals,
    status: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGTERM)

    def run(_: object) -> None:
        os.kill(os.getpid(), number)
        time.sleep(20.0)

    monkeypatch.setattr(cli, "_run", run)
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)  # programs in the background of a shell ignore it
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main([verb])
    finally:
        signal.signal(signal.SIGINT, ours)
    assert ended.value.code == status
    message = capsys.readouterr().err
    assert message.startswith(("epo: terminated; ", "epo: interrupted; "))
    assert message.count("\n") == 1
    assert "the same command continues" in message
    assert signal.getsignal(signal.SIGTERM) == before


def test_warnings_are_printed_as_lines_without_code() -> None:
    program = (
        "import warnings; from epo_lightning import cli\n"
        "def run(words):\n"
        "    warnings.warn('see http://me:secret@host', stacklevel=1)\n"
        "    warnings.warn('old', FutureWarning, stacklevel=1)\n"
        "cli._run = run\n"
        "cli.main([])\n"
        "warnings.warn('later', stacklevel=1)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env={"PATH": ""})
    lines = done.stderr.splitlines()
    assert lines[:2] == ["epo: warning: see http://me:***@host", "epo: FutureWarning: old"]
    assert "UserWarning: later" in lines[2]


def test_a_stopped_multirun_is_continued_by_itself() -> None:
    ending = SystemExit(143)
    ending.add_note("continue with `epo train resume=runs/one`")
    assert "existing=continue" in cli._farewell("terminated", ["train", "-m", "seed=0,1"], ending)
    assert "the same command" in cli._farewell("terminated", ["sweep", "rpi_main"], ending)


@pytest.mark.parametrize("error", [AssertionError("Trying to pop empty mode stack"), ConfigError("a"), OSError(5, "b")])
def test_an_exception_after_sigterm_is_a_termination(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(20.0)
        finally:
            raise error

    monkeypatch.setattr(cli, "_run", run)
    with pytest.raises(SystemExit) as ended:
        cli.main(["export"])
    assert ended.value.code == 143
    assert capsys.readouterr().err == "epo: terminated; no incomplete file was left; the same command continues\n"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_explore_only_says_that_it_stopped(
    number: signal.Signals, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(_: object) -> None:
        os.kill(os.getpid(), number)
        time.sleep(20.0)

    monkeypatch.setattr(cli, "_run", run)
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main(["explore", "run=rpi/v_lstm_epo"])
    finally:
        signal.signal(signal.SIGINT, ours)
    assert ended.value.code == status
    assert capsys.readouterr().err == "epo: stopped\n"


def test_a_signal_handler_of_a_caller_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda sent, _: heard.append(sent))
    monkeypatch.setattr(cli, "_run", lambda words: os.kill(os.getpid(), signal.SIGTERM))
    try:
        cli.main(["train"])
    finally:
        signal.signal(signal.SIGTERM, before)
    assert heard == [signal.SIGTERM]
