"""One training run: check, make the folder, fit, and say what to do next."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import shutil
import subprocess
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer, seed_everything

from epo_lightning.experiment import assembly, callbacks
from epo_lightning.experiment.compose import PACKAGE
from epo_lightning.experiment.settings import Settings, read
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import FINISHED, RunFolder

# What does not make it another run: these are in the folder's name, or do not touch the result.
NOT_HASHED = ("experiment", "seed", "budget", "sweeps", "runs", "run_dir", "existing", "logger", "hydra", "title")
NOT_HASHED_KEYS = ("trainer.threads", "callbacks.progress", "callbacks.refresh")
PACKAGES = ("epo_lightning", "torch", "lightning", "hydra-core", "omegaconf", "torchmetrics", "numpy", "numba")


def folder_for(settings: Settings, overrides: Sequence[str]) -> RunFolder:
    """``<runs>/<experiment>/<budget>-s<seed>``, and a hash of the other overrides where there are any."""
    if settings.run_dir:
        return RunFolder(Path(settings.run_dir).expanduser())
    keys = {text: text.lstrip("+~").split("=")[0].split("@")[0] for text in overrides}
    special = sorted(t for t, key in keys.items() if key.split(".")[0] not in NOT_HASHED and key not in NOT_HASHED_KEYS)
    suffix = "-" + hashlib.sha256("\n".join(special).encode()).hexdigest()[:6] if special else ""
    group = settings.experiment or f"custom/{settings.forecaster['name']}"
    return RunFolder(Path(settings.runs).expanduser() / group / f"{settings.budget.name}-s{settings.seed}{suffix}")


def train(config: dict[str, Any], overrides: Sequence[str] = ()) -> tuple[RunFolder, dict[str, float]]:
    """Train what ``config`` describes.

    Args:
        config: the resolved configuration of ``epo train``.
        overrides: what the user changed; names the run folder and is written to run.json.

    Returns:
        the run folder and the last validation metrics of a run that was fitted (empty if it was finished already).

    Raises:
        ConfigError: the configuration cannot work, its data is missing, or the folder holds a run already.
    """
    assembly.quiet()
    settings = read(Settings, config)
    assembly.check(settings)
    run = folder_for(settings, overrides)
    if run.exists:
        refuse_occupied(settings, run)
        if run.record_file.is_file():
            if run.finished:
                print(f"{settings.title}: {run.path} is finished, nothing to do")
                return run, {}
            return resume(run, config)
    data = _ready(settings)
    run.begin(config, _record(settings, data, overrides))
    return run, _fit(settings, config, run)


def resume(run: RunFolder, expected: dict[str, Any] | None = None) -> tuple[RunFolder, dict[str, float]]:
    """Continue a run that was stopped, with its own configuration, from its last finished epoch.

    Args:
        expected: the configuration that the caller has in mind, where there is one; it must be the run's own.

    Raises:
        ConfigError: the run is finished, or its checkpoint, data or configuration is not the one that it began with.
    """
    assembly.quiet()
    config = run.config()
    if expected is not None and (differing := _differences(_essence(config), _essence(expected))):
        raise ConfigError(
            f"{run.path} was begun with another configuration ({', '.join(differing[:5])}): "
            f"continue it as it is with `epo train resume={run.path}`, or choose another run_dir"
        )
    settings = read(Settings, config)
    if run.finished:
        raise ConfigError(f"{run.path} is finished: score it with `epo evaluate run={run.path}`")
    data = _ready(settings)
    began_with = run.record.get("data_digest")
    if began_with != data.digest:
        raise ConfigError(
            f"the data of {run.path} has changed since the run began (digest {began_with}, now {data.digest}): "
            "bring back the data, or begin a new run"
        )
    last = run.checkpoint("last")
    return run, _fit(settings, config, run, last if last.is_file() else None)


def _fit(settings: Settings, config: dict[str, Any], run: RunFolder, last: Path | None = None) -> dict[str, float]:
    """Train from the beginning, or from the checkpoint ``last``."""
    started = time.monotonic()
    seed_everything(settings.seed, workers=True, verbose=False)
    data = _ready(settings)
    model = assembly.build_model(settings, data)
    step = _steps_in(last, model) if last else 0
    loggers = callbacks.logs(settings.logger, run, settings.title, config, step)
    watchers = callbacks.watchers(settings.callbacks, run, settings.title)
    bar = any(isinstance(watcher, callbacks.TQDMProgressBar) for watcher in watchers)
    trainer = assembly.build_trainer(settings.trainer, run, watchers, loggers, bar)
    run.update(parameters=assembly.parameters(model))
    try:
        if assembly.parameters(model):
            trainer.fit(model, assembly.as_data(data), ckpt_path=last, weights_only=True)
        else:
            _keep_unlearned(trainer, model, data, run)
    finally:
        callbacks.close(loggers)
    if trainer.interrupted:
        raise KeyboardInterrupt
    _check_learned(run, trainer)
    metrics = {key: float(value) for key, value in trainer.callback_metrics.items() if key.startswith("val/")}
    best = [w.best_model_score for w in watchers if getattr(w, "monitor", None) and hasattr(w, "best_model_score")]
    score = float(best[0]) if best and best[0] is not None else metrics.get(settings.callbacks.monitor)
    run.update(
        status=FINISHED,
        epochs=trainer.current_epoch,
        steps=trainer.global_step,
        best={settings.callbacks.monitor: score},
        seconds=round(run.record.get("seconds", 0.0) + time.monotonic() - started, 1),
    )
    return metrics


def _keep_unlearned(trainer: Trainer, model: LightningModule, data: Any, run: RunFolder) -> None:
    """A forecaster without parameters is validated once and kept like any other."""
    trainer.validate(model, assembly.as_data(data), verbose=False)
    run.checkpoints.mkdir(parents=True, exist_ok=True)
    trainer.save_checkpoint(run.checkpoint("last"))
    shutil.copyfile(run.checkpoint("last"), run.checkpoint("best"))


def _check_learned(run: RunFolder, trainer: Trainer) -> None:
    if not run.checkpoint("best").is_file():
        raise ConfigError(
            f"{run.path}: {trainer.global_step} steps without a single finite validation score; look at "
            f"{run.logs / 'metrics.csv'}, and try a smaller optimizer.lr, or optimizer.clip=1"
        )


def _ready(settings: Settings) -> Any:
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


def _essence(config: dict[str, Any]) -> dict[str, Any]:
    """The part of a configuration that decides on the result."""
    ignored = ("existing", "run_dir", "runs", "resume", "logger")
    return json.loads(json.dumps({key: value for key, value in config.items() if key not in ignored}))


def _differences(one: Any, other: Any, where: str = "") -> list[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        keys = sorted({*one, *other})
        return [
            found for key in keys for found in _differences(one.get(key), other.get(key), f"{where}.{key}".strip("."))
        ]
    same = one == other or (
        isinstance(one, float) and isinstance(other, float) and math.isnan(one) and math.isnan(other)
    )
    return [] if same else [f"{where}: {one!r} there, {other!r} here"]


def _record(settings: Settings, data: Any, overrides: Sequence[str]) -> dict[str, Any]:
    return {
        "title": settings.title,
        "experiment": settings.experiment,
        "forecaster": settings.forecaster["name"],
        "goal": settings.goal,
        "seed": settings.seed,
        "budget": settings.budget.name,
        "data": settings.data.get("dataset", settings.data["name"]),
        "data_digest": data.digest,
        "command": " ".join(["epo", "train", *overrides]),
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
