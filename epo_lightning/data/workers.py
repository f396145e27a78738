"""Worker processes that make data, and the report of their progress."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from epo_lightning.data.cache import CacheError

Arguments = tuple[Any, ...]
"""A task of the workers: the arguments of one call of their function."""


def default_workers() -> int:
    """Number of worker processes: one per core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Report:
    """Progress of worker processes on standard error: a bar on a terminal, otherwise one line per finished unit of work.

    A unit consists of one or more tasks: a main game of RPI is a unit, and each of its placements is a task.

    Args:
        tasks: the tasks that are not done yet.
        unit_of: function from a task to its unit.
        unit: singular noun for a unit, such as ``game``.
        doing, done: participles for the work, such as "solving" and "solved".
        before: number of units that were finished by earlier commands.
        show: whether to report at all.
    """

    def __init__(
        self,
        tasks: Sequence[Arguments],
        unit_of: Callable[[Any], Any],
        unit: str,
        doing: str,
        done: str,
        before: int,
        show: bool,
    ) -> None:
        self.unit_of, self.unit, self.done = unit_of, unit, done
        self.left = Counter(unit_of(task) for task in tasks)
        self.sizes = dict(self.left)
        self.tasks, self.units, self.total = 0, before, before + len(self.left)
        self.progress = float(before)
        console = Console(stderr=True)
        self.lines = show and not console.is_terminal
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self.bar = Progress(
            TextColumn(f"{doing} {unit}s"),
            *columns,
            console=console,
            refresh_per_second=1,
            disable=not (show and console.is_terminal),
        )
        self.row = self.bar.add_task("", total=self.total, completed=before)
        self.begin = self.first = time.monotonic()
        if self.lines and self.left:
            print(f"{doing} {unit}s, {len(self.left)} to do", file=sys.stderr, flush=True)

    def advance(self, task: Arguments) -> None:
        """Count a finished task."""
        unit, now = self.unit_of(task), time.monotonic()
        self.left[unit] -= 1
        self.tasks += 1
        self.progress += 1 / self.sizes[unit]
        self.bar.update(self.row, completed=round(self.progress, 6))
        if self.tasks == 1:
            self.first = now
        if self.left[unit]:
            return
        self.units += 1
        if self.lines:
            line = f"{self.unit} {self.units} of {self.total} {self.done}, {now - self.begin:.0f} s"
            left = self.left.total()
            # The first task also starts workers or compiles, so its time says nothing about the others.
            if left and self.tasks > 1:
                line += f", about {left * (now - self.first) / (self.tasks - 1):.0f} s left"
            print(line, file=sys.stderr, flush=True)


def finished(
    function: Callable[..., Any],
    tasks: Sequence[Arguments],
    workers: int | None,
    report: Report,
    kept: str,
    fresh: bool = False,
    first_here: bool = False,
) -> Iterator[tuple[Arguments, Any]]:
    """Tasks and their results ``function(*task)``, in the order in which they are finished.

    Args:
        function: the work; at module level, so that other processes can import it.
        tasks: arguments of the function.
        workers: number of processes; None for one per core. With 1, this process does the work.
        report: progress report; a task is counted when its result has been consumed.
        kept: sentence for error messages that names the folder of finished work.
        fresh: whether each task needs a process of its own.
        first_here: whether this process does the first task before workers start, so that compiled functions are on disk
            when they start.

    Raises:
        CacheError: a worker was killed, for instance for lack of memory.
    """
    with report.bar:
        workers = min(workers or default_workers(), max(1, len(tasks)))
        here = len(tasks) if workers == 1 and not fresh else int(first_here)
        for task in tasks[:here]:
            yield task, function(*task)
            report.advance(task)
        if len(tasks) <= here:
            return
        with ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_watch_parent,
            max_tasks_per_child=1 if fresh else None,
        ) as pool:
            running = {pool.submit(function, *task): task for task in tasks[here:]}
            try:
                for future in as_completed(running):
                    task, result = running.pop(future), future.result()
                    yield task, result
                    report.advance(task)
            except BrokenProcessPool as error:
                raise CacheError(
                    f"a worker process was killed; {kept}: run the same command again, with fewer workers if memory is short"
                ) from error
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise


def _watch_parent() -> None:
    """End this worker process when the process that started it ends, even if that one is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:

        def wait() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=wait, daemon=True).start()
