"""Worker processes that make data, and a bar that shows how far they are."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from epo_lightning.data.cache import CacheError


def default_workers() -> int:
    """One worker per core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def finished(
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    workers: int | None,
    progress: bool,
    doing: str,
    unit: str,
    before: int,
    kept: str,
    fresh: bool = False,
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Tasks and their results ``function(*task)``, as they are finished.

    Args:
        function: at module level, so that other processes find it.
        tasks: its arguments.
        workers: processes; None for one per core. A single one is this process.
        progress: whether to show a bar on standard error.
        doing, unit: what the bar says: "solving games", "placements".
        before: tasks that were finished earlier.
        kept: where finished work is kept, for error messages.
        fresh: whether each task needs a process of its own.

    Raises:
        CacheError: a worker was killed, for instance for lack of memory.
    """
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn(unit), TimeElapsedColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    bar = Progress(TextColumn(doing), *columns, console=console, refresh_per_second=1, disable=not progress)
    workers = min(workers or default_workers(), max(1, len(tasks)))
    with bar:
        row = bar.add_task("", total=before + len(tasks), completed=before)
        if workers == 1 and not fresh:
            for task in tasks:
                result = function(*task)
                bar.advance(row)
                yield task, result
            return
        with ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_watch_parent,
            max_tasks_per_child=1 if fresh else None,
        ) as pool:
            running = {pool.submit(function, *task): task for task in tasks}
            try:
                for future in as_completed(running):
                    task, result = running.pop(future), future.result()
                    bar.advance(row)
                    yield task, result
            except BrokenProcessPool as error:
                raise CacheError(
                    f"a worker process was killed while {doing}; {kept}: run the same command again, with fewer workers "
                    "if memory is short"
                ) from error
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise


def _watch_parent() -> None:
    """Let a worker end with the process that started it, also when that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:

        def wait() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=wait, daemon=True).start()
