"""`epo generate` on real clusters, with kills: the bytes of one machine."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
US101 = Path(os.environ.get("EPO_SHARED", ROOT.parent / "shared")) / "data" / "us101"
KILLS = 5
SLURM = ("hydra/launcher=slurm", "hydra.launcher.timeout_min=30", "hydra.launcher.mem_gb=2", "jobs=4")
RAY = ("hydra/launcher=ray_cluster", "jobs=4")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not US101.is_dir(), reason="no US-101 recordings"),
]
LAUNCHERS = [
    pytest.param(
        ("hydra/launcher=local", "hydra.launcher.n_jobs=2", "jobs=3"),
        marks=pytest.mark.skipif(
            find_spec("hydra_plugins.hydra_joblib_launcher") is None, reason="the extra `local` is not installed"
        ),
        id="local",
    ),
    pytest.param(
        SLURM,
        marks=pytest.mark.skipif(
            shutil.which("sinfo") is None or "SLURM_CONF" not in os.environ, reason="no Slurm: set SLURM_CONF"
        ),
        id="slurm",
    ),
    pytest.param(
        RAY,
        marks=pytest.mark.skipif("RAY_ADDRESS" not in os.environ, reason="no Ray cluster: set RAY_ADDRESS"),
        id="ray",
    ),
]


def generate(folder: Path, root: str, *words: str) -> subprocess.Popen[str]:
    """`epo generate` for US-101 in a process of its own, as a user starts it."""
    command = [sys.executable, "-m", "epo_lightning.cli", "generate", "data=us101", f"data.folder={US101}"]
    return subprocess.Popen(
        [*command, f"data.root={root}", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def contents(root: Path) -> dict[str, bytes]:
    """Files of the data set that are checked when it is read."""
    return {file.name: file.read_bytes() for file in root.glob("[!.]*/*") if file.suffix != ".csv"}


def parts(root: Path) -> dict[str, int]:
    """Finished parts, and when they were written."""
    return {file.name: file.stat().st_mtime_ns for file in root.glob(".*-parts/[!.]*.safetensors")}


def cancel(root: Path) -> None:
    """Kill the jobs of Slurm that work on a cache, whose folders have their numbers."""
    numbers = {folder.name.partition("_")[0] for folder in root.glob(".*-parts/jobs-*/slurm/*")}
    if numbers:
        subprocess.run(["scancel", "--signal=KILL", "--full", *numbers], check=False, capture_output=True)
        subprocess.run(["scancel", *numbers], check=False, capture_output=True)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("alone")
    process = generate(folder, "cache", "workers=1")
    assert process.wait() == 0, process.communicate()
    found = contents(folder / "cache")
    assert len(found) == 4
    return found


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_jobs_write_the_bytes_of_one_process(launcher, alone, tmp_path):
    process = generate(tmp_path, "cache", *launcher)
    out, error = process.communicate()
    assert process.returncode == 0, out + error
    assert contents(tmp_path / "cache") == alone
    assert "recording 22 of 22 extracted" in error
    assert not list((tmp_path / "cache").glob(".*-parts"))


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_five_kills_change_no_byte_and_lose_no_finished_part(launcher, alone, tmp_path):
    """The command is killed together with its jobs."""
    root, draw, kills = tmp_path / "cache", random.Random(0), 0
    for _ in range(KILLS):
        before = parts(root)
        wanted = len(before) + draw.randint(1, 3)
        process = generate(tmp_path, "cache", *launcher)
        while process.poll() is None and len(parts(root)) < wanted:
            time.sleep(0.02)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            kills += 1
        process.communicate()
        if launcher is SLURM:
            cancel(root)
        left = parts(root)
        assert not left or before.items() <= left.items(), "a finished part was written again"
    assert kills == KILLS
    process = generate(tmp_path, "cache", *launcher)
    out, error = process.communicate()
    assert process.returncode == 0, out + error
    assert contents(root) == alone
