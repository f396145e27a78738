"""The report of worker processes, and work that this process does itself."""

from __future__ import annotations

import pytest

from epo_lightning.data import workers
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
