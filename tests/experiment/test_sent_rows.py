"""What MLflow and W&B are sent, by clients that only remember it: every value once, and how the run ended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from experiment.dashboard_runs import facts

from epo_lightning.experiment.config.settings import MLflowSettings, WandbSettings
from epo_lightning.experiment.dashboards.base import ARTIFACTS, Ending, Facts
from epo_lightning.experiment.dashboards.mlflow import MLflow
from epo_lightning.experiment.dashboards.wandb import STEP, WandB


class Client:
    """An MLflow client that keeps what it gets, and refuses more than a server takes in one call."""

    def __init__(self) -> None:
        self.points: list[tuple[str, int, float]] = []
        self.parameters: dict[str, str] = {}
        self.files: list[str] = []
        self.ended: tuple[str, int | None] | None = None

    def log_batch(self, run: str, metrics: Sequence[Any] = (), params: Sequence[Any] = ()) -> None:
        assert len(metrics) <= 1000
        assert len(params) <= 100
        self.points += [(point.key, point.step, point.value) for point in metrics]
        self.parameters |= {param.key: param.value for param in params}

    def log_artifact(self, run: str, path: str, *_: object) -> None:
        self.files.append(path)

    def set_terminated(self, run: str, status: str, end_time: int | None) -> None:
        self.ended = (status, end_time)


def mlflow_of(given: Facts, artifacts: bool = False) -> tuple[MLflow, Client]:
    """A dashboard that has been opened, with a client that remembers."""
    pytest.importorskip("mlflow")
    board, client = MLflow(given, MLflowSettings(artifacts=artifacts), given.folder), Client()
    board._client, board._run = client, "run"  # type: ignore[assignment]
    return board, client


def test_mlflow_gets_every_value_of_a_long_log_once(tmp_path: Path) -> None:
    board, client = mlflow_of(facts(tmp_path))
    rows = [(step, {"a": float(step), "b:c": -float(step)}) for step in range(1300)]
    board.log(rows[:1200])
    board._known = {"a": (1199, 1199.0), "b_c": (1199, -1199.0)}  # as a continued run finds them
    board.log(rows[1100:])
    for name, sign in (("a", 1), ("b_c", -1)):
        assert [point for point in client.points if point[0] == name] == [(name, s, sign * s) for s in range(1300)]


def test_mlflow_gets_every_parameter_of_a_large_configuration(tmp_path: Path) -> None:
    values = {f"key{number}": number for number in range(250)}
    board, client = mlflow_of(Facts("id", "name", None, values, {}, tmp_path))
    board._parameters()
    assert client.parameters == {key: str(value) for key, value in values.items()}


def test_mlflow_gets_scores_that_have_changed_at_the_last_step(tmp_path: Path) -> None:
    board, client = mlflow_of(facts(tmp_path))
    board._ended = 1234
    board._known = {"test/b": (7, 3.0)}
    board.log([(0, {"a": 1.0}), (7, {"a": 2.0})])
    assert board._ended is None, "rows were added since the run had ended"
    board._ended = 5678
    board.close(Ending(summary={"best/a": 1.0, "test/a": math.nan, "test/b": 3.0}))
    assert client.points[2:] == [("best/a", 7, 1.0)]
    assert client.ended == ("FINISHED", 5678), "a later evaluation does not move the end of a run"


@pytest.mark.parametrize("failed", [False, True])
def test_mlflow_is_told_how_a_run_ended_and_keeps_files_of_finished_ones(failed: bool, tmp_path: Path) -> None:
    board, client = mlflow_of(facts(tmp_path), artifacts=True)
    board.close(Ending(failed))
    assert client.ended == ("FAILED" if failed else "FINISHED", None)
    assert client.files == ([] if failed else [str(tmp_path / name) for name in ARTIFACTS])


@pytest.mark.parametrize("failed", [False, True])
def test_wandb_gets_the_rows_that_it_lacks_and_how_the_run_ended(
    failed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Any] = []
    board = WandB(facts(tmp_path), WandbSettings(artifacts=True))
    board._told = 3  # of a continued run, rows up to this step are there
    summary: dict[str, float] = {}
    board._run = SimpleNamespace(log=sent.append, finish=lambda exit_code: sent.append(exit_code), summary=summary)
    monkeypatch.setattr(board, "_artifact", lambda: sent.append("files"))
    board.log([(step, {"a": float(step)}) for step in range(3)])
    board.log([(step, {"a": float(step)}) for step in range(3, 6)])
    board.close(Ending(failed, summary={"best/a": 0.0}))
    rows = [{"a": float(step), STEP: step} for step in (4, 5)]
    assert sent == [*rows, *([] if failed else ["files"]), int(failed)]
    assert summary == {"best/a": 0.0}
