"""Dashboards that fail, are slow, or find a full disk: the run and its log go on as without them."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from experiment.conftest import TINY, Epo
from experiment.dashboard_runs import ROW, events, facts, hyperparameters, in_file, no_account, stopped  # noqa: F401 - fixtures

from epo_lightning.experiment import logs
from epo_lightning.experiment.config.settings import Settings, TensorBoardSettings
from epo_lightning.experiment.dashboards import aside
from epo_lightning.experiment.dashboards.aside import Aside
from epo_lightning.experiment.dashboards.base import Dashboard, Ending, Facts, Row
from epo_lightning.experiment.dashboards.tensorboard import TensorBoard
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import read


def test_dashboards_change_nothing_in_a_run(epo: Epo) -> None:
    assert epo("train", ROW, *TINY, "run_dir=alone") == 0
    assert epo("train", ROW, *TINY, "run_dir=watched", "logger=[csv,tensorboard,wandb,mlflow]") == 0
    one, other = (torch.load(f"{run}/checkpoints/last.ckpt", weights_only=True) for run in ("alone", "watched"))
    assert all(torch.equal(value, other["state_dict"][key]) for key, value in one["state_dict"].items())
    assert Path("alone/logs/metrics.csv").read_text() == Path("watched/logs/metrics.csv").read_text()


class Bad(Dashboard):
    """Fails or hangs at one of its methods."""

    label = "Bad"
    where, how = "", ""
    release = threading.Event()

    def __init__(self, facts: Facts, settings: object = None) -> None:
        super().__init__(facts)
        self.told: list[Row] = []
        self.ended: Ending | None = None

    def _here(self, where: str) -> None:
        if where != self.where:
            return
        if self.how == "hangs":
            self.release.wait()
        elif self.how == "exits":
            sys.exit(3)
        else:
            raise OSError(28, "No space left on device")

    def open(self) -> None:
        self._here("open")

    def log(self, rows: Sequence[Row]) -> None:
        self._here("log")
        self.told += rows

    def close(self, ending: Ending) -> None:
        self._here("close")
        self.ended = ending


@pytest.fixture
def bad(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Bad]]:
    """TensorBoard replaced by a dashboard that does not work."""
    monkeypatch.setattr(Bad, "release", threading.Event())
    monkeypatch.setattr(logs, "TensorBoard", Bad)
    yield Bad
    Bad.release.set()


@pytest.mark.parametrize("how", ["raises", "hangs", "exits"])
@pytest.mark.parametrize("where", ["open", "log", "close"])
def test_a_failing_dashboard_does_not_stop_the_run(
    epo: Epo, bad: type[Bad], where: str, how: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bad, "where", where)
    monkeypatch.setattr(bad, "how", how)
    words = ("logger=[tensorboard]", "logger.tensorboard.patience=0.5")
    assert epo("train", ROW, *TINY, "run_dir=run", *words) == 0
    assert RunFolder(Path("run")).finished
    assert len(in_file("run", "val/minSADE")) == 2
    warnings = [line for line in capsys.readouterr().err.splitlines() if line.startswith("Bad")]
    assert len(warnings) == 1
    assert "switched off for this run" in warnings[0]
    assert {"raises": "No space left", "hangs": "did not answer for 0.5 s", "exits": "SystemExit"}[how] in warnings[0]
    assert "epo evaluate run=run" in warnings[0]


def test_the_runs_of_a_sweep_are_a_group(epo: Epo, bad: type[Bad]) -> None:
    assert epo("train", ROW, *TINY, "run_dir=run", "logger=[tensorboard]") == 0
    run = RunFolder.open("run")
    config = run.config() | {"sweep": "runs/sweeps/ours"}
    run.begin(config, run.record)
    for sweep in ("ours", "another that continues it"):
        now = config | {"sweep": f"runs/sweeps/{sweep}"}
        with logs.open_logs(read(Settings, now), now, run) as (_, logger):
            told = logger.dashboard.facts
        assert (told.group, told.name) == ("ours", "V-LSTM + SC (seed 0)")
    began = "".join(filter(str.isdigit, run.record["began"]))
    assert told.id == f"{run.record['identity']}-{began}", "a run that begins anew would continue an old curve"
    assert told.parameters()["optimizer.lr"] == 1e-3


def test_a_dashboard_that_cannot_keep_up_is_dropped(
    bad: type[Bad], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bad, "where", "open")
    monkeypatch.setattr(bad, "how", "hangs")
    monkeypatch.setattr(aside, "BEHIND", 50)
    logger = Aside(Bad(facts(tmp_path)), patience=60.0)
    began = time.monotonic()
    for step in range(1000):
        logger.log_metrics({"a": 1.0}, step)
    logger.close(Ending())
    assert time.monotonic() - began < 5
    said = capsys.readouterr().err
    assert said.count("50 rows behind") == said.count("switched off for this run") == 1


def test_a_slow_dashboard_gets_every_row_in_order_and_costs_the_run_nothing(tmp_path: Path) -> None:
    class Slow(Bad):
        def log(self, rows: Sequence[Row]) -> None:
            time.sleep(0.2)
            super().log(rows)

    dashboard = Slow(facts(tmp_path))
    logger = Aside(dashboard, patience=30.0, past=[(0, {"a": 0.0})])
    began = time.monotonic()
    for step in range(1, 2000):
        logger.log_metrics({"a": float(step)}, step)
    assert time.monotonic() - began < 1.5
    logger.close(Ending(summary={"best/a": 1.0}))
    assert [step for step, _ in dashboard.told] == list(range(2000))
    assert dashboard.ended == Ending(summary={"best/a": 1.0})
    assert logger.off is None


def test_rows_are_collected_for_some_seconds_also_if_new_ones_never_end(
    bad: type[Bad], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A row arrives every second by a clock of the test, and the dashboard wants those of three seconds together."""
    monkeypatch.setattr(bad, "where", "open")
    monkeypatch.setattr(bad, "how", "hangs")
    monkeypatch.setattr(bad, "every", 3.5)
    clock = [0]
    logger = Aside(Bad(facts(tmp_path)))

    def get(timeout: float | None) -> Row:
        if timeout is not None and timeout < 1.0:
            raise queue.Empty
        clock[0] += 1
        assert clock[0] < 10, "the rows wait for the end of the run"
        return clock[0], {}

    monkeypatch.setattr(aside, "time", SimpleNamespace(monotonic=lambda: float(clock[0])))
    monkeypatch.setattr(logger, "_queue", SimpleNamespace(get=get))
    assert logger._waiting() == ([(1, {}), (2, {}), (3, {}), (4, {})], None)


def test_an_evaluation_sends_missed_values_to_the_dashboard_again(
    epo: Epo, bad: type[Bad], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(bad, "where", "open")
        assert epo("train", ROW, *TINY, "run_dir=run", "logger=[tensorboard]") == 0
    monkeypatch.setattr(logs, "TensorBoard", TensorBoard)
    assert epo("evaluate", "run=run") == 0
    assert len(events("run").Scalars("val/minSADE")) == 2


@pytest.mark.skipif(not Path("/proc/mounts").is_file(), reason="mounts are made as on Linux")
def test_a_full_disk_under_wandb_does_not_stop_the_run(
    epo: Epo,
    stopped: Callable[..., None],  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    stopped("run_dir=run", "logger=[csv]")
    config = Path("run/config.yaml")
    config.write_text(config.read_text().replace("logger:", "logger:\n  wandb: {mode: offline, patience: 15}\n ", 1))
    folder = Path("run/logs/wandb")
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("mounting a tiny disk needs root")
    try:
        assert epo("train", "resume=run") == 0
        left = subprocess.run(["df", "--output=avail", folder], capture_output=True, text=True, check=True).stdout
        assert left.split()[-1] == "0", "the disk was to be full"
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)
    assert RunFolder(Path("run")).finished
    assert len(in_file("run", "val/minSADE")) == 4


def test_hyperparameters_are_plain_values(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    board = TensorBoard(facts(tmp_path), TensorBoardSettings())
    board.open()
    board.close(Ending(summary={"best/a": 2.0}))
    shown = hyperparameters(str(tmp_path))
    assert (shown["a.b"].number_value, shown["a.c"].string_value) == (1.0, "[1, 2]")
