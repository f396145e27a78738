"""One training run: check it, make its folder, fit, measure."""

from __future__ import annotations

import contextlib
import math
import platform
import shlex
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Timer

from epo_lightning.experiment import assembly, callbacks, debugging, distributed, follower, gpus, logs, step_graph
from epo_lightning.experiment.config.settings import EvaluateSettings, Measured, Settings
from epo_lightning.experiment.evaluate import score
from epo_lightning.experiment.opening import refuse_changed, settings_of
from epo_lightning.experiment.provenance import commit, of_other_code, versions
from epo_lightning.forecasters.checkpoint import read_checkpoint
from epo_lightning.identity import check_unchanged, differences, identity, row_identity
from epo_lightning.registry import ConfigError, kind_and_message
from epo_lightning.report.columns import is_own
from epo_lightning.run_folder import FAILED, FINISHED, TRAINING, RunFolder
from epo_lightning.schema import read

NOT_IN_COMMAND = ("sweep=", "existing=", "runs=", "run_dir=", "resume=")
"""Overrides that do not change what is trained, and are left out of the recorded command."""


class Diverged(ConfigError):
    """Error for a training without a single finite validation score."""


def folder_for(settings: Settings) -> RunFolder:
    """The run's folder, ``<runs>/<experiment>/<budget>-s<seed>``; ``run_dir`` replaces it.

    If the settings differ from those of the experiment and the budget, the name ends with ``-<variant>``, a hash of the
    settings.
    """
    if settings.run_dir:
        return RunFolder(Path(settings.run_dir).expanduser())
    group = settings.experiment or f"custom/{settings.forecaster['name']}"
    name = f"{settings.budget.name}-s{settings.seed}" + (f"-{settings.variant}" if settings.variant else "")
    return RunFolder(Path(settings.runs).expanduser() / group / name)


def train(
    config: dict[str, Any], overrides: Sequence[str] = (), begun: RunFolder | None = None, name: str = ""
) -> RunFolder:
    """Train a forecaster as ``config`` describes, and score it if the configuration asks for it.

    Args:
        config: the resolved configuration of ``epo train`` as plain values; the code reads it as checked ``settings``.
        overrides: the user's overrides, recorded in run.json.
        begun: a run to continue; ``config`` is then the configuration in its folder. None for a new run.
        name: name of the run in lines about its progress; title and seed if it is empty.

    Raises:
        ConfigError: the configuration cannot work, its data is missing, the folder holds a run already, or another process
            works on it.
    """
    assembly.quiet()
    settings = read(Settings, config)
    seed_everything(settings.seed, workers=True, verbose=False)
    data, forecaster = assembly.build(settings, overrides)
    gpus.accelerator(settings.trainer)  # raises an error for a missing GPU before a run folder is made
    run = begun or folder_for(settings)
    if settings.trainer.devices > 1 and follower.trained_as_follower(settings.trainer.devices, run):
        return run
    if begun is None:
        refuse_occupied(settings, run, data.digest)
    if not run.finished:
        data.words = overrides
        data.setup("fit")  # raises an error for missing data before a run folder is made
    # In a sweep, another process may be training this run: wait until it has finished. Otherwise wait two seconds.
    patience = None if settings.sweep and begun is None else 2.0
    with run.lock(wait=patience), gpus.placed(settings.trainer) as devices, _continuation(run):
        if run.record_file.is_file():
            refuse_other(run, config, data)
            if not run.finished:
                run.update(status=TRAINING, error=None)
        else:
            # Again, now under the lock: another process may have begun the run.
            refuse_occupied(settings, run, data.digest)
            run.begin(config, _record(settings, config, data.digest, overrides))
        if not run.finished:
            with _errors_recorded(run), assembly.signals():
                fit(settings, config, run, data, forecaster, devices, name or f"{settings.title}, seed {settings.seed}")
        for which in settings.measures:
            if not run.metrics_file(which).is_file():
                measure(run, settings, which, devices)
    return run


def resume(run: RunFolder) -> None:
    """Continue a run that was stopped, with its own configuration, from its last finished epoch, and make its measurements.

    Raises:
        ConfigError: the run is finished and measured, its settings or its data have changed, its checkpoint is damaged or
            belongs to another architecture, or another process works on the run.
    """
    settings = settings_of(run)
    complete = run.finished and all(run.metrics_file(which).is_file() for which in settings.measures)
    if complete and distributed.here(settings.trainer.devices).leads:
        raise ConfigError(f"{run.path} is finished: `epo evaluate run={run.path}` scores it")
    train(run.config(), begun=run)


def fit(
    settings: Settings,
    config: dict[str, Any],
    run: RunFolder,
    data: Any,
    forecaster: LightningModule,
    devices: int | list[int],
    name: str,
) -> None:
    """Train from the beginning, or from the last finished epoch of the run, and record the result in run.json.

    Args:
        settings: the checked settings of the run.
        config: the same configuration as plain values, for dashboards and for processes on other devices.
        run: the run folder, locked by the caller.
        data: the data module.
        forecaster: the forecaster with its initial weights.
        devices: number or indices of devices, as :func:`.gpus.placed` yields them.
        name: name of the run in lines about its progress.
    """
    started = time.monotonic()
    last = run.checkpoint("last") if run.checkpoint("last").is_file() else None
    step = _steps_in(last, forecaster) if last else 0
    learned = assembly.parameters(forecaster)
    learns = learned > 0 and settings.trainer.max_steps != 0
    timer = Timer()  # its state is part of the checkpoint, so the time before a kill is counted as well
    watchers = [*callbacks.run_callbacks(settings.callbacks, run, name), timer]
    if settings.trainer.graph:
        watchers.append(step_graph.StepGraph())
    strategy = None
    if settings.trainer.devices > 1:
        strategy = distributed.strategy(settings.trainer.devices, run, config, last) if learns else None
        devices = devices if learns else 1
    run.update(parameters=learned)
    with logs.open_logs(settings, config, run, step) as loggers:
        trainer = assembly.build_trainer(settings.trainer, run, watchers, loggers, devices, strategy)
        if not learns:
            _keep_unlearned(trainer, forecaster, data, run)
        else:
            few = settings.trainer.overfit_batches
            batches = debugging.FewBatches(data, few) if few else data
            trainer.fit(forecaster, batches, ckpt_path=last, weights_only=True)
        best = _best_score(run, trainer, settings.callbacks.monitor)
    run.update(
        status=FINISHED,
        epochs=trainer.fit_loop.epoch_progress.current.ready,  # current_epoch is too small if the last epoch made no step
        steps=trainer.global_step,
        best={settings.callbacks.monitor: best},
        seconds=round(timer.time_elapsed() if learns else time.monotonic() - started, 3),
    )


@contextlib.contextmanager
def _continuation(run: RunFolder) -> Iterator[None]:
    """Context in which an interruption says, in a note, how the run continues."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as ending:
        if run.record_file.is_file():
            ending.add_note(f"continue with `epo train resume={run.path}`")
        raise


@contextlib.contextmanager
def _errors_recorded(run: RunFolder) -> Iterator[None]:
    """Context that records an error of the training in run.json and raises it again."""
    try:
        yield
    except Exception as error:
        with contextlib.suppress(OSError, ConfigError):  # the disk may be what failed
            run.update(status=FAILED, error=kind_and_message(error, 500))
        raise
    finally:
        with contextlib.suppress(OSError):
            run.progress_file.unlink(missing_ok=True)


def measure(run: RunFolder, settings: Settings, which: Measured, devices: int | list[int]) -> None:
    """Measure the scores of a finished run on a split, or the time of its forecasts."""
    if which == "time":
        from epo_lightning.experiment import timing

        timing.measure(run, settings, devices)
    else:
        score(run, EvaluateSettings(run=str(run.path), split=which), settings.trainer, devices)


def refuse_other(run: RunFolder, config: dict[str, Any], data: Any) -> None:
    """Refuse to continue a run with another configuration or other data than it began with; warn of other code.

    Raises:
        ConfigError: the configuration or the data has changed; the message names the difference.
    """
    begun_with = run.config()
    differing = differences(begun_with, config)
    shown = ", ".join(f"{key}: {there!r} there, {here!r} here" for key, there, here in differing[:5])
    try:
        check_unchanged(begun_with, run.record, run.config_file)
    except ConfigError as changed:
        raise ConfigError(f"{changed} ({shown or 'no difference to the settings of this command'})") from changed
    if differing:
        raise ConfigError(
            f"{run.path} was begun with another configuration ({shown}): "
            f"continue it as it is with `epo train resume={run.path}`, or choose another run_dir"
        )
    refuse_changed(run, data)
    if not run.finished and of_other_code(run.record):
        warnings.warn(
            f"{run.path} began with other code than the present one, with which it continues: a Python file has changed. "
            "For a run of one code, choose another run_dir=<folder>",
            stacklevel=2,
        )


def _keep_unlearned(trainer: Trainer, model: LightningModule, data: Any, run: RunFolder) -> None:
    """Validate once and write the checkpoints, for a forecaster with nothing to learn (no parameters, or zero steps)."""
    trainer.validate(model, data, verbose=False)
    run.checkpoints.mkdir(parents=True, exist_ok=True)
    for name in ("last", "best"):
        trainer.save_checkpoint(run.checkpoint(name))


def _best_score(run: RunFolder, trainer: Trainer, monitor: str) -> float:
    """The smallest validation score.

    Raises:
        Diverged: no validation score is finite.
        ConfigError: the training ended before its first validation.
    """
    watchers = [w for w in trainer.checkpoint_callbacks if isinstance(w, callbacks.ModelCheckpoint) and w.monitor]
    best = [w.best_model_score for w in watchers]
    score = next((float(value) for value in best if value is not None), None)
    if score is None and is_own(monitor):
        raise ConfigError(
            f"{run.path}: no validation has a value of callbacks.monitor={monitor}, so there is no best checkpoint: monitor "
            "another score"
        )
    if score is None and monitor not in trainer.callback_metrics:
        raise ConfigError(
            f"{run.path}: the training ended after {trainer.global_step} steps, before its first validation: validate more "
            "often (trainer.validate_every, trainer.validate_steps) or train longer (trainer.max_steps, trainer.max_epochs)"
        )
    score = float(trainer.callback_metrics.get(monitor, math.nan)) if score is None else score
    if not math.isfinite(score):
        raise Diverged(
            f"{run.path}: {trainer.global_step} steps without a single finite validation score; look at "
            f"{run.logs / 'metrics.csv'}, and try a smaller optimizer.lr, or optimizer.clip=1"
        )
    return score


def _steps_in(path: Path, model: LightningModule) -> int:
    """Number of optimisation steps of a checkpoint, after a check that its weights have the shapes of ``model``.

    Raises:
        ConfigError: the checkpoint is damaged or belongs to another architecture.
    """
    try:
        content = read_checkpoint(path)
    except ConfigError as error:
        raise ConfigError(
            f"{error}: a training cannot continue without it. Move the run folder away, and train again; "
            f"`epo_lightning.load` reads the best epoch, {path.with_name('best.ckpt')}, if it is not damaged as well"
        ) from error
    shapes = {key: tuple(value.shape) for key, value in content["state_dict"].items()}
    expected = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    for key in sorted({*shapes, *expected}):
        if shapes.get(key) != expected.get(key):
            raise ConfigError(
                f"{path} belongs to another architecture: {key} is {shapes.get(key, 'absent')} there and "
                f"{expected.get(key, 'absent')} in this configuration"
            )
    return int(content.get("global_step", 0))


def refuse_occupied(settings: Settings, run: RunFolder, digest: str) -> None:
    """Refuse a folder whose contents a new run on the data of this digest would overwrite.

    Raises:
        ConfigError: the folder holds something other than a run that ``settings`` may continue (``existing=continue``).
    """
    if run.exists and not (settings.existing == "continue" and run.record_file.is_file()):
        raise ConfigError(_occupied(run, digest))


def _occupied(run: RunFolder, digest: str) -> str:
    if not run.record_file.is_file():
        return f"{run.path} exists and is not a run folder: nothing is overwritten; choose another run_dir=<folder>"
    if (began_with := run.record.get("data_digest")) != digest:
        return (
            f"{run.path} holds a run on other data (digest {began_with}, now {digest}; the name of a run's folder does not "
            "depend on it): nothing is overwritten; choose another run_dir=<folder> or runs=<folder>"
        )
    if run.finished:
        other = " of other code than the present one" if of_other_code(run.record) else ""
        return (
            f"{run.path} holds a finished run{other}: nothing is overwritten; score it with `epo evaluate run={run.path}`, "
            "choose another seed=<number> or run_dir=<folder>, or skip finished runs with existing=continue"
        )
    return (
        f"{run.path} holds an unfinished run: continue it with `epo train resume={run.path}`, "
        "or by the same command with existing=continue, or choose another run_dir=<folder>"
    )


def _record(settings: Settings, config: dict[str, Any], data_digest: str, overrides: Sequence[str]) -> dict[str, Any]:
    words = [word for word in overrides if not word.startswith(NOT_IN_COMMAND)]
    return {
        "identity": identity(config, data_digest),
        "row": row_identity(config, data_digest),
        "title": settings.title,
        "experiment": settings.experiment,
        "forecaster": settings.forecaster["name"],
        "goal": settings.goal,
        "seed": settings.seed,
        "budget": settings.budget.name,
        "data": settings.data.get("dataset", settings.data["name"]),
        "data_digest": data_digest,
        "command": shlex.join(["epo", "train", *words]),
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": {"python": platform.python_version(), **versions()},
        "git_commit": commit(),
    }
