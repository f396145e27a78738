"""Sections of a configuration as typed data classes, checked before anything is loaded or written.

Sections that choose a registered part (data, backbone, ...) are checked against the signature of the part's constructor.
Objects are never built from ``_target_`` or another path to code.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from epo_lightning.registry import ConfigError

Measured = Literal["test", "val", "time"]
"""Measurements of a run: its scores on a split, or the time of a forecast."""
PARTS = ("data", "backbone", "forecaster", "dynamics", "energy", "solver", "backward", "objective", "optimizer")
MOST_PROCESSES = 1024
"""Largest number of threads, devices or workers. A larger number is a typing error, and would crash the process without a
clear message."""
PRECISIONS = ("32-true", "64-true")
"""Precisions that the solvers support, by Lightning's names."""


@dataclass(frozen=True)
class TrainerSettings:
    """Length of a training and its hardware (``conf/trainer``)."""

    max_epochs: int | None = 100
    max_steps: int = -1
    accelerator: Literal["cpu", "gpu", "auto"] = "cpu"
    devices: int = 1
    share: int = 1
    precision: str = "32-true"
    threads: int = 1
    validate_every: int = 1
    validate_steps: int | None = None
    limit_train_batches: int | float = 1.0
    limit_val_batches: int | float = 1.0
    deterministic: bool = True
    overfit_batches: int = 0
    detect_anomaly: bool = False
    profiler: bool = False
    graph: bool = False

    def __post_init__(self) -> None:
        if (self.max_epochs is None or self.max_epochs < 0) and self.max_steps < 0:
            raise ConfigError("trainer.max_epochs and trainer.max_steps are both open: the run would never end")
        if self.precision not in PRECISIONS:
            raise ConfigError(
                f"trainer.precision must be one of {', '.join(PRECISIONS)}, not {self.precision!r}: solvers factorise "
                "matrices, for which 16 bits have too few digits"
            )
        if self.max_steps < -1:
            raise ConfigError(f"trainer.max_steps must be 0 or more, or -1 for no limit, not {self.max_steps}")
        for name in ("share", "validate_every"):
            if getattr(self, name) < 1:
                raise ConfigError(f"trainer.{name} must be 1 or more, not {getattr(self, name)}")
        for name in ("threads", "devices"):
            if not 1 <= getattr(self, name) <= MOST_PROCESSES:
                raise ConfigError(f"trainer.{name} must be between 1 and {MOST_PROCESSES}, not {getattr(self, name)}")
        if self.validate_steps is not None and self.validate_steps < 1:
            raise ConfigError(f"trainer.validate_steps must be 1 or more, or null, not {self.validate_steps}")
        if self.overfit_batches < 0 or (self.overfit_batches and self.devices > 1):
            raise ConfigError(
                f"trainer.overfit_batches={self.overfit_batches} on {self.devices} device(s): it takes 0 for all batches, "
                "or 1 or more of them on one device"
            )
        for name in ("limit_train_batches", "limit_val_batches"):
            value = getattr(self, name)
            if value <= 0 or (isinstance(value, float) and value > 1):
                raise ConfigError(f"trainer.{name} must be a share in (0, 1] or a number of batches, not {value}")
        if self.graph:
            self._check_graph()

    def _check_graph(self) -> None:
        if self.accelerator == "cpu":
            raise ConfigError(
                "trainer.graph=true on trainer.accelerator=cpu: CUDA graphs need trainer.accelerator=gpu or auto"
            )
        if self.devices > 1:
            raise ConfigError(f"trainer.graph=true needs trainer.devices=1, not {self.devices}")
        if self.detect_anomaly:
            raise ConfigError(
                "trainer.graph=true and trainer.detect_anomaly=true exclude each other: looking at numbers makes the host "
                "wait, which a CUDA graph cannot contain"
            )


@dataclass(frozen=True)
class CallbackSettings:
    """Checkpoints, early stopping and progress of a training (``conf/callbacks``)."""

    monitor: str = "val/minSADE"
    patience: int | None = 10
    min_delta: float = 0.0
    progress: Literal["auto", "bar", "lines", "none"] = "auto"
    refresh: int = 50

    def __post_init__(self) -> None:
        if self.patience is not None and self.patience < 1:
            raise ConfigError(f"callbacks.patience must be 1 or more, or null for never, not {self.patience}")
        if not 0 <= self.min_delta < math.inf:
            raise ConfigError(f"callbacks.min_delta must be finite and 0 or more, not {self.min_delta}")
        if self.refresh < 1:
            raise ConfigError(f"callbacks.refresh must be 1 or more, not {self.refresh}")


@dataclass(frozen=True)
class CSVSettings:
    """Settings of the CSV log (``conf/logger/csv.yaml``)."""

    flush: int = 1

    def __post_init__(self) -> None:
        if self.flush < 1:
            raise ConfigError(f"logger.csv.flush must be 1 or more, not {self.flush}")


@dataclass(frozen=True)
class DashboardSettings:
    """Settings that all dashboards have."""

    pictures: int = 0
    patience: float = 10.0

    def __post_init__(self) -> None:
        if self.pictures < 0 or not 0 <= self.patience < math.inf:
            raise ConfigError(
                "pictures and patience of a logger must be 0 or more, and finite, "
                f"not pictures={self.pictures}, patience={self.patience:g}"
            )


@dataclass(frozen=True)
class TensorBoardSettings(DashboardSettings):
    """Settings of TensorBoard (``conf/logger/tensorboard.yaml``)."""

    hyperparameters: bool = True


@dataclass(frozen=True)
class WandbSettings(DashboardSettings):
    """Settings of Weights & Biases (``conf/logger/wandb.yaml``)."""

    project: str = "epo_lightning"
    mode: Literal["auto", "offline", "online"] = "auto"
    entity: str | None = None
    tags: Sequence[str] = ()
    artifacts: bool = False


@dataclass(frozen=True)
class MLflowSettings(DashboardSettings):
    """Settings of MLflow (``conf/logger/mlflow.yaml``)."""

    uri: str | None = None
    experiment: str = "epo_lightning"
    artifacts: bool = False


@dataclass(frozen=True)
class LoggerSettings:
    """The CSV log and the chosen dashboards (``conf/logger``); None for a dashboard that is not chosen."""

    csv: CSVSettings = field(default_factory=CSVSettings)
    tensorboard: TensorBoardSettings | None = None
    wandb: WandbSettings | None = None
    mlflow: MLflowSettings | None = None


@dataclass(frozen=True)
class BudgetSettings:
    """Name of the chosen budget (``conf/budget``); its settings are values of the other sections."""

    name: str = "paper"


@dataclass(frozen=True)
class Settings:
    """Configuration of one training run (``conf/train.yaml``)."""

    data: Mapping[str, Any]
    backbone: Mapping[str, Any]
    forecaster: Mapping[str, Any]
    dynamics: Mapping[str, Any]
    energy: Mapping[str, Any]
    solver: Mapping[str, Any]
    backward: Mapping[str, Any]
    objective: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    trainer: TrainerSettings
    callbacks: CallbackSettings
    logger: LoggerSettings
    budget: BudgetSettings
    # Name of the chosen file of conf/task, recorded in config.yaml. (Sizes of scenes are those of the data's `Task`.)
    task: str = ""
    title: str = "untitled"
    goal: Literal["energy", "all"] = "energy"
    seed: int = 0
    runs: str = "runs"
    run_dir: str | None = None
    existing: Literal["error", "continue"] = "error"
    resume: str | None = None
    score: Measured | Sequence[Measured] | None = None  # see `measures`
    sweep: str | None = None
    experiment: str | None = None  # this and `variant` are added by `compose.resolve`
    variant: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed must be between 0 and {2**32 - 1}, not {self.seed}")

    @property
    def measures(self) -> tuple[Measured, ...]:
        """Measurements that ``score`` asks for."""
        return measures(self.score)


def measures(score: str | Sequence[str] | None) -> tuple[Measured, ...]:
    """Measurements that ``score`` asks for, without repetition and in a fixed order; empty for None."""
    asked = (score,) if isinstance(score, str) else score or ()
    return tuple(which for which in typing.get_args(Measured) if which in asked)


def check_workers(workers: int | None) -> None:
    """Refuse a number of processes that cannot be meant.

    Raises:
        ConfigError: not between 1 and ``MOST_PROCESSES``.
    """
    if workers is not None and not 1 <= workers <= MOST_PROCESSES:
        raise ConfigError(f"workers must be between 1 and {MOST_PROCESSES}, or null for one per core, not {workers}")


@dataclass(frozen=True)
class GenerateSettings:
    """Configuration of ``epo generate``."""

    data: Mapping[str, Any]
    workers: int | None = None
    progress: bool = True
    strict: bool = False
    jobs: int | None = None

    def __post_init__(self) -> None:
        check_workers(self.workers)
        if self.jobs is not None and self.jobs < 1:
            raise ConfigError(f"jobs is {self.jobs}, expected the number of jobs of the launcher, 1 or more")


Split = Literal["test", "val", "train", "all"]
"""Names of splits; ``all`` is that of all recordings, for data on which a run was not trained."""


@dataclass(frozen=True, kw_only=True)
class ScenesSettings:
    """The scenes on which a trained run is used, and its checkpoint: the common part of the verbs for trained runs."""

    data: Mapping[str, Any] | None = None
    split: Split | None = None
    checkpoint: str = "best"
    workers: int | None = None

    @property
    def own_split(self) -> str:
        """The split of the run's own data."""
        return self.split or "test"

    def __post_init__(self) -> None:
        if self.data is None and self.split not in (None, "test", "val"):
            raise ConfigError(
                f"split={self.split} needs data=<data set>: on its own data, a run is scored on split=test or split=val"
            )
        check_workers(self.workers)


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(ScenesSettings):
    """Configuration of ``epo evaluate``."""

    run: str | None = None
    runs: str | None = None
    batch_size: int = 256

    def __post_init__(self) -> None:
        if (self.run is None) == (self.runs is None):
            raise ConfigError("choose what to evaluate: run=<run folder>, or runs=<folder> for all runs below it")
        super().__post_init__()
        if self.batch_size < 2:
            raise ConfigError(f"batch_size must be 2 or more, not {self.batch_size}")


@dataclass(frozen=True, kw_only=True)
class ForecastSettings(ScenesSettings):
    """A run and the scenes that it forecasts: the common part of ``epo predict``, ``epo explore`` and ``epo export``."""

    run: str
    scenes: int | None = 64

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scenes is not None and self.scenes < 1:
            raise ConfigError(f"scenes must be 1 or more, or null for all, not {self.scenes}")


@dataclass(frozen=True, kw_only=True)
class PredictSettings(ForecastSettings):
    """Configuration of ``epo predict``."""

    out: str = "predictions"
    figures: int = 4
    animate: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("figures", "animate"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class ExploreSettings(ForecastSettings):
    """Configuration of ``epo explore``."""

    port: int = 8765

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.port < 65536:
            raise ConfigError(f"port must be a number from 0 to 65535, not {self.port}; 0 takes any free port")


@dataclass(frozen=True, kw_only=True)
class ExportSettings(ForecastSettings):
    """Configuration of ``epo export``."""

    format: Literal["pt2", "aoti", "onnx"] = "pt2"
    out: str | None = None
    scenes: int | None = 4


Way = Literal["own", "warm", "alone", "respond"]
"""How a run plans (``drive/planners.py``)."""


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """Configuration of ``epo drive``."""

    run: str | Sequence[str]
    world: str = "rpi"
    others: str | Sequence[str] | None = None
    ways: Way | Sequence[Way] = ("own", "warm", "alone", "respond")
    baselines: str | Sequence[str] | None = None
    mode: Literal["likely", "nearest"] = "likely"
    episodes: int = 500
    seed: int = 0
    timed: int = 5
    film: int | None = 0
    checkpoint: str = "best"
    out: str | None = None

    def __post_init__(self) -> None:
        for name in ("run", "others", "ways", "baselines"):
            if isinstance(value := getattr(self, name), str):
                object.__setattr__(self, name, [value])  # a list of one
        if self.episodes < 1:
            raise ConfigError(f"episodes must be 1 or more, not {self.episodes}")
        for name in ("seed", "timed"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")
        if self.film is not None and not 0 <= self.film < self.episodes:
            raise ConfigError(f"film must be an episode from 0 to {self.episodes - 1}, or null, not {self.film}")
        if not self.run or not (self.ways or self.baselines or self.baselines is None):
            raise ConfigError("nothing drives: name a run and one of ways, or one of baselines")
        if self.others is not None and not self.others:
            raise ConfigError("nothing drives: name one of others, or leave others out for all of them")


@dataclass(frozen=True)
class ReportSettings:
    """Configuration of ``epo report``."""

    runs: str = "runs"
    sweep: str | None = None
    results: str | None = None
    out: str | None = None
    save: str | None = None
    template: str | None = None
    scenes: bool = True
