"""One run of a sweep: its job, and its training in a process that a launcher chooses."""

from __future__ import annotations

import contextlib
import os
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from epo_lightning.experiment import assembly
from epo_lightning.experiment import train as training
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.sweeps.orphans import end_with
from epo_lightning.experiment.sweeps.sweep import Job, Sweep
from epo_lightning.experiment.sweeps.watch import names_of
from epo_lightning.identity import identity
from epo_lightning.masking import mask
from epo_lightning.registry import kind_and_message
from epo_lightning.report.runs import data_name
from epo_lightning.schema import read


class RunFailed(RuntimeError):
    """Error for a failed run of a sweep. It has only a message, so that it can be sent to another process."""


def job_of(config: Mapping[str, Any], overrides: Sequence[str]) -> Job:
    """The job of a resolved configuration, after a check of the configuration; writes no file.

    Raises:
        ConfigError: as :func:`assembly.check_buildable`.
    """
    settings = read(Settings, config)
    data, _ = assembly.check_buildable(settings, overrides)
    return Job(
        tuple(overrides),
        training.folder_for(settings),
        identity(config, data.digest),
        settings.title,
        settings.seed,
        settings.measures,
        data_name(settings.data),
    )


def work(sweep: Sweep, config: Mapping[str, Any], overrides: Sequence[str], options: Sequence[str]) -> float | None:
    """Train and score one of the runs of a sweep. A launcher calls this in a process of its choice.

    Args:
        sweep: the sweep.
        config: configuration of the run.
        overrides: overrides of the run.
        options: options of the sweep's command line, which the run's record repeats.

    Returns:
        the best validation score; None for a run that is skipped because another one failed (``--stop-on-failure``).

    Raises:
        RunFailed: the run failed; the sweep's folder holds the traceback.
    """
    record = sweep.record
    # A worker on another machine may have another working folder and other environment variables.
    with contextlib.suppress(OSError):
        os.chdir(record["directory"])
    if record["cache"]:
        os.environ.setdefault("EPO_CACHE", record["cache"])
    if record["stop_on_failure"] and sweep.has_failures:
        return None
    end_with(record["process"])
    settings = read(Settings, config)
    run = training.folder_for(settings)
    try:
        if not record["jobs"]:
            sweep.add(job_of(config, overrides))
        names = {path.resolve(): name for path, name in names_of(sweep.jobs).items()}
        training.train(dict(config), [*overrides, *options], name=names.get(run.path.resolve(), ""))
    except Exception as error:
        message = mask(kind_and_message(error))
        message = message.replace(f"{sweep.root}{os.sep}", f"{os.path.relpath(sweep.root)}{os.sep}")
        sweep.fail(run, message, mask(traceback.format_exc()))
        raise RunFailed(f"{settings.title}, seed {settings.seed}: {message}") from None
    return next(iter(run.record.get("best", {}).values()), None)
