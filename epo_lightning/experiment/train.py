"""One training run: check, make the folder, fit, and say what to do next."""

from __future__ import annotations

import contextlib
import math
import platform
import shlex
import shutil
import subprocess
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Timer

from epo_lightning.experiment import assembly, callbacks, distributed, gpus, logs
from epo_lightning.experiment.config.compose import PACKAGE
from epo_lightning.experiment.config.settings import EvaluateSettings, Settings, read
from epo_lightning.experiment.evaluate import score
from epo_lightning.identity import differences, identity, row_identity
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import FAILED, FINISHED, TRAINING, RunFolder

NOT_IN_COMMAND = ("sweep=", "existing=", "runs=", "run_dir=", "resume=")
"""Words of a command line that say nothing of what was trained."""
PACKAGES = ("epo_lightning", "torch", "lightning", "hydra-core", "omegaconf", "torchmetrics", "numpy", "numba")


class Diverged(ConfigError):
    """A training that came to nothing."""


def folder_for(settings: Settings) -> RunFolder:
    """``<runs>/<experiment>/<budget>-s<seed>``, and its variant where it is not just that experiment and budget."""
    if settings.run_dir:
        return RunFolder(Path(settings.run_dir).expanduser())
    group = settings.experiment or f"custom/{settings.forecaster['name']}"
    name = f"{settings.budget.name}-s{settings.seed}" + (f"-{settings.variant}" if settings.variant else "")
    return RunFolder(Path(settings.runs).expanduser() / group / name)


def train(config: dict[str, Any], overrides: Sequence[str] = ()) -> RunFolder:
    """Train what ``config`` describes, and score it if the configuration says so.

    Args:
        config: the resolved configuration of ``epo train``.
        overrides: what the user changed; written to run.json.

    Raises:
        ConfigError: the configuration cannot work, its data is missing, the folder holds a run already, or another process
            works on it.
    """
    assembly.quiet()
    settings = read(Settings, config)
    assembly.check(settings)
    run = folder_for(settings)
    if distributed.followed(settings.trainer.devices, run):
        return run
    refuse_occupied(settings, run)
    data = None if run.record_file.is_file() else ready(settings)  # missing data is said before a folder is made
    # In a sweep, whoever has the run already may finish it for us.
    with run.lock(wait=None if settings.sweep else 2.0), gpus.placed(settings.trainer):
        if not run.record_file.is_file():
            refuse_occupied(settings, run)
            run.begin(config, _record(settings, config, data or ready(settings), overrides))
            _fit(settings, config, run)
        elif run.finished:
            refuse_other(run, config)
        else:
            _continue(run, config)
        _score(settings, run)
    return run


def resume(run: RunFolder) -> None:
    """Continue a run that was stopped, with its own configuration, from its last finished epoch.

    Raises:
        ConfigError: the run is finished, its checkpoint or data is not the one that it began with, or another process works
            on it.
    """
    assembly.quiet()
    if distributed.followed(read(Settings, run.config()).trainer.devices, run):
        return
    if run.finished:
        raise ConfigError(f"{run.path} is finished: score it with `epo evaluate run={run.path}`")
    config = run.config()
    settings = read(Settings, config)
    with run.lock(), gpus.placed(settings.trainer):
        _continue(run, config)
        _score(settings, run)


def _continue(run: RunFolder, config: dict[str, Any]) -> None:
    """Train on from the last finished epoch. ``config`` must be the run's own, wherever it may write and log now."""
    refuse_other(run, config)
    last = run.checkpoint("last")
    run.update(status=TRAINING, error=None)
    _fit(read(Settings, config), config, run, last if last.is_file() else None)


def refuse_other(run: RunFolder, config: dict[str, Any]) -> None:
    """A run goes on with the configuration and the data that it began with.

    Raises:
        ConfigError: one of them has changed; the message names the difference.
    """
    if differing := differences(run.config(), config):
        shown = ", ".join(f"{key}: {there!r} there, {here!r} here" for key, there, here in differing[:5])
        raise ConfigError(
            f"{run.path} was begun with another configuration ({shown}): "
            f"continue it as it is with `epo train resume={run.path}`, or choose another run_dir"
        )
    began_with, digest = run.record.get("data_digest"), assembly.build_data(config["data"]).digest
    if began_with != digest:
        raise ConfigError(
            f"the data of {run.path} has changed since the run began (digest {began_with}, now {digest}): "
            "bring back the data, or begin a new run"
        )


def _score(settings: Settings, run: RunFolder) -> None:
    """Measure what the configuration asks for, except what was measured already."""
    for which in settings.measures:
        if run.metrics_file(which).is_file():
            continue
        if which == "time":
            from epo_lightning.experiment.timing import measure

            measure(run, settings)
        else:
            score(run, EvaluateSettings(run=str(run.path), split=which), settings.trainer)


def _fit(settings: Settings, config: dict[str, Any], run: RunFolder, last: Path | None = None) -> None:
    """Train from the beginning, or from the checkpoint ``last``; an error is also left in run.json."""
    try:
        with assembly.signals():
            _train(settings, config, run, last)
    except Exception as error:
        with contextlib.suppress(OSError, ConfigError):  # the disk may be what failed
            run.update(status=FAILED, error=f"{type(error).__name__}: {' '.join(str(error).split())}"[:500])
        raise
    finally:
        with contextlib.suppress(OSError):
            run.progress_file.unlink(missing_ok=True)


def _train(settings: Settings, config: dict[str, Any], run: RunFolder, last: Path | None) -> None:
    started = time.monotonic()
    timer = Timer()  # it is kept in the checkpoint: what a killed process had done counts
    seed_everything(settings.seed, workers=True, verbose=False)
    data = ready(settings)
    model = assembly.build_model(settings, data)
    step = _steps_in(last, model) if last else 0
    with logs.open_logs(settings, config, run, step) as loggers:
        watchers = [*callbacks.watchers(settings.callbacks, run, f"{settings.title}, seed {settings.seed}"), timer]
        bar = any(isinstance(watcher, callbacks.TQDMProgressBar) for watcher in watchers)
        learns = assembly.parameters(model) > 0 and settings.trainer.max_steps != 0
        strategy = distributed.strategy(settings.trainer.devices, run, config, last) if learns else None
        trainer = assembly.build_trainer(settings.trainer, run, watchers, loggers, bar, strategy)
        run.update(parameters=assembly.parameters(model))
        if learns:
            trainer.fit(
                model, assembly.as_data(data, settings.trainer.overfit_batches), ckpt_path=last, weights_only=True
            )
        else:
            _keep_unlearned(trainer, model, data, run)
        best = _best_score(run, trainer, settings.callbacks.monitor)
    run.update(
        status=FINISHED,
        epochs=trainer.fit_loop.epoch_progress.current.ready,  # current_epoch lags where there was no step left to make
        steps=trainer.global_step,
        best={settings.callbacks.monitor: best},
        seconds=round(timer.time_elapsed() if learns else time.monotonic() - started, 3),
    )


def _keep_unlearned(trainer: Trainer, model: LightningModule, data: Any, run: RunFolder) -> None:
    """What does not learn, for lack of parameters or of steps, is validated once and kept like any other."""
    trainer.validate(model, assembly.as_data(data), verbose=False)
    run.checkpoints.mkdir(parents=True, exist_ok=True)
    trainer.save_checkpoint(run.checkpoint("last"))
    shutil.copyfile(run.checkpoint("last"), run.checkpoint("best"))


def _best_score(run: RunFolder, trainer: Trainer, monitor: str) -> float:
    """The smallest validation score.

    Raises:
        Diverged: there is no finite one.
    """
    watchers = [w for w in trainer.checkpoint_callbacks if isinstance(w, callbacks.ModelCheckpoint) and w.monitor]
    best = [w.best_model_score for w in watchers]
    score = next((float(value) for value in best if value is not None), None)
    score = float(trainer.callback_metrics.get(monitor, math.nan)) if score is None else score
    if not math.isfinite(score):
        raise Diverged(
            f"{run.path}: {trainer.global_step} steps without a single finite validation score; look at "
            f"{run.logs / 'metrics.csv'}, and try a smaller optimizer.lr, or optimizer.clip=1"
        )
    return score


def ready(settings: Settings) -> Any:
    """The data module with its training data found and verified."""
    data = assembly.build_data(settings.data)
    data.order_seed = settings.seed
    data.setup("fit")
    return data


def load_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents: tensors and plain values only, no code is run.

    Raises:
        ConfigError: the file is missing, or is not a checkpoint.
    """
    if not path.is_file():
        raise ConfigError(f"no checkpoint {path}: the file does not exist; train first")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds for damaged files
        raise ConfigError(f"{path} is not a checkpoint, or is damaged: {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict) or "state_dict" not in content:
        raise ConfigError(f"{path} is not a checkpoint of this project: it holds no state_dict")
    return content


def _steps_in(path: Path, model: LightningModule) -> int:
    content = load_checkpoint(path)
    shapes = {key: tuple(value.shape) for key, value in content["state_dict"].items()}
    expected = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    for key in sorted({*shapes, *expected}):
        if shapes.get(key) != expected.get(key):
            raise ConfigError(
                f"{path} belongs to another architecture: {key} is {shapes.get(key, 'absent')} there and "
                f"{expected.get(key, 'absent')} in this configuration"
            )
    return int(content.get("global_step", 0))


def refuse_occupied(settings: Settings, run: RunFolder) -> None:
    """Nothing is ever overwritten.

    Raises:
        ConfigError: the folder holds something, and it is not a run that ``settings`` may continue.
    """
    if run.exists and not (settings.existing == "continue" and run.record_file.is_file()):
        raise ConfigError(_occupied(run))


def _occupied(run: RunFolder) -> str:
    if not run.record_file.is_file():
        return f"{run.path} exists and is not a run folder: nothing is overwritten; choose another run_dir=<folder>"
    if run.finished:
        return (
            f"{run.path} holds a finished run: nothing is overwritten; score it with `epo evaluate run={run.path}`, "
            "or choose another seed=<number> or run_dir=<folder>"
        )
    return (
        f"{run.path} holds an unfinished run: continue it with `epo train resume={run.path}`, "
        "or choose another run_dir=<folder>"
    )


def _record(settings: Settings, config: dict[str, Any], data: Any, overrides: Sequence[str]) -> dict[str, Any]:
    words = [word for word in overrides if not word.startswith(NOT_IN_COMMAND)]
    return {
        "identity": identity(config, data.digest),
        "row": row_identity(config, data.digest),
        "title": settings.title,
        "experiment": settings.experiment,
        "forecaster": settings.forecaster["name"],
        "goal": settings.goal,
        "seed": settings.seed,
        "budget": settings.budget.name,
        "data": settings.data.get("dataset", settings.data["name"]),
        "data_digest": data.digest,
        "command": shlex.join(["epo", "train", *words]),
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "git_commit": _commit(),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The checkout's commit, with a ``+`` if files were changed since; None outside a checkout."""
    root = PACKAGE.parent
    if not (root / ".git").exists():
        return None
    try:
        commit = subprocess.run(["git", "-C", root, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run(
            ["git", "-C", root, "status", "--porcelain"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit.stdout.strip() + ("+" if changes.stdout.strip() else "")
