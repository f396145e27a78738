"""metrics.csv of a run: a kill at any moment or a full disk loses no written row."""

from __future__ import annotations

import csv
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch

from epo_lightning.experiment.csv_log import CSVLog
from epo_lightning.run_folder import RunFolder, read_log


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    (tmp_path / "logs").mkdir()
    return RunFolder(tmp_path)


def steps(run: RunFolder) -> list[int]:
    return [int(row["step"]) for row in read_log(run.logs / "metrics.csv")]


def write(run: RunFolder, count: int) -> None:
    """A log of ``count`` rows, of which every second one also has a validation score."""
    log = CSVLog(run, flush=1)
    for step in range(count):
        log.log_metrics({"train/loss": 1.0 + step} | ({"val/minSADE": 0.5} if step % 2 else {}), step)


def lines_until(action: Callable[[], None], at: int) -> int:
    """Run ``action`` in a child that is killed before its ``at``-th line of Python; returns how many lines it ran."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # fork beside threads: the child only writes files
        out, into = os.pipe()
        child = os.fork()
    if child == 0:
        count = 0

        def trace(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal count
            if not frame.f_code.co_filename.endswith(("csv_log.py", "csv_logs.py", "run_folder.py", "/files.py")):
                return None
            count += event == "line"
            if 0 < at == count:
                os.kill(os.getpid(), signal.SIGKILL)
            return trace

        try:
            sys.settrace(trace)
            action()
            sys.settrace(None)
            os.write(into, str(count).encode())
        finally:
            os._exit(0)
    os.close(into)
    _, status = os.waitpid(child, 0)
    said = os.read(out, 100)
    os.close(out)
    assert os.WIFSIGNALED(status) or said
    return int(said or at)


def killed_everywhere(action: Callable[[], None], check: Callable[[], None], again: Callable[[], None]) -> None:
    """Kill ``action`` before each of its lines in turn, from a state that ``again`` makes, and ``check`` what is left."""
    again()
    total = lines_until(action, at=0)
    assert total > 20
    for at in range(1, total + 1):
        again()
        lines_until(action, at)
        check()


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Context in which no file can grow beyond a size [bytes], as on a full disk."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_kill_while_a_run_continues_loses_no_row_from_before(run: RunFolder) -> None:
    def kept() -> None:
        assert steps(run)[:3] == [0, 1, 2], "rows before the step that the run continues from"

    killed_everywhere(lambda: CSVLog(run, 1, continued_from=3), kept, lambda: write(run, 5))


def test_a_kill_while_a_column_is_added_loses_no_row(run: RunFolder) -> None:
    logs: list[CSVLog] = []

    def begin() -> None:
        (run.logs / "metrics.csv").unlink(missing_ok=True)
        logs[:] = [CSVLog(run, 1)]
        for step in range(3):
            logs[0].log_metrics({"a": float(step)}, step)

    def kept() -> None:
        assert steps(run) in ([0, 1, 2], [0, 1, 2, 3])

    killed_everywhere(lambda: logs[0].log_metrics({"a": 3.0, "b": 1.0}, 3), kept, begin)


def test_truncated_lines_are_ignored(run: RunFolder) -> None:
    write(run, 3)
    file = run.logs / "metrics.csv"
    file.write_bytes(file.read_bytes() + b"3,4.12")  # of 4.125
    assert steps(run) == [0, 1, 2]
    log = CSVLog(run, 1, continued_from=3)
    log.log_metrics({"train/loss": 4.125}, 3)
    assert steps(run) == [0, 1, 2, 3]
    assert read_log(file)[-1]["train/loss"] == "4.125"


def test_a_row_that_failed_on_a_full_disk_is_written_later(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    write(run, 4)
    before = (run.logs / "metrics.csv").read_bytes()
    log = CSVLog(run, 1, continued_from=4)
    with (
        files_of_at_most(len(before) + 2),
        pytest.raises(OSError, match="File too large"),
    ):  # room for a piece of the row
        log.log_metrics({"train/loss": 5.0}, 4)
    assert (run.logs / "metrics.csv").read_bytes() == before
    log.save()
    assert steps(run) == [0, 1, 2, 3, 4]


def test_a_disk_that_is_full_when_a_column_is_added_keeps_the_rows(run: RunFolder) -> None:
    write(run, 4)
    log = CSVLog(run, 1, continued_from=4)
    before = (run.logs / "metrics.csv").read_bytes()
    with files_of_at_most(len(before)), pytest.raises(OSError, match="File too large"):  # a larger one replaces it
        log.log_metrics({"another": 5.0}, 4)
    assert (run.logs / "metrics.csv").read_bytes() == before
    log.save()
    assert steps(run) == [0, 1, 2, 3, 4]


def test_the_file_is_plain_csv_with_sorted_columns(run: RunFolder) -> None:
    log = CSVLog(run, flush=2)
    log.log_metrics({"b": torch.tensor(0.5), "step name, quoted": 1.0}, 0)
    assert not (run.logs / "metrics.csv").exists()
    log.log_metrics({"a": 2.0}, 1)
    with (run.logs / "metrics.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [["a", "b", "step", "step name, quoted"], ["", "0.5", "0", "1.0"], ["2.0", "", "1", ""]]
