"""Code of two commits on one machine: do the runs of results files train as before?

    python -m benchmarks.commits results/rpi_hard.json results/us101.json

``benchmarks.repeat`` trains a run to its end and compares it with saved scores, which may come from another kind of
machine, where rounding differs. Here both codes run on this machine. Of every file, and of every commit in it, one run is
trained for a few steps: by the code of its commit, in a clone with a layer compiled there, and by the code at hand. Compared
is every number that both logs have: losses, and the scores of two validations.

Both codes get the recorded command, and the data sets in ``cache`` and ``data`` of this checkout; paths in overrides have to
be absolute. Clones, and what they have trained, stay in ``--out`` and are used again.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from benchmarks.command_line import parser_of
from benchmarks.repeat import chosen, difference, one_line, trained_runs
from epo_lightning.identity import data_recipe, essence
from epo_lightning.registry import ConfigError
from epo_lightning.report.results import SavedRun, results_name
from epo_lightning.run_folder import RunFolder

ROOT = Path(__file__).resolve().parent.parent
LAYER = "epo_lightning/solvers/gauss_newton/kernel/build.py"
SHARED = ("cache", "data")
"""Folders of data sets in this checkout, to which every clone has a link."""
REPLACED = ("run_dir", "runs", "score", "callbacks.progress", "trainer.max_steps", "trainer.validate_steps")
"""Settings of a recorded command that a comparison replaces or leaves out."""


def one_of_every_commit(runs: Sequence[SavedRun]) -> list[SavedRun]:
    """One run of every commit that trained some of the runs; of runs without a commit, one is among them."""
    commits = sorted({str(run.record.get("git_commit")) for run in runs})
    return [chosen([run for run in runs if str(run.record.get("git_commit")) == commit]) for commit in commits]


def code_of(commit: str | None, out: Path) -> Path:
    """The code of a commit with its layer, in a clone of its own below ``out``.

    Raises:
        ConfigError: the run has no commit that can be checked out, or its layer cannot be compiled.
    """
    if not commit or commit.endswith("+"):
        raise ConfigError(
            f"its code is not known: its commit is {commit}, where + stands for changes that are in no commit"
        )
    folder = (out / commit).resolve()
    if not folder.is_dir():
        begun = folder.with_name(f"{commit}.begun")
        shutil.rmtree(begun, ignore_errors=True)
        execute("git", "clone", "-q", "--shared", str(ROOT), str(begun), at=ROOT)
        execute("git", "checkout", "-q", commit, at=begun)
        for name in SHARED:
            (begun / name).symlink_to(ROOT / name)
        begun.rename(folder)
    return folder


def trained(code: Path, folder: Path, words: Sequence[str]) -> RunFolder:
    """A run by the code in the folder ``code``, in the new folder ``folder``.

    Raises:
        ConfigError: the command failed; the message is the end of what it printed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    execute(sys.executable, LAYER, at=code)
    execute(sys.executable, "-m", "epo_lightning.cli", "train", *words, f"run_dir='{folder.resolve()}'", at=code)
    return RunFolder(folder)


def command(saved: SavedRun, steps: int, overrides: Sequence[str]) -> list[str]:
    """The recorded words of a run, with a smaller number of steps and with overrides."""
    left_out = {*REPLACED, *(setting(word) for word in overrides)}
    words = [word for word in shlex.split(saved.record["command"])[2:] if setting(word) not in left_out]
    limits = [f"trainer.max_steps={steps}", f"trainer.validate_steps={steps // 2}", "callbacks.progress=none"]
    return [*words, *limits, *overrides]


def settings_since(saved: SavedRun) -> list[str]:
    """Settings that did not exist when a run was trained, with the values that make today's code do the same."""
    data = saved.settings["data"]
    return [f"data.recipe={data_recipe(data)}"] if data["name"] == "rpi" and "recipe" not in data else []


def setting(word: str) -> str:
    """The name of the setting that an override changes."""
    return word.lstrip("+").partition("=")[0]


def execute(*words: str, at: Path) -> None:
    """Run a program in the folder ``at``, whose package it imports.

    Raises:
        ConfigError: it failed.
    """
    environment = {name: value for name, value in os.environ.items() if name != "EPO_KERNEL"} | {"PYTHONPATH": str(at)}
    done = subprocess.run(words, cwd=at, env=environment, check=False, capture_output=True, text=True)
    if done.returncode:
        raise ConfigError(f"{shlex.join(words)} failed: {(done.stderr or done.stdout).strip()[-600:]}")


def check(saved: SavedRun, run: RunFolder) -> None:
    """Check that a run was trained on the data of the saved one, and with its settings but for those of the trainer.

    Raises:
        ConfigError: it was not; the recorded command has another meaning now.
    """
    if run.record["data_digest"] != saved.record.get("data_digest"):
        raise ConfigError(f"{run.path} has other data than the saved run")
    config: Any = OmegaConf.to_container(OmegaConf.load(run.config_file), resolve=True)
    ours = essence(config)
    theirs = essence({**saved.settings, "trainer": {}})
    for section, settings in theirs.items():
        for name, value in settings.items() if isinstance(settings, dict) else ():
            if ours[section].get(name) != value:
                raise ConfigError(f"{run.path} has {section}.{name}={ours[section].get(name)}, the saved run {value}")


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
    return max(difference(*pair) for pair in pairs), len(pairs)


def compared(saved: SavedRun, out: Path, steps: int, overrides: Sequence[str]) -> tuple[float, int]:
    """The distance of the logs of a run by the code of its commit, and by the code at hand.

    Raises:
        ConfigError: the run cannot be trained by both, or they do not train the same.
    """
    words, code = command(saved, steps, overrides), code_of(saved.record.get("git_commit"), out)
    name = hashlib.sha256(shlex.join(words).encode()).hexdigest()[:8]
    then, now = RunFolder(out / f"{code.name[:7]}-{name}"), out / f"now-{name}"
    if not then.finished:
        then = trained(code, then.path, words)
    again = trained(ROOT, now, [*words, *settings_since(saved)])
    check(saved, again)
    return distance(then.log(), again.log())


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("commits", __doc__)
    parser.add_argument("words", nargs="+", help="results files (*.json), and overrides for both codes")
    parser.add_argument("--steps", type=int, default=100, help="an even number; the middle and the end are validated")
    parser.add_argument("--out", type=Path, default=Path("build/commits"), help="folder of clones and runs")
    given = parser.parse_intermixed_args(arguments)
    if given.steps < 2 or given.steps % 2:
        parser.error(f"--steps must be an even number from 2, not {given.steps}")
    given.out.mkdir(parents=True, exist_ok=True)
    files = [word for word in given.words if word.endswith(".json")]
    overrides = [word for word in given.words if word not in files]
    print("| results file | run | commit | numbers | largest difference |")
    print("|:--|:--|:--|--:|--:|")
    for file in files:
        try:
            runs = one_of_every_commit(trained_runs(file))
        except ConfigError as error:
            print(f"| {results_name(file)} | not compared: {one_line(error)} | | | |", flush=True)
            continue
        for saved in runs:
            commit = str(saved.record.get("git_commit"))[:7]
            about = f"| {results_name(file)} | {saved.settings['title']}, seed {saved.settings['seed']} | {commit} |"
            try:
                largest, numbers = compared(saved, given.out, given.steps, overrides)
                print(f"{about} {numbers} | {largest:.2g} |", flush=True)
            except (ConfigError, OSError) as error:
                print(f"{about} | not compared: {one_line(error)} |", flush=True)


if __name__ == "__main__":
    main()
