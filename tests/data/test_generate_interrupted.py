"""`epo generate` killed at any moment, on a full disk and in a read-only folder: a complete data set or none."""

from __future__ import annotations

import csv
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

FIXTURE = Path(__file__).parents[1] / "fixtures" / "exid_sim"
RPI = ("data=rpi", "data.games=3", "data.placements=2", "data.seed=1", "data.sizes=null")
EXID = ("data=exid", f"data.folder={FIXTURE}")
pytestmark = pytest.mark.slow


def generate(words: tuple[str, ...], root: Path, *prefix: str, workers: int = 1) -> subprocess.Popen[str]:
    command = [*prefix, sys.executable, "-m", "epo_lightning.cli", "generate", *words, f"workers={workers}"]
    environment = {**os.environ, "EPO_CACHE": str(root)}
    return subprocess.Popen(
        command, env=environment, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def contents(root: Path) -> dict[str, bytes]:
    """Files of the data sets of a cache, without its hidden files, the pool, and the measured times of the summary."""
    folders = [path for path in root.glob("[!.]*-*") if "pool" not in path.name]
    return {str(file.relative_to(root)): _content(file) for folder in folders for file in folder.iterdir()}


def _content(file: Path) -> bytes:
    if file.name != "recordings.csv":
        return file.read_bytes()
    rows = list(csv.DictReader(file.open(newline="")))
    return repr([{key: value for key, value in row.items() if key != "seconds"} for row in rows]).encode()


@pytest.mark.parametrize(("words", "workers"), [(RPI, 1), (EXID, 2)])
def test_a_killed_generation_leaves_no_partial_set(words, workers, tmp_path):
    process = generate(words, tmp_path / "whole", workers=workers)
    began = time.monotonic()
    assert process.wait() == 0, process.communicate()[1]
    lasted, expected = time.monotonic() - began, contents(tmp_path / "whole")
    draw, finished = random.Random(0), 0
    for _ in range(10):
        root = tmp_path / "killed"
        process = generate(words, root, workers=workers)
        try:
            process.wait(draw.uniform(0.3, 1.1) * lasted)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert contents(root) in ({}, expected)
        if contents(root):
            finished += 1
            shutil.rmtree(root)  # otherwise finished work is kept, and the next time is shorter
    process = generate(words, tmp_path / "killed", workers=workers)
    assert process.communicate()[1] is not None
    assert process.returncode == 0
    assert contents(tmp_path / "killed") == expected
    visible = {path.name for path in (tmp_path / "whole").iterdir() if not path.name.endswith(".lock")}
    left = {path.name for path in (tmp_path / "killed").iterdir() if not path.name.endswith(".lock")}
    assert left == visible, "something of a killed process was left behind"


@pytest.fixture
def small_disk(tmp_path):
    """A function that gives a command a disk of some kilobytes; in a mount namespace that ends with the command."""
    if not shutil.which("unshare") or subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode:
        pytest.skip("needs a mount namespace")
    (tmp_path / "disk").mkdir()

    def prefix(options: str, rest: str = "") -> tuple[str, ...]:
        script = f'mount -t tmpfs -o {options} none "{tmp_path}/disk" && {rest or "true"} && exec "$@"'
        return ("unshare", "-rm", "sh", "-c", script, "sh")

    return prefix


@pytest.mark.parametrize(("words", "sizes"), [(RPI, (1, 300, 2000)), (EXID, (1, 150, 400))])
def test_a_full_disk_is_one_line_and_loses_nothing(words, sizes, tmp_path, small_disk):
    """The disk is full at once, while finished work is written, and while the data set is written."""
    for size in sizes:
        keep = f'trap \'cp -a "{tmp_path}/disk/." "{tmp_path}/kept"\' EXIT'
        script = small_disk(f"size={size}k")[-2].replace('exec "$@"', f'({keep}; "$@")')
        shutil.rmtree(tmp_path / "kept", ignore_errors=True)
        process = generate(words, tmp_path / "disk", "unshare", "-rm", "sh", "-c", script, "sh")
        error = process.communicate()[1]
        assert process.returncode != 0
        line = error.splitlines()[-1]
        assert re.match(rf"epo: cannot write .*make room.*: {re.escape(str(tmp_path / 'disk'))}", line), error
        assert "Traceback" not in error
        assert not contents(tmp_path / "kept")
        if (tmp_path / "kept").exists():
            assert generate(words, tmp_path / "kept").wait() == 0
            assert contents(tmp_path / "kept")


@pytest.mark.parametrize("words", [RPI, EXID])
def test_a_read_only_folder_is_one_line(words, tmp_path, small_disk):
    process = generate(words, tmp_path / "disk", *small_disk("ro"))
    error = process.communicate()[1]
    assert process.returncode != 0
    assert len(error.splitlines()) == 1
    assert "Read-only file system" in error
    assert str(tmp_path / "disk") in error


@pytest.mark.parametrize("words", [RPI, EXID])
def test_a_complete_data_set_is_read_from_a_read_only_folder(words, tmp_path, small_disk):
    assert generate(words, tmp_path / "cache").wait() == 0
    bind = f'mount --bind -o ro "{tmp_path}/cache" "{tmp_path}/disk"'
    process = generate(words, tmp_path / "disk", *small_disk("size=1k", bind))
    error = process.communicate()[1]
    assert process.returncode == 0, error
