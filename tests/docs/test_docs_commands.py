"""Every command of README and docs: those that no other test of this folder runs must compose, or name existing files."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from docs.pages import PAGES, ROOT, commands, unknown
from suites import untrained

from epo_lightning.arguments import parse
from epo_lightning.experiment import assembly, verbs
from epo_lightning.experiment.config import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.sweeps import listing, sweeping
from epo_lightning.schema import read

NOT_RUN = {
    "docker": "no container engine in the tests",
    "tensorboard": "a server",
    "mlflow": "a server",
    "wandb": "needs an account",
}
OF_EXAMPLES = {
    "mine": "of the tutorial, which test_docs_tutorial.py runs",
    "gru": "of extend.md, whose code tests/backbones/test_documented_backbone.py runs",
    "curvature": "of extend.md, whose code tests/game/test_extend.py runs",
    "rpi_curvature": "of extend.md",
    "imitation_speed": "of extend.md, whose code test_docs_extend.py runs",
    "fixed_step": "of extend.md, whose code test_docs_extend.py runs",
    "my_conf": "of extend.md",
}
MAKEFILE = (ROOT / "Makefile").read_text()
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
COMMANDS = {command: page for page in PAGES for command in commands(page)}


def test_shell_blocks_hold_nothing_but_known_programs() -> None:
    assert {page.name: lines for page in PAGES if (lines := unknown(page))} == {}
    assert len(COMMANDS) > 60


def make_frozen(words: list[str]) -> None:
    """In the present folder, the run that a command refines, with initial weights."""
    for word in words:
        if word.startswith("forecaster.frozen="):
            given = [other.replace("_refined", "") for other in words if other != word]
            settings = read(Settings, compose.compose("train", given))
            checkpoints = Path(word.partition("=")[2]) / "checkpoints"
            checkpoints.mkdir(parents=True)
            untrained(assembly.describe_model(settings, assembly.build_data(settings.data)), checkpoints / "best.ckpt")


def composes(words: list[str]) -> None:
    """Compose and check what `epo <words>` would do, without data; of a table, its first run."""
    arguments = parse(words)
    verb, overrides = arguments.verb, list(arguments.overrides)
    if verb == "config":
        verb = "train"
        overrides = [word for word in overrides if word not in ("check", "train")]
    if verb == "sweep":
        if overrides[:1] in (["status"], ["generate"]):
            overrides = overrides[1:]
        if not overrides:
            return
        name, *overrides = overrides
        name = name.partition("-")[0]
        assert name in listing.known(arguments.extra), name
        kept = [word for word in overrides if not word.startswith((sweeping.CHOICES, "workers="))]
        verb, overrides = "train", sweeping.words_of(name, kept, arguments.extra)
        arguments.multirun = True
    if verb == "report" and overrides and "=" not in overrides[0]:
        assert overrides.pop(0) in listing.known(arguments.extra)
    if verb in ("generate", "evaluate") and arguments.multirun:
        overrides = compose.jobs(verb, overrides, arguments.extra)[0]
    if verb != "train":
        verbs.check_settings(verb, compose.compose(verb, overrides, arguments.extra))
        return
    if overrides and overrides[0].startswith("resume="):
        assert overrides[1:] == []
        return
    runs = compose.jobs("train", overrides, arguments.extra) if arguments.multirun else [overrides]
    for run in runs[:1]:
        make_frozen(run)
        assembly.check_buildable(read(Settings, compose.compose("train", run, arguments.extra)))


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.split()[0] == "epo"])
def test_commands_compose(command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    if any(re.search(rf"\b{example}\b", command) for example in OF_EXAMPLES):
        pytest.skip("of an example with files of its own, which another test runs")
    words = [word for word in shlex.split(command)[1:] if word != "..."]
    if "solver=newton" in words and "backward=implicit" not in words:  # the example of a refusal
        with pytest.raises(compose.ConfigError, match="With this instead it works"):
            composes(words)
    else:
        composes(words)


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.split()[0] != "epo"])
def test_other_commands_name_what_exists(command: str) -> None:
    program, *words = shlex.split(command)
    if program in NOT_RUN:
        pytest.skip(NOT_RUN[program])
    if program == "make":
        assert re.search(rf"^{words[0]}:", MAKEFILE, re.MULTILINE), words[0]
    elif program == "pip":
        for extra in re.findall(r"\[(\w+)\]", command):
            assert extra in EXTRAS, extra
    elif program == "pytest":
        for path in (word for word in words if word.startswith("tests/")):
            assert (ROOT / path).exists(), path
    elif words[0] == "-m" and words[1] not in ("pytest", "compileall"):
        source = ROOT / words[1].replace(".", "/")
        file = source / "__main__.py" if source.is_dir() else source.with_suffix(".py")
        assert file.is_file(), file
        flags = [word for word in words[2:] if word.startswith("--")]
        assert all(f'"{flag}"' in file.read_text() for flag in flags), flags
    elif words[0].endswith(".py"):
        known = [word for page in PAGES for word in re.findall(r"^`([\w./]+)`:$", page.read_text(), re.MULTILINE)]
        assert (ROOT / words[0]).is_file() or words[0] in known, words[0]
