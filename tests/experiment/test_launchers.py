"""Sweeps through every launcher: equal bytes of the results."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WORDS = ("data=drawn", "data.like=rpi", "data.scenes=64", "budget=smoke", "callbacks.progress=none", "seed=0,1")


def sweep(folder: Path, runs: str, *words: str, rows: str = "rpi/v_lstm_epo") -> subprocess.CompletedProcess:
    """A sweep in a process of its own, as a user starts it."""
    program = [
        sys.executable,
        "-m",
        "epo_lightning.cli",
        "sweep",
        "rpi_main",
        *WORDS,
        f"experiment={rows}",
        f"runs={runs}",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [*program, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=500, check=False
    )


def scores(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.glob("rpi/*/*/metrics.json")}


@pytest.fixture(scope="module")
def sequential(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep without a launcher."""
    folder = tmp_path_factory.mktemp("launchers")
    done = sweep(folder, "sequential")
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(scores(folder / "sequential")) == 2
    return folder


def check(folder: Path, runs: str, *words: str) -> None:
    done = sweep(folder, runs, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    assert scores(folder / runs) == scores(folder / "sequential")
    assert sorted(path.name for path in (folder / runs).iterdir()) == ["rpi", "sweeps"]


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("hydra_plugins.hydra_joblib_launcher") is None, reason="the extra `local` is not installed"
)
def test_a_sweep_runs_in_parallel_on_this_machine(sequential: Path) -> None:
    check(sequential, "local", "hydra/launcher=local", "hydra.launcher.n_jobs=2")


@pytest.mark.slow
@pytest.mark.skipif(find_spec("submitit") is None, reason="the extra `slurm` is not installed")
def test_a_sweep_runs_through_submitit_without_a_cluster(sequential: Path) -> None:
    check(sequential, "submitit", "hydra/launcher=submitit_local")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("sinfo") is None or "SLURM_CONF" not in os.environ, reason="no Slurm: set SLURM_CONF")
def test_a_sweep_runs_on_slurm(sequential: Path) -> None:
    check(sequential, "slurm", "hydra/launcher=slurm", "hydra.launcher.timeout_min=30", "hydra.launcher.mem_gb=2")


@pytest.mark.slow
@pytest.mark.skipif("RAY_ADDRESS" not in os.environ, reason="no Ray cluster: set RAY_ADDRESS")
def test_a_sweep_runs_on_a_ray_cluster(sequential: Path) -> None:
    check(sequential, "ray", "hydra/launcher=ray_cluster")


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("hydra_plugins.hydra_joblib_launcher") is None, reason="the extra `local` is not installed"
)
def test_a_failure_in_a_worker_is_reported(sequential: Path) -> None:
    words = ("hydra/launcher=local", "hydra.launcher.n_jobs=2", "optimizer.lr=1e25")
    done = sweep(sequential, "failing", *words, rows="rpi/const_vel,rpi/v_lstm_sc")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "FAILED, Diverged" in done.stdout
    assert "2 done, 2 failed" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.skipif(
    find_spec("hydra_plugins.hydra_joblib_launcher") is None, reason="the extra `local` is not installed"
)
def test_a_missing_package_of_a_launcher_is_named_at_once(tmp_path: Path) -> None:
    # In a process of its own, in which Hydra's plugin has not been imported yet.
    program = "import sys; sys.modules['joblib'] = None; from epo_lightning.cli import main; main(sys.argv[1:])"
    words = ["sweep", "rpi_main", *WORDS, "experiment=rpi/const_vel", "hydra/launcher=local"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stdout + done.stderr
    assert "the launcher needs a package that is not installed" in done.stderr
    assert "joblib" in done.stderr
    assert "broke down" not in done.stdout, "a further start would fail in the same way"
