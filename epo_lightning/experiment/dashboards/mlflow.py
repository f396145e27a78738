"""MLflow dashboard: a local database, which ``mlflow server`` shows, or the server whose address is MLFLOW_TRACKING_URI."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from epo_lightning.experiment.config.settings import MLflowSettings
from epo_lightning.experiment.dashboards.base import ARTIFACTS, Dashboard, Ending, Facts, Row
from epo_lightning.masking import is_masked, mask
from epo_lightning.registry import ConfigError

SQLITE = "sqlite:///"
KIND = {"mlflow.experimentKind": "custom_model_development"}
"""Without it, MLflow's page guesses, and may show runs as it shows the traces of a language model."""


def check_settings(settings: MLflowSettings) -> None:
    """Check that MLflow is installed and its address complete.

    Raises:
        ConfigError: one of them is not the case.
    """
    if find_spec("mlflow") is None:
        raise ConfigError("logger=[mlflow] needs MLflow: pip install 'epo_lightning[mlflow]', or leave it out")
    tracking_uri(settings, default="")


def tracking_uri(settings: MLflowSettings, default: str) -> str:
    """The address of the server or database: ``logger.mlflow.uri``, else MLFLOW_TRACKING_URI, else ``default``.

    Raises:
        ConfigError: the address comes from a run folder, which keeps no secrets, and the environment does not complete it.
    """
    given = os.environ.get("MLFLOW_TRACKING_URI", "")
    if not settings.uri or not is_masked(settings.uri):
        return settings.uri or given or default
    if mask(given) != settings.uri:
        raise ConfigError(
            f"logger.mlflow.uri={settings.uri}: run folders keep no passwords; set MLFLOW_TRACKING_URI to the whole "
            "address, or give the command that began the run again, with its address and existing=continue"
        )
    return given


class MLflow(Dashboard):
    """MLflow dashboard of a run. A continued run is found by its tag ``run``; rows that it has are not written again."""

    label = "MLflow"
    every = 5.0

    def __init__(self, facts: Facts, settings: MLflowSettings, runs: Path) -> None:
        super().__init__(facts)
        self._settings = settings
        self._uri = f"{SQLITE}{runs.expanduser().resolve() / 'mlflow.db'}"
        self._known: dict[str, tuple[int, float]] = {}  # last step and value of each metric
        self._last = 0
        self._ended: int | None = None  # time at which an earlier process ended the run; None if rows were added since

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Context with a lock on an SQLite database: it allows one writer at a time, and MLflow does not lock its set-up."""
        if not self._uri.startswith(SQLITE):
            yield
            return
        from filelock import FileLock

        path = Path(self._uri.removeprefix(SQLITE))
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{path}.lock"):
            yield

    def open(self) -> None:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow import MlflowClient

        self._uri = tracking_uri(self._settings, default=self._uri)
        with self._alone():
            self._client = MlflowClient(self._uri)
            key = self._experiment(self.facts.group or self._settings.experiment)
            found = self._client.search_runs([key], f"tags.run = '{self.facts.id}'", max_results=1)
            if found:
                self._run = found[0].info.run_id
                self._ended = found[0].info.end_time
                self._client.update_run(self._run, status="RUNNING")
                self._known = {name: self._latest(name) for name in found[0].data.metrics}
            else:
                tags = {"run": self.facts.id, "folder": str(self.facts.folder), **self.facts.tags}
                self._run = self._client.create_run(key, tags=tags, run_name=self.facts.name).info.run_id
                self._parameters()

    def _experiment(self, name: str) -> str:
        """The experiment with this name, which is made if there is none. Another job may make it at the same moment."""
        from mlflow.exceptions import MlflowException

        if experiment := self._client.get_experiment_by_name(name):
            return str(experiment.experiment_id)
        place = self._artifacts() if self._uri.startswith(SQLITE) else None
        try:
            return str(self._client.create_experiment(name, place, KIND))
        except MlflowException:
            if (experiment := self._client.get_experiment_by_name(name)) is None:
                raise
            return str(experiment.experiment_id)

    def _artifacts(self) -> str:
        """Folder of the artifacts, beside the database; MLflow's default would be the current folder of the process."""
        return (Path(self._uri.removeprefix(SQLITE)).parent / "mlflow").as_uri()

    def _latest(self, name: str) -> tuple[int, float]:
        return max((point.step, point.value) for point in self._client.get_metric_history(self._run, name))

    def _parameters(self) -> None:
        from mlflow.entities import Param

        values = [Param(key, str(value)[:500]) for key, value in self.facts.parameters().items()]
        for first in range(0, len(values), 100):  # no more in one call
            self._client.log_batch(self._run, params=values[first : first + 100])

    def log(self, rows: Sequence[Row]) -> None:
        self._last = max([self._last, *(step for step, _ in rows)])
        self._write((step, name, value) for step, metrics in rows for name, value in metrics.items())

    def _write(self, points: Iterable[tuple[int, str, float]], final: bool = False) -> None:
        """Add points with a later step than the last known one of their metric; final points also if the value differs."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        fresh = []
        for step, name, value in points:
            name = re.sub(r"[^\w/. -]", "_", name)
            last, there = self._known.get(name, (-1, math.nan))
            if step > last or (final and value != there):
                fresh.append(Metric(name, value, now, step))
        if fresh:
            self._ended = self._ended if final else None
            with self._alone():
                for first in range(0, len(fresh), 1000):  # no more in one call
                    self._client.log_batch(self._run, metrics=fresh[first : first + 1000])

    def close(self, ending: Ending) -> None:
        summary = ((self._last, name, value) for name, value in ending.summary.items() if not math.isnan(value))
        self._write(summary, final=True)
        with self._alone():
            for path in ending.pictures[: self._settings.pictures]:
                self._client.log_artifact(self._run, str(path), "pictures")
            if self._settings.artifacts and not ending.failed:
                for name in ARTIFACTS:
                    self._client.log_artifact(self._run, str(self.facts.folder / name))
            self._client.set_terminated(self._run, "FAILED" if ending.failed else "FINISHED", self._ended)
