"""From settings to the objects of a run: data, forecaster and trainer."""

from __future__ import annotations

import logging
import signal
import threading
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins import DoublePrecision
from lightning.pytorch.strategies import Strategy
from lightning.pytorch.utilities.exceptions import SIGTERMException

from epo_lightning import registry
from epo_lightning.backbones.base import Backbone
from epo_lightning.backbones.trial import try_backbone
from epo_lightning.data.datamodule import check_divisible
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.experiment import debugging, gpus, step_graph
from epo_lightning.experiment.checkpoints import WholeCheckpoints
from epo_lightning.experiment.config.replaced import keys_of
from epo_lightning.experiment.config.settings import PARTS, Settings, TrainerSettings
from epo_lightning.experiment.dashboards import mlflow
from epo_lightning.forecasters import SUPPLIED, Forecaster, build_forecaster
from epo_lightning.game.features import OWN_FEATURES
from epo_lightning.metrics.forecast import EQUILIBRIUM_METRICS, PAIR_METRICS, scores
from epo_lightning.registry import ConfigError, nearest, one_line
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import check_part
from epo_lightning.task import Task


def build_data(section: Mapping[str, Any]) -> Any:
    """The data module of a configuration; no data is read yet.

    Raises:
        ConfigError: an unknown part or key, or a value that it refuses.
    """
    check_part("data", section)
    data = registry.build("data", section)
    if not isinstance(getattr(data, "task", None), Task):
        raise ConfigError(
            f"data {section['name']!r} declares no task: set {type(data).__name__}.task to an epo_lightning.task.Task"
        )
    return data


def describe_model(settings: Settings, data: Any) -> dict[str, Any]:
    """The model's configuration as plain values, which checkpoints store: all parts but ``data``, and also
    ``goal`` and the fields of the task.

    It is the argument of :func:`~epo_lightning.forecasters.build_forecaster`.
    """
    sections = {group: dict(getattr(settings, group)) for group in PARTS if group != "data"}
    return {**sections, "goal": settings.goal, **data.task.to_config()}


def refuse_missing_folder(data: Any, given: Collection[str]) -> None:
    """Refuse a folder of recordings that the user has named and that does not exist, because a misspelt name would have the
    same effect as no folder: the cache would be searched for a data set of these settings.

    Args:
        data: a data module.
        given: keys that the user has set.

    Raises:
        ConfigError: ``data.folder`` is one of them, and there is no such folder.
    """
    if isinstance(data, RecordedData) and "data.folder" in given and not data.folder_of_recordings.exists():
        raise ConfigError(
            f"data.folder={data.folder_of_recordings}: there is no such folder; correct it, or leave data.folder out if the "
            "recordings are not on this machine: a data set that was extracted from them is then searched in the cache"
        )


def refuse_unread_bounds(energy: Mapping[str, Any], given: Collection[str]) -> None:
    """Refuse bounds that the user has set and no feature of the energy reads. (Files of energies may have further bounds.)

    Args:
        energy: the section of the energy.
        given: keys of bounds that the user has set.

    Raises:
        ConfigError: a bound without effect.
    """
    own = energy.get("own") or ()
    signals = [signal for signal in energy.get("bounds") or () if f"energy.bounds.{signal}" in given]
    for name, feature in OWN_FEATURES.items():
        if feature.bounded and feature.signal in signals and name not in own:
            raise ConfigError(
                f"energy.bounds.{feature.signal} is read by the feature {name}, which energy.own ({', '.join(own)}) does "
                "not have: add it, or leave the bound out"
            )


def build(settings: Settings, overrides: Sequence[str] = ()) -> tuple[Any, Forecaster]:
    """The data module and the forecaster of a run. Initial weights are drawn from the global random state; no data is read.

    Args:
        settings: the settings of the run.
        overrides: the user's overrides.

    Raises:
        ConfigError: a part, key or value that cannot work, or sizes that do not fit together, in one sentence.
    """
    if settings.logger.mlflow is not None:
        mlflow.check_settings(settings.logger.mlflow)
    data = build_data(settings.data)
    refuse_missing_folder(data, keys_of(overrides))
    if bounds := {key for key in keys_of(overrides) if key.startswith("energy.bounds.")}:
        refuse_unread_bounds(settings.energy, bounds)
    # The order of the batches belongs to the run; data.seed draws the scenes and splits.
    data.order_seed = settings.seed
    check_divisible(getattr(data, "batch_size", settings.trainer.devices), settings.trainer.devices)
    forecaster = build_model(settings, data)
    check_goal(settings, forecaster)
    check_monitor(settings.callbacks.monitor, data.task)
    step_graph.check(settings, forecaster)
    return data, forecaster


def check_goal(settings: Settings, forecaster: Forecaster) -> None:
    """Refuse ``goal=all`` for a forecaster without a backbone of its own, whose forecasts it would not change.

    Raises:
        ConfigError: no network could read the goals.
    """
    if settings.goal == "all" and not hasattr(forecaster, "backbone"):
        raise ConfigError(
            "goal is 'all', which makes the given goal an input of the network, but forecaster "
            f"{settings.forecaster['name']} has no network of its own: use goal=energy"
        )


def check_monitor(monitor: str, task: Task) -> None:
    """Refuse to monitor a score that no forecaster logs.

    A known score that this particular forecaster does not log is refused later, after the first validation
    (:mod:`.callbacks`).

    Raises:
        ConfigError: an unknown name, with the nearest known one.
    """
    names = [name for name in scores() if name not in (*EQUILIBRIUM_METRICS, *PAIR_METRICS)]  # these are of tests only
    known = [f"val/{prefix}{name}" for prefix in ("", *(f"{subset}/" for subset in task.subsets)) for name in names]
    if monitor not in known and not monitor.startswith("train/"):
        raise ConfigError(f"unknown callbacks.monitor {monitor!r}: {nearest(monitor, known)}")


def build_model(settings: Settings, data: Any) -> Forecaster:
    """The forecaster of a configuration for the task of ``data``, see :func:`build`."""
    configuration = describe_model(settings, data)
    for group in PARTS[1:]:  # all but "data", which was checked when it was built
        check_part(group, configuration[group], SUPPLIED[group])
    try:
        forecaster = build_forecaster(configuration)
        if isinstance(backbone := getattr(forecaster, "backbone", None), Backbone):
            try_backbone(backbone, data.task)
    except ConfigError:
        raise
    except (TypeError, ValueError, RuntimeError, ArithmeticError) as error:
        raise ConfigError(f"the forecaster cannot be built{_suspects(configuration)}: {one_line(error)}") from error
    # Lightning converts the model as well, but only after it has loaded a checkpoint into the model.
    return forecaster.double() if settings.trainer.precision == "64-true" else forecaster


def parameters(model: torch.nn.Module) -> int:
    """Number of learned parameters."""
    return sum(parameter.numel() for parameter in model.parameters() if parameter.requires_grad)


def check_buildable(settings: Settings, overrides: Sequence[str] = ()) -> tuple[Any, Forecaster]:
    """Check that data module and forecaster can be built, without an effect on random states and without warnings.

    Raises:
        ConfigError: as :func:`build`.
    """
    with torch.random.fork_rng(devices=[]), warnings.catch_warnings(action="ignore"):
        return build(settings, overrides)


def _suspects(model: Mapping[str, Any]) -> str:
    """Whole numbers below 1 in the model's configuration: a likely cause of an error whose message names no setting."""
    sections = ((group, model[group]) for group in PARTS[1:])
    small = [
        f"{group}.{key}={value}"
        for group, section in sections
        for key, value in section.items()
        if isinstance(value, int) and not isinstance(value, bool) and value < 1
    ]
    return f" with {', '.join(small)}" if small else ""


def quiet() -> None:
    """Silence hints and warnings of Lightning about defaults that this project chooses on purpose."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    for text in (
        ".*does not have many workers.*",
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*Experiment logs directory .* exists and is not empty.*",
        ".*LeafSpec.*",
        ".*configure_optimizers.*returned .None.*",
        ".*Found .* module.s. in eval mode.*",
        ".*The `srun` command is available.*",
        ".*number of training batches .* is smaller than the logging interval.*",
        ".*It is recommended to use .self.log.*sync_dist=True.*",  # the metrics are sums over all processes already
    ):
        warnings.filterwarnings("ignore", message=text)


class Double(DoublePrecision):
    """Lightning's double precision, extended to scenes: its own conversion refuses frozen data classes."""

    def convert_input(self, data: Any) -> Any:
        return data.to(torch.double)


def build_trainer(
    settings: TrainerSettings,
    run: RunFolder,
    callbacks: Sequence[Callback],
    loggers: Sequence[Logger] = (),
    devices: int | list[int] = 1,
    strategy: Strategy | None = None,
) -> Trainer:
    """Lightning's trainer for one run.

    Args:
        settings: the section ``trainer``.
        run: the run folder, Lightning's default folder for files.
        callbacks: callbacks of the run, including a progress bar if one is wanted; debugging callbacks are added here.
        loggers: loggers of the run.
        devices: number or indices of devices, as :func:`.gpus.placed` yields them.
        strategy: strategy for several devices; None for one device.

    Raises:
        ConfigError: a device or precision that this machine does not have.
    """
    torch.set_num_threads(settings.threads)
    # With deterministic algorithms, PyTorch would fill every new tensor with NaN before it is written, 5 % of a step's time.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    double = settings.precision == "64-true"
    between = settings.validate_steps
    if between is not None and settings.max_steps > 0:  # a shorter training is validated at its end
        between = min(between, settings.max_steps)
    with naming(settings, run):
        return Trainer(
            default_root_dir=run.path,
            accelerator=gpus.accelerator(settings),
            devices=devices,
            strategy=strategy or "auto",
            # In a Slurm job, Lightning would otherwise install its signal handlers and compare the number of tasks.
            plugins=[
                WholeCheckpoints(),
                *([LightningEnvironment()] if strategy is None else []),
                *([Double()] if double else []),
            ],
            precision=None if double else settings.precision,  # type: ignore[arg-type]
            max_epochs=-1 if settings.max_epochs is None else settings.max_epochs,
            max_steps=settings.max_steps,
            check_val_every_n_epoch=settings.validate_every if settings.validate_steps is None else None,
            val_check_interval=between,
            limit_train_batches=settings.limit_train_batches,
            limit_val_batches=settings.limit_val_batches,
            log_every_n_steps=0,  # no step is logged by itself, but means of epochs (forecasters/step_means.py)
            deterministic=settings.deterministic,
            callbacks=[*callbacks, *debugging.debug_callbacks(settings, run)],
            logger=list(loggers),
            enable_progress_bar=any(isinstance(callback, TQDMProgressBar) for callback in callbacks),
            enable_model_summary=False,
            # One batch is validated before the first step, so that a metric that fails is found at once.
            num_sanity_val_steps=1,
            inference_mode=False,  # the layer differentiates its energy also when it only forecasts
        )


@contextmanager
def naming(settings: TrainerSettings, run: RunFolder) -> Iterator[None]:
    """Context that names the settings in errors of Lightning's Trainer, whose own messages do not.

    Raises:
        ConfigError: a device or precision that this machine does not have.
    """
    try:
        yield
    except ConfigError:
        raise
    except (MisconfigurationException, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"this machine has no device for trainer.accelerator={settings.accelerator}, trainer.precision="
            f"{settings.precision} ({one_line(error)}): trainer.accelerator=cpu works everywhere "
            f"(for a run that has begun, change it in {run.config_file})"
        ) from error


@contextmanager
def signals() -> Iterator[None]:
    """Context in which an interrupted training ends with an error: Ctrl-C as KeyboardInterrupt, SIGTERM as exit status 143.

    Without it, Lightning's Trainer ends silently after Ctrl-C, and ends with the exit status of success after SIGTERM.
    Lightning notices a SIGTERM only between two batches; this context also notices one before the first batch and one during
    the last batch.
    """
    main = threading.current_thread() is threading.main_thread()
    told = False

    def end(*_: object) -> None:
        nonlocal told
        told = True
        # During a fit, Lightning's handler is installed; it calls this one, and Lightning then ends the training itself.
        if signal.getsignal(signal.SIGTERM) is end:
            raise SIGTERMException(128 + signal.SIGTERM)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)} if main else {}
    try:
        if main:
            signal.signal(signal.SIGTERM, end)
        yield
    except SIGTERMException:
        told = True
    except SystemExit:
        raise KeyboardInterrupt from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
    if told:
        raise SystemExit(128 + signal.SIGTERM)
