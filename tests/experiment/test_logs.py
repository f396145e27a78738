"""Logs: dashboards get the values of the CSV file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from experiment import tiny
from experiment.conftest import TINY, Epo
from experiment.dashboard_runs import ROW, events, facts, hyperparameters, in_file, no_account, stopped  # noqa: F401 - fixtures

from epo_lightning.experiment import logs
from epo_lightning.experiment.config.settings import MLflowSettings, Settings
from epo_lightning.experiment.dashboards.base import Facts
from epo_lightning.experiment.dashboards.mlflow import MLflow
from epo_lightning.experiment.dashboards.wandb import has_key
from epo_lightning.run_folder import RunFolder, discover
from epo_lightning.schema import read

STEP = "trainer/global_step"
WANDB = ("logger=[wandb]", "logger.wandb.patience=120")
MLFLOW = ("logger=[mlflow]", "logger.mlflow.patience=120")
"""Dashboards that a busy machine does not switch off."""


def test_empty_sections_are_parameters_of_a_run_like_others() -> None:
    """Without it, a dashboard would not tell a row without margins from one of a version that knows none."""
    config = {"seed": 0, "energy": {"name": "features", "margins": {}, "bounds": {"vel": [0.0, 2.0]}}}
    facts = Facts(id="a", name="a", group=None, config=config, tags={}, folder=Path("run"))
    assert facts.parameters() == {
        "seed": 0,
        "energy.name": "features",
        "energy.margins": {},
        "energy.bounds.vel": [0.0, 2.0],
    }


def best_in_file(run: str) -> float:
    return min(value for _, value in in_file(run, "val/minSADE"))


def wandb_folders(run: str) -> list[dict[str, Any]]:
    """Contents of the offline W&B folders of a run by W&B's own reader, oldest first."""
    files = sorted(Path(run).glob("logs/wandb/offline-run-*/*.wandb"))
    words = [sys.executable, "-m", "wandb", "leet", "inspect", "--summary", "--json"]
    found = [subprocess.run([*words, file], capture_output=True, text=True, check=True).stdout for file in files]
    return [json.loads(text) for text in found]


def wandb_history(run: str) -> list[tuple[int, float]]:
    """Step and validation score of every row in the offline folders, in the order in which `wandb sync` sends them."""
    points = []
    for file in sorted(Path(run).glob("logs/wandb/offline-run-*/*.wandb")):
        words = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", file]
        for line in subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines():
            record = json.loads(line)
            if record["type"] != "history":
                continue
            row = record["history"]["item"]
            if "val/minSADE" in row:
                points.append((int(row[STEP]), float(row["val/minSADE"])))
    return points


# CSV


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_rows_are_written_at_once_and_a_full_disk_is_an_error(epo: Epo) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run") == 0
    run = RunFolder.open("run")
    settings = read(Settings, run.config())
    with pytest.raises(OSError, match="No space left"), logs.open_logs(settings, run.config(), run) as (file,):
        file.log_metrics({"a": 1.0}, 0)
        assert "1.0" in (run.logs / "metrics.csv").read_text()
        (run.logs / "metrics.csv").unlink()
        (run.logs / "metrics.csv").symlink_to("/dev/full")
        file.log_metrics({"a": 2.0}, 1)


def test_a_task_of_slurm_that_trains_a_run_of_its_own_logs(tmp_path: Path) -> None:
    """As by `srun -n 4 bash -c 'epo train seed=$SLURM_PROCID'`: Lightning reads the variable when it is imported."""
    words = ("train", "experiment=rpi/v_lstm", "data=drawn", "budget=smoke", "run_dir=run")
    environment = {**os.environ, "SLURM_PROCID": "1"}
    task = subprocess.run(
        [sys.executable, "-m", "epo_lightning.cli", *words], env=environment, cwd=tmp_path, check=False
    )
    assert task.returncode == 0
    assert "val/minSADE" in (tmp_path / "run/logs/metrics.csv").read_text()


# TensorBoard


@pytest.mark.parametrize("logger", ["logger=[tensorboard]", "logger=[csv,tensorboard]"])
def test_tensorboard_shows_the_values_of_the_csv_file(epo: Epo, logger: str) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run", logger) == 0
    for name in ("val/minSADE", "train/loss"):
        points = [(event.step, event.value) for event in events("run").Scalars(name)]
        assert points == [(step, pytest.approx(value)) for step, value in in_file("run", name)]
    (best,) = events("run").Scalars("best/minSADE")
    assert best.value == pytest.approx(best_in_file("run"))
    shown = hyperparameters("run")
    assert shown["optimizer.lr"].number_value == 1e-3
    assert shown["forecaster.name"].string_value == "scene_consistent"


def test_tensorboard_has_no_point_twice_after_a_stop(epo: Epo, stopped: Callable[..., None]) -> None:  # noqa: F811
    stopped("run_dir=run", "logger=[tensorboard]")
    Path("run/logs/events.out.tfevents.0.lost").write_bytes(b"")  # from a process before that
    assert epo("train", "resume=run") == 0
    points = [(event.step, event.value) for event in events("run").Scalars("val/minSADE")]
    assert points == [(step, pytest.approx(value)) for step, value in in_file("run", "val/minSADE")]
    assert len(points) == 4
    assert len(list(Path("run/logs").glob("events.*"))) == 1


def test_scores_on_the_test_split_reach_the_dashboard(epo: Epo) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run", "logger=[tensorboard]") == 0
    assert epo("evaluate", "run=run") == 0
    measured = json.loads(Path("run/metrics.json").read_text())["metrics"]["minSADE"]
    assert events("run").Scalars("test/minSADE")[0].value == pytest.approx(measured)
    assert len(events("run").Scalars("val/minSADE")) == 2


# W&B


@pytest.mark.slow
def test_every_run_of_a_sweep_has_its_own_id_name_configuration_and_summary_in_wandb(epo: Epo) -> None:
    assert epo("train", "-m", ROW, *TINY, *WANDB, "seed=0,1") == 0
    runs = [str(run.path) for run in discover("runs")]
    folders = [wandb_folders(run) for run in runs]
    assert [len(found) for found in folders] == [1, 1]
    shown = [found[0] for found in folders]
    assert len({run["run_id"] for run in shown}) == 2
    assert [run["run_id"].split("-")[0] for run in shown] == [RunFolder(Path(run)).record["identity"] for run in runs]
    assert [run["name"] for run in shown] == [f"V-LSTM + SC (seed {seed})" for seed in range(2)]
    assert [run["config"]["seed"] for run in shown] == [0, 1]
    assert {run["config"]["data_digest"] for run in shown} == {"tiny-64-0"}
    for run, found in zip(runs, shown, strict=True):
        assert found["summary"]["best/minSADE"] == pytest.approx(best_in_file(run))
        assert found["summary"][STEP] == 7
        assert found["exit_code"] == 0
    assert group_of(runs[0]) == ("rpi/v_lstm_sc", "train")


def group_of(run: str) -> tuple[str, str]:
    (file,) = Path(run).glob("logs/wandb/offline-run-*/*.wandb")
    words = [sys.executable, "-m", "wandb", "leet", "inspect", "--json", file]
    for line in subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines():
        record = json.loads(line)
        if record["type"] == "run":
            return record["run"]["run_group"], record["run"]["job_type"]
    raise AssertionError("no run in the file")


@pytest.mark.slow
def test_a_stopped_run_continues_in_the_same_wandb_run(epo: Epo, stopped: Callable[..., None]) -> None:  # noqa: F811
    stopped("run_dir=run", *WANDB)
    assert [folder["exit_code"] for folder in wandb_folders("run")] == [1]
    assert epo("train", "resume=run") == 0
    assert [folder["exit_code"] for folder in wandb_folders("run")] == [1, 0]
    assert len({folder["run_id"] for folder in wandb_folders("run")}) == 1
    assert wandb_history("run") == [(step, pytest.approx(value)) for step, value in in_file("run", "val/minSADE")]


def test_pictures_and_the_checkpoint_can_be_uploaded(epo: Epo) -> None:
    options = ("logger.wandb.pictures=2", "logger.wandb.artifacts=true")
    assert epo("train", ROW, *TINY, "run_dir=run", *WANDB, *options) == 0
    assert list(Path("run/logs/figures").glob("*.png"))
    (folder,) = wandb_folders("run")
    assert (
        folder["summary"]["forecasts/joint_predictions"]["_type"] == "images/separated"
        or folder["summary"]["forecasts/joint_predictions"]["format"] == "png"
    )
    (file,) = Path("run").glob("logs/wandb/offline-run-*/*.wandb")
    assert str(Path("run/checkpoints/best.ckpt").resolve()).encode() in file.read_bytes()


@pytest.mark.parametrize("server", ["https://wandb.local", "http://wandb.local:8080"])
def test_the_key_that_wandb_login_writes_is_found(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_BASE_URL", server)
    assert not has_key()
    (tmp_path / "netrc").write_text(f"machine {server.partition('//')[2]}\n  login user\n  password {40 * 'a'}\n")
    assert has_key()
    monkeypatch.setenv("WANDB_BASE_URL", "http://wandb.local:9090")
    assert not has_key()
    monkeypatch.setenv("WANDB_IDENTITY_TOKEN_FILE", str(tmp_path / "token"))
    assert has_key()


# MLflow


def client(database: str = "runs/mlflow.db") -> Any:
    from mlflow import MlflowClient

    return MlflowClient(f"sqlite:///{Path(database).resolve()}")


def test_mlflow_keeps_name_parameters_tags_and_scores_through_a_stop(epo: Epo, stopped: Callable[..., None]) -> None:  # noqa: F811
    pytest.importorskip("mlflow")
    stopped("run_dir=runs/one", *MLFLOW)
    there = client()
    experiment = there.get_experiment_by_name("epo_lightning")
    (run,) = there.search_runs([experiment.experiment_id])
    assert run.info.status == "FAILED"
    assert epo("train", "resume=runs/one") == 0
    assert epo("evaluate", "run=runs/one") == 0
    (run,) = there.search_runs([experiment.experiment_id])
    record = RunFolder(Path("runs/one")).record
    assert (run.info.run_name, run.info.status) == ("V-LSTM + SC (seed 0)", "FINISHED")
    assert run.data.params["optimizer.lr"] == "0.001"
    assert (run.data.tags["identity"], run.data.tags["data_digest"]) == (record["identity"], "tiny-64-0")
    assert run.data.tags["commit"] == str(record["git_commit"])
    points = [(point.step, point.value) for point in there.get_metric_history(run.info.run_id, "val/minSADE")]
    assert sorted(points) == [(step, pytest.approx(value)) for step, value in in_file("runs/one", "val/minSADE")]
    assert run.data.metrics["best/minSADE"] == pytest.approx(best_in_file("runs/one"))
    measured = json.loads(Path("runs/one/metrics.json").read_text())["metrics"]["minSADE"]
    assert run.data.metrics["test/minSADE"] == pytest.approx(measured)


def test_an_experiment_that_another_job_makes_at_the_same_moment_is_used(tmp_path: Path) -> None:
    exceptions = pytest.importorskip("mlflow.exceptions")
    made: list[SimpleNamespace] = []

    def create(name: str, *_: object) -> str:
        made.append(SimpleNamespace(experiment_id="7"))
        raise exceptions.MlflowException(f"Experiment(name={name}) already exists.")

    board = MLflow(facts(tmp_path), MLflowSettings(), tmp_path)
    there = SimpleNamespace(get_experiment_by_name=lambda name: made[-1] if made else None, create_experiment=create)
    board._client = cast(Any, there)
    assert board._experiment("rpi_main") == "7"
    assert board._experiment("rpi_main") == "7"
    assert len(made) == 1


def test_a_missing_mlflow_is_named_before_the_run(refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)
    assert "pip install 'epo_lightning[mlflow]'" in refused("train", ROW, *TINY, "logger=[mlflow]")


@pytest.mark.slow
def test_several_processes_share_one_database(tmp_path: Path) -> None:
    pytest.importorskip("mlflow")
    program = [sys.executable, str(Path(tiny.__file__).resolve())]
    words = ["train", ROW, *TINY, *MLFLOW]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    processes = [
        subprocess.Popen(
            [*program, *words, f"seed={seed}"], cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
        )
        for seed in range(4)
    ]
    complaints = [process.communicate(timeout=240)[1] for process in processes]
    assert [process.returncode for process in processes] == [0] * 4, "\n".join(complaints)
    assert not any("switched off" in text for text in complaints), "\n".join(complaints)
    there = client(str(tmp_path / "runs/mlflow.db"))
    runs = there.search_runs([there.get_experiment_by_name("epo_lightning").experiment_id])
    assert sorted(run.info.run_name for run in runs) == [f"V-LSTM + SC (seed {seed})" for seed in range(4)]
    assert all(run.data.metrics["best/minSADE"] > 0 and run.info.status == "FINISHED" for run in runs)


def test_the_summary_has_the_epoch_with_the_smallest_score_that_is_a_number(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.logs.mkdir()
    rows = ("3,nan,0.1", "7,0.5,0.2", "11,0.3,0.4", "15,,0.0", "19,0.6,0.3")
    (run.logs / "metrics.csv").write_text("\n".join(("step,val/minSADE,val/minADE", *rows, "")))
    assert logs.scores(run, "val/minSADE") == {"best/minSADE": 0.3, "best/minADE": 0.4}
