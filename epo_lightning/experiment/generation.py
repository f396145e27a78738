"""``epo generate`` over a launcher: jobs on any machine extract the parts of a data set, and this process joins the parts.

::

    <cache>/.<data set>-parts/
        00000.safetensors    a part: the scenes of one or more recordings
        jobs-<start>/        files of the jobs that this command has started
            0.pickle         the parts that a job is to extract

A part is complete or absent. If the command or some jobs are killed, the same command divides the missing parts anew; jobs
of the earlier command, which may still run on a cluster, find their file gone and end.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from epo_lightning.data.cache import CacheError, write_file, writing
from epo_lightning.data.recorded.extraction import extract_to_file, outcomes
from epo_lightning.data.recorded.parts import Launch, PartTask
from epo_lightning.data.workers import Report, finished
from epo_lightning.experiment.config import compose
from epo_lightning.experiment.sweeps.orphans import end_with
from epo_lightning.registry import ConfigError, kind_and_message
from epo_lightning.report.labels import value_text

if TYPE_CHECKING:
    from omegaconf import DictConfig

ATTEMPTS = 3
"""Number of times that the launcher is started, if it breaks down."""
PERIOD = 1.0
"""Time [s] between two looks at the folder of the parts, for the report of the progress."""


def chosen(overrides: Sequence[str]) -> bool:
    """Whether overrides choose a launcher other than Hydra's basic one."""
    return any(word.startswith("hydra/launcher=") and word != "hydra/launcher=basic" for word in overrides)


def launching(overrides: Sequence[str], jobs: int, extra: Sequence[str]) -> Launch:
    """The function that hands parts of a data set to the launcher that the overrides choose.

    Args:
        overrides: overrides of ``epo generate``.
        jobs: number of jobs.
        extra: folders that are searched for configurations first.
    """

    def launch(tasks: Sequence[PartTask], report: Report) -> None:
        left = list(tasks)
        with _progress(left, report):
            for attempt in range(1, ATTEMPTS + 1):
                broken = _launch_once(left, overrides, jobs, extra)
                left = [task for task in left if not task.file.is_file()]
                if not left:
                    return
                if attempt < ATTEMPTS:
                    print(f"{broken or 'jobs were lost'}: {len(left)} parts are left", flush=True)
        raise CacheError(
            f"{len(left)} of {len(tasks)} parts were not extracted ({broken or 'jobs were lost'}); finished parts are kept "
            f"in {tasks[0].file.parent}: run the same command again"
        )

    return launch


def _launch_once(tasks: Sequence[PartTask], overrides: Sequence[str], jobs: int, extra: Sequence[str]) -> str:
    """Divide parts among jobs and wait for these; returns why the launcher broke down, if it did.

    Raises:
        Exception: a job failed; its own error.
    """
    work = tasks[0].file.parent.resolve()
    for earlier in work.glob("jobs-*"):
        shutil.rmtree(earlier, ignore_errors=True)
    folder = work / f"jobs-{time.time_ns():x}"
    with writing(folder):
        folder.mkdir()
    jobs = min(jobs, len(tasks))
    for number in range(jobs):
        content = {"directory": str(Path.cwd()), "process": os.getpid(), "tasks": tasks[number::jobs]}
        try:
            write_file(folder / f"{number}.pickle", pickle.dumps(content))
        except (pickle.PicklingError, AttributeError) as error:
            raise ConfigError(
                f"a launcher cannot send these recordings to other processes ({error}): their format must read them by a "
                "function at module level"
            ) from error
    words = [*overrides, f"hydra.sweep.dir={value_text(str(folder))}", "hydra/hydra_logging=none"]
    listed = compose.jobs("generate", words, extra)
    if len(listed) != 1:
        raise ConfigError(
            f"{len(listed)} data sets in one command: give `epo generate` one value per key, and a list in brackets"
        )
    try:
        done = compose.launch("generate", words, listed * jobs, job, extra)
    except ConfigError:
        raise
    except Exception as error:
        return f"the launcher broke down ({kind_and_message(error, 200)})"
    for result in done:
        if isinstance(result._return_value, Exception):
            raise result._return_value
    return ""


def job(config: DictConfig) -> None:
    """Extract the parts of one job. A launcher calls this function in a process of its choice."""
    from hydra.core.hydra_config import HydraConfig

    hydra = HydraConfig.get()
    file = Path(hydra.sweep.dir) / f"{hydra.job.num}.pickle"
    try:
        content: dict[str, Any] = pickle.loads(file.read_bytes())
    except FileNotFoundError:
        return  # another command has divided the missing parts anew
    # A worker on another machine may have another working folder.
    with contextlib.suppress(OSError):
        os.chdir(content["directory"])
    end_with(content["process"])
    tasks = [(file, task) for task in content["tasks"]]
    report = Report(tasks, lambda task: task[1].file, "part", "extracting", "extracted", 0, show=False)
    for _ in finished(_extract, tasks, config.workers or 1, report, f"finished parts are kept in {file.parent.parent}"):
        pass


def _extract(file: Path, task: PartTask) -> None:
    """Extract a part, unless it is there or the file of the job is gone."""
    if file.is_file() and outcomes(task.file) is None:
        extract_to_file(*task)


@contextmanager
def _progress(tasks: Sequence[PartTask], report: Report) -> Iterator[None]:
    """Context that reports parts when their files appear."""
    waiting = {task.file.name: task for task in tasks}
    ended = threading.Event()

    def look() -> None:
        there = waiting.keys() & {file.name for file in tasks[0].file.parent.iterdir()}
        for name in sorted(there):
            report.advance(waiting.pop(name))

    def watch() -> None:
        while not ended.wait(PERIOD):
            look()
        look()

    with report.bar:
        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
