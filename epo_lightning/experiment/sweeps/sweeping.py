"""``epo sweep <name>``: list the runs that are not done, run them by a launcher, and print the results."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from epo_lightning.data.cache import CacheError
from epo_lightning.experiment import assembly
from epo_lightning.experiment import train as training
from epo_lightning.experiment.config import compose
from epo_lightning.experiment.config.settings import Settings, TrainerSettings
from epo_lightning.experiment.config.sources import options_of
from epo_lightning.experiment.provenance import of_other_code
from epo_lightning.experiment.sweeps.listing import command_line, folder_of_runs
from epo_lightning.experiment.sweeps.sweep import Job, State, Sweep
from epo_lightning.experiment.sweeps.watch import news, note_former, status, summary
from epo_lightning.experiment.sweeps.work import job_of
from epo_lightning.experiment.verbs import check_settings, make_data
from epo_lightning.files import read_json
from epo_lightning.registry import ConfigError, kind_and_message, nearest
from epo_lightning.report.choices import Choices, read_choices
from epo_lightning.report.entries import TEXT, WHOLE, check_entries
from epo_lightning.report.folds import fold
from epo_lightning.report.labels import value_text, word
from epo_lightning.report.rows import unequal_conditions
from epo_lightning.report.runs import UNLEARNED
from epo_lightning.run_folder import RunFolder, numbered
from epo_lightning.schema import read

CHOICES = "choices="
"""Beginning of the override that names a choices file (:mod:`epo_lightning.report.choices`)."""
ATTEMPTS = 3
"""Number of times that the launcher of a sweep is started, if it breaks down."""
KILLED = "its process was killed in every attempt (out of memory?)"
"""Error of a run whose process died without a message."""
PAUSE = 5.0
"""Seconds between two looks at runs that still run after their launcher broke down."""


def run(
    name: str, overrides: Sequence[str], extra: Sequence[str], task: Callable[..., Any], stop_on_failure: bool
) -> bool:
    """Run all runs of a sweep that are not done; interrupted and failed runs continue from their last checkpoint.

    Args:
        name: name of the file in ``sweeps/``.
        overrides: overrides for every run, and ``choices=<file>`` for further overrides of single experiments.
        extra: folders that are searched for configurations first.
        task: function that does a job; at module level, because launchers send it to other processes.
        stop_on_failure: whether no more runs are started after a failure.

    Returns:
        whether all runs are done.

    Raises:
        ConfigError: a mistake in the configuration of any run, before the first one begins; or the sweep runs already.
    """
    assembly.quiet()
    _refuse_places(overrides)
    runs = folder_of_runs(overrides)
    sweep = Sweep.of(name, overrides, runs)
    choices, others = _choices_in(overrides)
    words = words_of(name, others, extra)
    # Absolute, because a worker on another machine may start in any folder.
    places = {"sweep": sweep.folder, "runs": sweep.root, "hydra.sweep.dir": sweep.folder}
    words += [f"{key}={value_text(str(place))}" for key, place in places.items()] + ["existing=continue"]
    words += ["hydra/hydra_logging=none"]  # the printed news replace Hydra's own log
    try:
        jobs = _listed(sweep, words, extra, choices)
    except CacheError as error:
        again = command_line(["epo", "sweep", "generate", name, *overrides], extra)
        raise ConfigError(f"{error}; or make all data sets of the sweep with `{again}`") from error
    with sweep.lock():
        states = [sweep.state(job) for job in jobs]
        sweep.begin(
            name,
            command_line(["epo", "sweep", name, *overrides], extra),
            overrides,
            jobs,
            stop_on_failure,
            choices.content if choices else None,
        )
        if jobs:
            print(f"{sweep.label}: {summary(Counter(states))}", flush=True)
            note_former(sweep)
            _note_other_code(jobs, states)
        with news(sweep):
            if jobs:
                missing = [job for job, state in zip(jobs, states, strict=True) if state != "done"]
                _launch(sweep, missing, words, task, extra)
                all_chosen = True
            else:
                all_chosen = _search(sweep, words, task, extra)
        counts = status(sweep)
    if counts["failed"]:
        print(f"tracebacks: {os.path.relpath(sweep.folder / 'failures')}")
    done = all_chosen and counts["done"] == counts.total()
    if done:
        print(f"next: epo report {sweep.label}" + (f" {word('runs', runs)}" if runs != "runs" else ""))
    return done


def _note_other_code(jobs: Sequence[Job], states: Sequence[State]) -> None:
    """Print how many of the finished runs were trained by other code than the present one."""
    done = [job.run for job, state in zip(jobs, states, strict=True) if state == "done"]
    others = [run for run in done if of_other_code(run.record)]
    if others:
        print(
            f"{len(others)} of the {len(done)} finished runs are kept although a Python file has changed since they began, "
            f"the first one {others[0].path}: choose another folder, runs=<folder>, to train all runs by the present code",
            flush=True,
        )


def generate(name: str, overrides: Sequence[str], extra: Sequence[str]) -> None:
    """Make the data sets of a sweep's runs, one after the other, and print their reports; those that exist are kept.

    Args:
        name: name of the file in ``sweeps/``.
        overrides: those of the sweep, and ``workers``, ``strict`` and ``progress`` of ``epo generate``.
        extra: folders that are searched for configurations first.

    Raises:
        ConfigError: a mistake in the configuration of any run, before the first data set is made; or recordings that are
            missing or cannot be read.
    """
    own = [word for word in overrides if word.partition("=")[0] in ("workers", "strict", "progress")]
    others = [word for word in overrides if word not in own]
    making = compose.compose("generate", own, extra)
    sections: dict[Path, Any] = {}
    _refuse_places(others)
    choices, of_runs = _choices_in(others)
    listed = _overrides_of_runs(words_of(name, of_runs, extra), choices, extra)
    if not listed:
        raise ConfigError(f"{name} chooses its runs while it searches: make its data by `epo generate data=<name>`")
    for words in listed:
        settings = read(Settings, compose.compose("train", words, extra))
        data, _ = assembly.check_buildable(settings, words)
        if settings.data["name"] != "drawn":
            sections.setdefault(data.folder, settings.data)
    if not sections:
        print(f"{name} draws its scenes in memory: there is nothing to make")
    for number, section in enumerate(sections.values(), 1):
        print(f"\ndata set {number} of {len(sections)}", flush=True)
        make_data(check_settings("generate", {**making, "data": section}))
    print(f"\nnext: {command_line(['epo', 'sweep', name, *others], extra)}")


def _overrides_of_runs(words: Sequence[str], choices: Choices | None, extra: Sequence[str]) -> list[list[str]]:
    """The overrides of every run of a sweep; none for a sweep that chooses its runs while it searches."""
    listed = compose.jobs("train", words, extra)
    return _with_choices(listed, choices, extra) if choices else listed


def _refuse_places(overrides: Sequence[str]) -> None:
    """Refuse overrides that each run of a sweep sets for itself."""
    for given in overrides:
        if given.split("=")[0] in ("run_dir", "resume", "sweep", "sweeps"):
            raise ConfigError(
                f"{given} cannot be set for a sweep, because each run has a folder of its own: leave it out"
            )


def _choices_in(overrides: Sequence[str]) -> tuple[Choices | None, list[str]]:
    """The contents of the file that ``choices=`` names, if it does, and the other overrides."""
    files = [word for word in overrides if word.startswith(CHOICES)]
    return (
        read_choices(files[0].removeprefix(CHOICES)) if files else None,
        [word for word in overrides if word not in files],
    )


def words_of(name: str, overrides: Sequence[str], extra: Sequence[str]) -> list[str]:
    """The overrides of a sweep, with the options that its file chooses for all runs.

    These choices decide which further settings exist: without ``data=us101``, for example, there is no ``data.folder``.
    """
    given = {word.lstrip("+~").partition("=")[0] for word in overrides}
    fixed = compose.fixed_choices("train", name, extra)
    return [f"sweeps={name}", *(choice for group, choice in fixed.items() if group not in given), *overrides]


def _listed(sweep: Sweep, words: Sequence[str], extra: Sequence[str], choices: Choices | None = None) -> list[Job]:
    """All runs of a sweep, each once, after a check of everything that could prevent a run from starting.

    Searching sweeps choose their runs later, and have none here. A time that was measured with other settings is renamed.

    Raises:
        ConfigError: a mistake in a configuration, a folder that holds something else, data that is missing, two rows with
            the same settings, or runs that no table may compare.
    """
    jobs: dict[Path, Job] = {}
    same: dict[str, Job] = {}
    ready: set[str] = set()
    scored: dict[str, list[dict[str, Any]]] = {}
    for overrides in _overrides_of_runs(words, choices, extra):
        config = compose.compose("train", overrides, extra)
        job = job_of(config, overrides)
        if job.run.record_file.is_file():
            training.refuse_other(job.run, config, assembly.build_data(config["data"]))
        elif job.run.exists:
            raise ConfigError(
                f"{job.run.path} exists and is not a run folder: move it away, or choose another runs=<folder>"
            )
        if "time" in job.measures:
            _set_aside(job.run, read(Settings, config).trainer)
        data = json.dumps(config["data"], sort_keys=True)
        if data not in ready and sweep.state(job) != "done":
            module = assembly.build_data(config["data"])
            module.words = [*overrides, *(f"--config-dir={folder}" for folder in extra)]
            module.setup("fit")
            ready.add(data)
        if {*job.measures} - {"time"} and config["forecaster"]["name"] != UNLEARNED:
            scored.setdefault(job.data + fold(config), []).append(config)
        jobs.setdefault(job.run.path, job)
        twin = same.setdefault(job.identity, job)
        if (twin.run.path, twin.title) != (job.run.path, job.title):
            raise ConfigError(
                f"the rows {twin.title!r} and {job.title!r} have the same settings, so that {twin.run.path} and "
                f"{job.run.path} would be the same run: change a setting of one row, or leave the row out"
            )
    for data, configs in scored.items():
        _refuse_incomparable(data, configs)
    return list(jobs.values())


def _refuse_incomparable(data: str, configs: Sequence[Mapping[str, Any]]) -> None:
    """Refuse trainings on one data set, or one fold, that differ in conditions which all rows of a table must share."""
    budgets = {str(config["budget"]["name"]): "" for config in configs}
    keys = ["budget"] if len(budgets) > 1 else unequal_conditions(configs)
    if keys:
        raise ConfigError(
            f"the runs of this sweep on {data} differ in {', '.join(keys)}, which must be equal for all rows of a table, so "
            "that `epo report` would refuse them: give the command of the sweep once for every value"
        )


def _with_choices(listed: Sequence[list[str]], choices: Choices, extra: Sequence[str]) -> list[list[str]]:
    """The overrides of all runs, with those that were chosen for their experiments.

    Raises:
        ConfigError: the file has an experiment or a key that does not exist, a key that the sweep or the command sets, or no
            experiment of the sweep.
    """
    file = f"choices={choices.file}"
    with compose.hydra(extra) as instance:
        experiments = options_of(instance, "experiment")
    for experiment in choices.overrides:
        if experiment not in experiments:
            raise ConfigError(f"{file}: unknown experiment {experiment!r}: {nearest(experiment, experiments)}")
    found, used = [], dict[str, str]()
    for overrides in listed:
        values = {key.lstrip("+~"): value for key, _, value in (given.partition("=") for given in overrides)}
        experiment = values.get("experiment", "")
        chosen = choices.overrides.get(experiment, ())
        for key in (override.partition("=")[0].lstrip("+") for override in chosen):
            if key in values:
                raise ConfigError(
                    f"{key} of {experiment} is set by {file} and by the sweep or its command: leave one out"
                )
        if chosen and experiment not in used:
            try:
                compose.compose("train", [*overrides, *chosen], extra)
            except ConfigError as error:
                raise ConfigError(f"{file}, {experiment}: {error}") from error
            used[experiment] = " ".join(chosen)
        found.append([*overrides, *chosen])
    if not used:
        raise ConfigError(
            f"{file} has no experiment of this sweep, only {', '.join(choices.overrides)}"
            + ("" if listed else "; a sweep that searches its settings takes no choices")
        )
    for experiment in choices.overrides:
        print(f"{file}: {experiment}: {used.get(experiment, 'not in this sweep')}", flush=True)
    return found


def _set_aside(run: RunFolder, settings: TrainerSettings) -> None:
    """Rename ``runtime.json`` if it was measured on another device or number of threads, so that it is measured again."""
    file = run.metrics_file("time")
    if not file.is_file():
        return
    found = read_json(file)
    again = "delete it, and the same command measures the time again"
    check_entries(found, {"device": TEXT, "threads": WHOLE}, str(file), again)
    on_gpu = found["device"] != "cpu"
    if found["threads"] != settings.threads or (
        settings.accelerator != "auto" and on_gpu == (settings.accelerator == "cpu")
    ):
        kind = "gpu" if on_gpu else "cpu"
        names = numbered(file.with_name(f"runtime-{kind}-{found['threads']}.json"))
        file.rename(next(name for name in names if not name.exists()))


def _launch(
    sweep: Sweep, jobs: Sequence[Job], words: Sequence[str], task: Callable[..., Any], extra: Sequence[str]
) -> None:
    """Run jobs by the launcher. If it breaks down (a worker was killed), it is started again for the remaining jobs.

    On a cluster the other jobs may go on without it, so the runs that are still in work are waited for.
    """
    left = list(jobs)
    for _ in range(ATTEMPTS):
        if not left:
            return
        try:
            compose.launch("train", words, [list(job.overrides) for job in left], task, extra)
            return
        except ConfigError:
            raise
        except Exception as error:
            print(f"the launcher broke down ({kind_and_message(error, 200)})", flush=True)
            while running := sum(sweep.state(job) == "running" for job in left):
                print(f"waiting for {running} runs that go on", flush=True)
                while sum(sweep.state(job) == "running" for job in left) == running:
                    time.sleep(PAUSE)
            left = [job for job in left if sweep.state(job) not in ("done", "failed")]
            print(f"{len(left)} runs are left", flush=True)
    for job in left:
        if sweep.state(job) in ("interrupted", "trained, not scored"):
            sweep.fail(job.run, KILLED)


def _search(sweep: Sweep, words: Sequence[str], task: Callable[..., Any], extra: Sequence[str]) -> bool:
    """Continue a searching sweep: finish the runs that it has chosen already, then let the sweeper choose further runs.

    Returns:
        whether the sweeper has chosen all runs that it was asked for.
    """
    found = sweep.jobs
    _launch(sweep, [job for job in found if sweep.state(job) != "done"], words, task, extra)
    trials = compose.trials("train", words, extra)
    if trials is not None and trials <= len(found):
        return True
    more = [] if trials is None else [f"hydra.sweeper.n_trials={trials - len(found)}"]
    try:
        compose.multirun("train", [*words, *more], task, extra)
    except Exception as error:  # no run gave a result, for example
        if isinstance(error, ConfigError) and len(sweep.jobs) == len(found):
            raise
        print(f"the search ended early ({kind_and_message(error, 200)})", flush=True)
        return False
    return True
