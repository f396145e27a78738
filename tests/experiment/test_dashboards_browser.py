"""MLflow and TensorBoard opened in a browser: the pages show the runs of a sweep by name."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from experiment.conftest import TINY, Epo

pytestmark = pytest.mark.slow

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
NAMES = [f"{title} (seed {seed})" for title in ("V-LSTM", "V-LSTM + SC") for seed in (0, 1)]


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextlib.contextmanager
def serving(module: str, *words: str) -> Iterator[str]:
    """A dashboard's own server, until the block ends; its address."""
    port = free_port()
    environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    process = subprocess.Popen(
        [sys.executable, "-m", module, *words, "--host=127.0.0.1", f"--port={port}"],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    address = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 120
        while True:
            try:
                urlopen(address, timeout=5).close()
                break
            except (URLError, OSError):
                assert process.poll() is None, f"{module} ended with {process.returncode}"
                assert time.monotonic() < deadline, f"{module} does not answer"
                time.sleep(0.5)
        yield address
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)  # MLflow's server has children of its own
        process.wait(30)


@contextlib.contextmanager
def browsing(width: int = 1400, height: int = 620) -> Iterator[Any]:
    """A page of a browser without a window."""
    sync_api = pytest.importorskip("playwright.sync_api")
    if BROWSER is None:
        pytest.skip("needs Chromium or Chrome")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"])
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(90_000)
            yield page
        finally:
            browser.close()


def see_mlflow(runs: Path, names: list[str], picture: Path, experiment: str = "epo_lightning") -> None:
    """Open the experiment's table of runs; every name must be in it."""
    from mlflow import MlflowClient

    database = f"sqlite:///{runs.resolve() / 'mlflow.db'}"
    key = MlflowClient(database).get_experiment_by_name(experiment).experiment_id
    with (
        serving("mlflow", "server", f"--backend-store-uri={database}", "--workers=1") as address,
        browsing(1760) as page,
    ):
        page.goto(f"{address}/#/experiments/{key}/runs?compareRunsMode=CHART")
        for name in names:
            page.get_by_text(name, exact=True).first.wait_for(state="visible")
        page.get_by_placeholder("Search metric charts").fill("^val/min")
        page.wait_for_timeout(4000)  # the charts come one after the other
        page.screenshot(path=picture, clip={"x": 0, "y": 0, "width": 1305, "height": 620})  # its assistant is beyond


def see_tensorboard(runs: Path, names: list[str], picture: Path) -> None:
    """Open the scalars; every run's folder must be listed, and a curve be drawn."""
    with serving("tensorboard.main", f"--logdir={runs}", "--load_fast=false") as address, browsing() as page:
        page.goto(f"{address}/?tagFilter=val%2Fmin#timeseries")
        for name in names:
            page.get_by_text(name, exact=True).first.wait_for(state="visible")
        page.locator("scalar-card").first.wait_for(state="visible")
        page.get_by_role("button", name="Settings").click()  # closes them
        page.wait_for_timeout(3000)  # the lines grow
        page.screenshot(path=picture)


def see_hyperparameters(runs: Path, picture: Path) -> None:
    """Open the HPARAMS tab; parameters and final scores must be columns of its table."""
    with serving("tensorboard.main", f"--logdir={runs}", "--load_fast=false") as address, browsing() as page:
        page.goto(f"{address}/#hparams")
        page.get_by_text("best/minSADE").first.wait_for(state="visible")
        page.get_by_text("optimizer.lr").first.wait_for(state="attached")
        page.screenshot(path=picture)


@pytest.fixture
def sweep(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two rows with two seeds each, trained in a moment."""
    pytest.importorskip("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    rows = "experiment=rpi/v_lstm,rpi/v_lstm_sc"
    assert epo("train", "-m", rows, *TINY, "seed=0,1", "logger=[csv,tensorboard,mlflow]") == 0
    return Path("runs")


def test_the_pages_show_the_runs_by_name(sweep: Path, tmp_path: Path) -> None:
    folders = [str(log.parent.relative_to(sweep)) for log in sorted(sweep.rglob("events.out.*"))]
    assert len(folders) == 4
    see_mlflow(sweep, NAMES, tmp_path / "mlflow.png")
    see_tensorboard(sweep, folders, tmp_path / "tensorboard.png")
    see_hyperparameters(sweep, tmp_path / "hparams.png")
    assert all((tmp_path / f"{name}.png").stat().st_size > 20_000 for name in ("mlflow", "tensorboard", "hparams"))
