"""Display of a sweep: a table with the state of every run, and a printed line for every run that ends."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from epo_lightning.experiment.sweeps.sweep import Job, State, Sweep
from epo_lightning.files import read_json
from epo_lightning.registry import ConfigError
from epo_lightning.report.labels import MOST, short_keys, shortened, shown, word
from epo_lightning.report.timings import duration_text

STYLES: dict[State, str] = {
    "done": "green",
    "running": "cyan",
    "interrupted": "yellow",
    "trained, not scored": "yellow",
    "failed": "bold red",
    "waiting": "",
}
"""Colours of all states, in the order of a summary."""
POLL = 2.0
"""Seconds between two checks of the run folders."""


def status(sweep: Sweep) -> Counter[State]:
    """Print the state of every run, and how to continue; returns the number of runs in each state."""
    jobs = sweep.jobs
    states = [sweep.state(job) for job in jobs]
    names = names_of(jobs)
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("run", "state", "how far"):
        table.add_column(column, overflow="fold")
    for job, state in zip(jobs, states, strict=True):
        table.add_row(escape(names[job.run.path]), Text(state, STYLES[state]), escape(_details(sweep, job, state)))
    console = Console()
    console.print(sweep.record.get("command", ""), style="bold", highlight=False, markup=False)
    console.print(table)
    counts = Counter(states)
    console.print(f"{summary(counts)}; they lie below {sweep.root}", highlight=False, markup=False, soft_wrap=True)
    note_former(sweep)
    if (counts["interrupted"] or counts["waiting"] or counts["trained, not scored"]) and not counts["running"]:
        console.print("give the same command again to continue", highlight=False)
    unscored = (job for job, state in zip(jobs, states, strict=True) if state == "trained, not scored")
    if command := next((_scoring(job) for job in unscored if job.lacking != ("time",)), ""):
        console.print(
            f"it also scores what is trained; a single run: {command}", highlight=False, markup=False, soft_wrap=True
        )
    return counts


def note_former(sweep: Sweep) -> None:
    """Print how many runs of earlier starts are no longer part of the sweep."""
    if former := sweep.former:
        those = "1 run of an earlier start is" if len(former) == 1 else f"{len(former)} runs of earlier starts are"
        print(
            f"{those} no longer part of this sweep, because files that it reads have changed since; the folder stays: "
            f"{former[0].path}",
            flush=True,
        )


def _scoring(job: Job) -> str:
    """The command that scores a trained run."""
    split = "" if "test" in job.lacking else " split=val"
    return f"epo evaluate {word('run', str(job.run.path))}{split}"


def names_of(jobs: Sequence[Job]) -> dict[Path, str]:
    """Unique names of runs: title, settings in which runs of a title differ, and seed.

    The data set and the folder are added only where they are needed.
    """
    data: dict[str, set[str]] = {}
    for job in jobs:
        data.setdefault(job.title, set()).add(job.data)
    titles = {title: "{} ({})" if len(found) > 1 else "{}" for title, found in data.items()}
    rows: dict[str, list[Job]] = {}
    for job in jobs:
        rows.setdefault(titles[job.title].format(job.title, job.data), []).append(job)
    labelled = ((job, f"{title}{label}") for title, same in rows.items() for job, label in _labelled(same))
    found = {job.run.path: f"{name}, seed {job.seed}" for job, name in labelled}
    names = {job.run.path: found[job.run.path] for job in jobs}
    counts = Counter(names.values())
    folders = Counter((names[job.run.path], job.run.path.name) for job in jobs)
    for path, name in names.items():
        if counts[name] > 1:
            names[path] = f"{name} ({'/'.join(path.parts[-2 if folders[name, path.name] > 1 else -1 :])})"
    return names


def _labelled(jobs: Sequence[Job]) -> Iterator[tuple[Job, str]]:
    """Runs of a title, each with the overrides in which they differ: ``, lr=0.001``; with none if these are too many."""
    settings = [_settings(job) for job in jobs]
    keys = [key for key in {key: "" for own in settings for key in own} if len({own.get(key) for own in settings}) > 1]
    short = short_keys(keys, {})
    for job, own in zip(jobs, settings, strict=True):
        parts = [f"{short[key]}={_value(own[key])}" for key in keys if key in own]
        yield job, "".join(f", {part}" for part in parts) if len(keys) <= MOST else ""


def _settings(job: Job) -> dict[str, str]:
    """The values of a run's overrides, by key and without the seed, which names show anyway."""
    given = (override.lstrip("+").partition("=") for override in job.overrides)
    return {key: value for key, _, value in given if key != "seed"}


def _value(text: str) -> str:
    """A value as labels of a report show it."""
    try:
        number = float(text)
    except ValueError:
        return shortened(text)
    return text if number.is_integer() else shown(number)


def summary(counts: Counter[State]) -> str:
    """``12 runs: 5 done, 1 running, 6 waiting``"""
    parts = [f"{counts[state]} {state}" for state in STYLES if counts[state]]
    total = counts.total()
    return f"{total} run{'' if total == 1 else 's'}: {', '.join(parts) or 'none'}"


def _details(sweep: Sweep, job: Job, state: State) -> str:
    if state == "running":
        return how_far(job)
    if state == "failed":
        return sweep.error(job)
    if state == "trained, not scored":
        return f"lacks {' and '.join(job.lacking)}"
    if state == "interrupted":
        return how_far(job) if job.run.progress else ""
    return result(job) if state == "done" else ""


def _or_damaged(describe: Callable[[Job], str]) -> Callable[[Job], str]:
    """``describe``, which says so where a record of the run is damaged: one run must not hide the others."""

    @wraps(describe)
    def described(job: Job) -> str:
        try:
            return describe(job)
        except (ConfigError, KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError) as error:
            return f"records in {job.run.path} are damaged ({type(error).__name__}: {error})"

    return described


@_or_damaged
def how_far(job: Job) -> str:
    """Steps, and minutes that are left at the present pace."""
    progress = job.run.progress
    step, steps, since = (progress.get(key) for key in ("step", "steps", "seconds"))
    if step is None:
        return "begins" if not job.run.finished else "is scored"
    if not steps:
        return f"step {step}"
    done = step - progress.get("from_step", 0)
    left = f", {duration_text((steps - step) * since / done)} left" if done and since else ""
    return f"step {step} of {steps}{left}"


@_or_damaged
def result(job: Job) -> str:
    """Summary of a finished run: its best validation score, its test score, and how long training and a forecast took."""
    told = []
    if job.measures != ("time",):
        record = job.run.record
        best = next(((key, value) for key, value in record.get("best", {}).items() if value is not None), None)
        told = [f"{best[0]} {best[1]:.4f}"] if best else []
        if "test" in job.measures:
            told.append(f"test/minSADE {read_json(job.run.metrics_file('test'))['metrics']['minSADE']:.4f}")
        told.append(f"{duration_text(record.get('seconds', 0.0))} of training")
    if "time" in job.measures:
        seconds = read_json(job.run.metrics_file("time"))["seconds"]["median"]
        told.append(f"{1000 * seconds:.1f} ms per forecast")
    return ", ".join(told)


@contextmanager
def news(sweep: Sweep) -> Iterator[None]:
    """Context that prints a line whenever a run is done or has failed, in whatever process or machine it ran.

    A run that an earlier start left as failed is not over: its traceback is deleted when the sweep begins again, and a new
    one means that it has failed again.
    """
    names = names_of(sweep.jobs)
    known = {job.run.path: sweep.state(job) for job in sweep.jobs}
    ended: dict[Path, State] = {path: state for path, state in known.items() if state == "done"}
    over = threading.Event()

    def look() -> None:
        jobs = sweep.jobs
        for job in jobs:
            state = sweep.state(job)
            new = state != known.get(job.run.path) or sweep.has_traceback(job)
            if new and state in ("done", "failed") and state != ended.get(job.run.path):
                ended[job.run.path] = state
                text = f"FAILED, {sweep.error(job)}" if state == "failed" else f"done, {result(job)}"
                name = names.get(job.run.path) or names_of(jobs)[job.run.path]
                print(f"[{len(ended)}/{len(jobs)}] {name}: {text}", flush=True)
            known[job.run.path] = state

    def watch() -> None:
        while not over.wait(POLL):
            look()

    watcher = threading.Thread(target=watch, name="news of the sweep", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
    look()
