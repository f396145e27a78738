"""Options and logs of runs with dashboards, without an account."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from experiment.conftest import TINY, Epo
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from epo_lightning.experiment.callbacks import RandomStates
from epo_lightning.experiment.dashboards.base import Facts

ROW = "experiment=rpi/v_lstm_sc"


@pytest.fixture(autouse=True)
def no_account(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Environment without the user's keys, servers and databases."""
    for name in ("WANDB_API_KEY", "WANDB_BASE_URL", "WANDB_MODE", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))


@pytest.fixture
def stopped(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Train four epochs and fail at the beginning of the third."""

    def train(*words: str) -> None:
        starts: list[int] = []
        original = RandomStates.on_train_epoch_start

        def stop(self: RandomStates, trainer: Any, module: Any) -> None:
            starts.append(1)
            if len(starts) == 3:
                raise RuntimeError("power failure")
            original(self, trainer, module)

        with monkeypatch.context() as patch:
            patch.setattr(RandomStates, "on_train_epoch_start", stop)
            with pytest.raises(RuntimeError, match="power failure"):
                epo("train", ROW, *TINY, "trainer.max_epochs=4", *words)

    return train


def in_file(run: str, name: str) -> list[tuple[int, float]]:
    """Contents of metrics.csv."""
    with Path(run, "logs", "metrics.csv").open(newline="") as file:
        return [(int(row["step"]), float(row[name])) for row in csv.DictReader(file) if row[name]]


def events(run: str) -> EventAccumulator:
    found = EventAccumulator(str(Path(run, "logs")), size_guidance={"scalars": 0})
    return found.Reload()


def hyperparameters(run: str) -> Any:
    content = events(run).SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    return HParamsPluginData.FromString(content).session_start_info.hparams


def facts(folder: Path) -> Facts:
    return Facts("id", "name", None, {"a": {"b": 1, "c": [1, 2]}}, {}, folder)
