"""The report of worker processes, what they do, how they end, and work that this process does itself."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from epo_lightning.data import workers
from epo_lightning.data.cache import CacheError
from epo_lightning.data.workers import Report, default_workers, finished


@pytest.fixture
def clock(monkeypatch):
    """A clock that is ten seconds later whenever it is asked."""
    now = [0.0]

    def tick() -> float:
        now[0] += 10.0
        return now[0]

    monkeypatch.setattr(workers.time, "monotonic", tick)


TASKS = [("a", 1), ("a", 2), ("b", 1), ("c", 1), ("c", 2)]


def report(tasks=TASKS, before=2, show=True) -> Report:
    return Report(tasks, lambda task: task[0], "game", "solving", "solved", before, show)


@pytest.mark.usefixtures("clock")
def test_a_unit_is_reported_when_its_last_task_is_done(capsys):
    progress = report()
    for task in (("a", 1), ("b", 1), ("a", 2), ("c", 1), ("c", 2)):
        progress.advance(task)
    assert capsys.readouterr().err.splitlines() == [
        "solving games, 3 to do",
        "game 3 of 5 solved, 20 s, about 30 s left",
        "game 4 of 5 solved, 30 s, about 20 s left",
        "game 5 of 5 solved, 50 s",
    ]
    assert progress.progress == pytest.approx(5.0)


def test_nothing_is_reported_unless_it_is_asked_for(capsys):
    silent = report(show=False)
    for task in TASKS:
        silent.advance(task)
    assert not capsys.readouterr().err


def test_one_worker_is_this_process_and_a_task_counts_once_its_result_is_used():
    progress, done = report(before=0, show=False), []
    work = finished(lambda unit, number: done.append(unit) or f"{unit}{number}", TASKS, 1, progress, "kept")
    assert next(work) == (("a", 1), "a1")
    assert (done, progress.tasks) == (["a"], 0)
    assert [result for _, result in work] == ["a2", "b1", "c1", "c2"]
    assert progress.tasks == len(TASKS)
    assert not list(finished(print, [], None, report([], 0, False), "kept"))


def test_there_is_a_worker_for_every_core_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr(workers.os, "sched_getaffinity", lambda _: {3, 5, 8}, raising=False)
    assert default_workers() == 3
    monkeypatch.delattr(workers.os, "sched_getaffinity")
    monkeypatch.setattr(workers.os, "cpu_count", lambda: None)
    assert default_workers() == 1


def work(name: str, folder: Path, awaited: str = "") -> tuple[int, str]:
    """Leave a file with this name, and tell which process did so and how it was started.

    Before, it waits for the file of another task; ``stop`` and ``die`` fail.
    """
    deadline = time.monotonic() + 120
    while awaited and not (folder / awaited).exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    if name == "stop":
        raise ValueError("this task fails")
    if name == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("slow"):
        time.sleep(0.5)
    (folder / name).write_text(str(os.getpid()))
    if name == "endless":
        time.sleep(600)
    return os.getpid(), multiprocessing.get_start_method()


def silent(tasks) -> Report:
    return Report(tasks, lambda task: task[0], "file", "writing", "written", 0, False)


def test_workers_do_every_task_once_and_give_results_as_they_are_finished(tmp_path):
    """Each task but the first two that finish waits until this process has used the result of the one before."""
    tasks = [
        ("first", tmp_path),
        ("late", tmp_path, "used early"),
        ("early", tmp_path),
        ("last", tmp_path, "used late"),
    ]
    progress, results = silent(tasks), {}
    for number, (task, result) in enumerate(finished(work, tasks, 2, progress, "kept", first_here=True)):
        assert progress.tasks == number, "a task counts when its result was used"
        results[task[0]] = result
        (tmp_path / f"used {task[0]}").touch()
    assert progress.tasks == len(tasks) == len(results)
    assert list(results) == ["first", "early", "late", "last"]
    here, *others = (process for process, _ in results.values())
    assert here == os.getpid(), "this process does the first task itself"
    assert os.getpid() not in others
    assert len(set(others)) <= 2
    assert {how for name, (_, how) in results.items() if name != "first"} == {"spawn"}, "threads do not survive a fork"


def test_every_task_has_a_process_of_its_own_where_it_is_to_be_fresh(tmp_path):
    tasks = [("a", tmp_path), ("b", tmp_path)]
    found = {process for _, (process, _) in finished(work, tasks, 1, silent(tasks), "kept", fresh=True)}
    assert len(found - {os.getpid()}) == 2
    ((_, (process, _)),) = finished(work, tasks[:1], 8, silent(tasks[:1]), "kept")
    assert process == os.getpid(), "one task needs no worker"


def test_a_task_that_fails_is_raised_and_the_others_are_not_begun(tmp_path):
    tasks = [("stop", tmp_path), *((f"slow {number}", tmp_path) for number in range(30))]
    with pytest.raises(ValueError, match="this task fails"):
        list(finished(work, tasks, 2, silent(tasks), "kept"))
    assert len(list(tmp_path.iterdir())) < 30


def test_a_worker_that_is_killed_is_named_with_what_is_kept(tmp_path):
    tasks = [("die", tmp_path), ("a", tmp_path, "never")]
    with pytest.raises(CacheError, match=r"a worker process was killed; games are in x: run the same command again"):
        list(finished(work, tasks, 2, silent(tasks), "games are in x"))


def test_workers_end_with_the_process_that_started_them_even_if_it_is_killed(tmp_path):
    program = "\n".join(
        (
            "import sys, pathlib",
            f"sys.path[:0] = {[str(Path(__file__).parents[1]), *sys.path]!r}",
            "from data.test_workers import finished, silent, work",
            f"tasks = [('endless', pathlib.Path({str(tmp_path)!r})), ('a', pathlib.Path({str(tmp_path)!r}))]",
            "list(finished(work, tasks, 2, silent(tasks), 'kept'))",
        )
    )
    process = subprocess.Popen([sys.executable, "-c", program])
    deadline = time.monotonic() + 120
    while not (tmp_path / "endless").exists() or not (tmp_path / "endless").read_text():
        assert process.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.kill()
    process.wait()
    while lives((tmp_path / "endless").read_text()):
        assert time.monotonic() < deadline, "the worker goes on"
        time.sleep(0.05)


def lives(process: str) -> bool:
    """Whether a process exists and has not ended; its parent may have ended before it."""
    try:
        return "(zombie)" not in Path("/proc", process, "status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
