"""The sweeps that exist, and the states of those that have begun: what ``epo sweep`` prints without running anything."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from epo_lightning.experiment.config import compose
from epo_lightning.experiment.config.sources import GROUP, file_of, options_of
from epo_lightning.experiment.sweeps.sweep import Sweep
from epo_lightning.experiment.sweeps.watch import status, summary
from epo_lightning.masking import mask
from epo_lightning.registry import nearest


def known(extra: Sequence[str] = ()) -> dict[str, str]:
    """The names of all sweeps, and the description with which each file begins."""
    says = {}
    with compose.hydra(extra) as instance:
        for option in options_of(instance, GROUP):
            lines = Path(file_of(instance, GROUP, option)).read_text(encoding="utf-8").splitlines()
            says[option] = _description([line for line in lines if line.startswith("#") and "@package" not in line])
    return says


def unknown(name: str, names: Collection[str]) -> str:
    """The error message for a sweep that is not among the known ones: the nearest name, or the folder that has its file."""
    option = Path(name).stem
    for home in (Path(name).parent.parent, Path("conf")):
        if option not in names and (file := home / GROUP / f"{option}.yaml").is_file():
            return f"unknown sweep {name!r}: {file} is found by `{command_line(['epo', 'sweep', option], [str(home)])}`"
    return f"unknown sweep {name!r}: {nearest(option, names)}; those of a folder of your own need --config-dir <folder>"


def _description(comments: Sequence[str]) -> str:
    """The first sentence of comment lines: up to a line that ends with a full stop or colon, or up to an example command."""
    text = ""
    for line in comments:
        text, _, command = f"{text} {line.lstrip('# ')}".strip().partition(":  ")
        if command or text.endswith((":", ".", "?", "!")):
            break
    return text.rstrip(":")


def show(name: str | None, overrides: Sequence[str]) -> None:
    """Print the state of every run of a sweep that has begun; without a name, a summary of every sweep.

    Raises:
        ConfigError: no sweep with that name and overrides has begun.
    """
    runs = folder_of_runs(overrides)
    if name is not None:
        status(Sweep.find(name, overrides, runs))
        return
    for sweep in Sweep.begun(runs):
        counts = Counter(sweep.state(job) for job in sweep.jobs)
        print(f"{sweep.label}: {summary(counts)}\n    {sweep.record.get('command', '')}")


def folder_of_runs(overrides: Sequence[str]) -> str:
    """The folder below which runs are written: the override ``runs``, parsed by Hydra, or its default."""
    return str(compose.compose("train", [given for given in overrides if given.startswith("runs=")])["runs"])


def command_line(words: Sequence[str], extra: Sequence[str]) -> str:
    """A command line as a user would give it, without passwords."""
    return shlex.join(mask([*words, *(f"--config-dir={folder}" for folder in extra)]))
