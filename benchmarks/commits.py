"""Code of two commits on one machine: do the runs of results files train as before?

    python -m benchmarks.commits results/rpi_hard.json results/us101.json

``benchmarks.repeat`` trains a run to its end and compares it with saved scores, which may come from another kind of
machine, where rounding differs. Here both codes run on this machine. Of every file, and of every commit in it, one run is
trained for a few steps: by the code of its commit, which is checked out into a git worktree with a layer compiled there,
and by the code at hand. Compared is every number in the logs of both: losses, and the scores of two validations.

Data sets are those of the folders ``cache`` and ``data`` here. Commands of the files are given to both codes as they are.
Worktrees and runs stay in ``--out``, and finished runs are not trained again.
"""

from __future__ import annotations

import argparse
import math
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.repeat import chosen, trained_runs
from epo_lightning.registry import ConfigError
from epo_lightning.report.results import SavedRun, results_name
from epo_lightning.run_folder import RunFolder

ROOT = Path(__file__).resolve().parent.parent
LAYER = Path("epo_lightning/solvers/gauss_newton/kernel/build.py")
SHARED = ("cache", "data")
"""Folders of data sets, which the worktrees share with the code at hand."""
ONE_RUN = ("run_dir", "runs", "score", "callbacks.progress", "trainer.max_steps", "trainer.validate_steps")
"""Settings of a recorded command that a comparison replaces or leaves out."""


def one_of_every_commit(runs: Sequence[SavedRun]) -> list[SavedRun]:
    """One run of every commit that trained some of the runs."""
    commits = sorted({run.record["git_commit"] for run in runs})
    return [chosen([run for run in runs if run.record["git_commit"] == commit]) for commit in commits]


def worktree(commit: str, out: Path) -> Path:
    """The code of a commit with its layer, in a folder of its own below ``out``.

    Raises:
        ConfigError: the repository does not have the commit, or the layer cannot be compiled.
    """
    folder = (out / commit).resolve()
    if not folder.is_dir():
        execute("git", "worktree", "prune", at=ROOT)
        execute("git", "worktree", "add", "--detach", str(folder), commit, at=ROOT)
        for name in SHARED:
            if Path(name).is_dir():
                (folder / name).symlink_to(Path(name).resolve())
    execute(sys.executable, str(LAYER), at=folder)
    return folder


def trained(saved: SavedRun, code: Path, folder: Path, steps: int, overrides: Sequence[str]) -> RunFolder:
    """The first steps of a run by the code in the folder ``code``.

    Raises:
        ConfigError: the command failed; the message is the end of what it printed.
    """
    run = RunFolder(folder.resolve())
    if not run.finished:
        shutil.rmtree(run.path, ignore_errors=True)
        command = shlex.split(saved.record["command"])[2:]
        words = [word for word in command if word.lstrip("+").partition("=")[0] not in ONE_RUN]
        limits = [f"trainer.max_steps={steps}", f"trainer.validate_steps={steps // 2}", "callbacks.progress=none"]
        train = [sys.executable, "-m", "epo_lightning.cli", "train", *words, *limits, *overrides]
        execute(*train, f"run_dir={run.path}", at=code)
    return run


def execute(*words: str, at: Path) -> None:
    """Run a program in the folder ``at``, with the packages of that folder first.

    Raises:
        ConfigError: it failed.
    """
    environment = {**os.environ, "PYTHONPATH": str(at)}
    done = subprocess.run(words, cwd=at, env=environment, check=False, capture_output=True, text=True)
    if done.returncode:
        raise ConfigError(f"{shlex.join(words)} failed: {(done.stderr or done.stdout).strip()[-600:]}")


def distance(before: Sequence[Mapping[str, str]], now: Sequence[Mapping[str, str]]) -> tuple[float, int]:
    """Largest difference of a number that both logs have, and how many there are.

    Raises:
        ConfigError: the logs do not have the same steps, or no number in common.
    """
    if [row["step"] for row in before] != [row["step"] for row in now]:
        raise ConfigError("the logs do not have the same steps")
    pairs = [
        (float(old[name]), float(new[name]))
        for old, new in zip(before, now, strict=True)
        for name in sorted(old.keys() & new.keys() - {"epoch", "step"})
    ]
    if not pairs:
        raise ConfigError("the logs have no number in common")
    return max(0.0 if a == b or (math.isnan(a) and math.isnan(b)) else abs(a - b) for a, b in pairs), len(pairs)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.commits", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="+", help="results files, and overrides for both codes")
    parser.add_argument("--steps", type=int, default=200, help="training steps; the middle and the end are validated")
    parser.add_argument("--out", type=Path, default=Path("build/commits"), help="folder of worktrees and runs")
    given = parser.parse_args(arguments)
    overrides = [word for word in given.words if "=" in word]
    print("| results file | run | commit | numbers | largest difference |")
    print("|:--|:--|:--|--:|--:|")
    for file in (word for word in given.words if "=" not in word):
        try:
            runs = one_of_every_commit(trained_runs(file))
        except ConfigError as error:
            print(f"| {results_name(file)} | not compared: {error} | | | |", flush=True)
            continue
        for saved in runs:
            commit = saved.record["git_commit"][:7]
            about = f"| {results_name(file)} | {saved.settings['title']}, seed {saved.settings['seed']} | {commit} |"
            folder = given.out / f"{results_name(file)}-{commit}-{given.steps}"
            try:
                old = trained(saved, worktree(commit, given.out), folder / "then", given.steps, overrides)
                new = trained(saved, ROOT, folder / "now", given.steps, overrides)
                largest, numbers = distance(old.log(), new.log())
                print(f"{about} {numbers} | {largest:.2g} |", flush=True)
            except ConfigError as error:
                print(f"{about} | not compared: {' '.join(str(error).split())} |", flush=True)


if __name__ == "__main__":
    main()
