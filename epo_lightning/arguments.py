"""The words of the command line: its verbs, options and help texts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from epo_lightning.registry import ConfigError, nearest

USAGE = """\
epo - energy-based potential games for multi-agent motion forecasting

  epo generate                               make the data set
  epo train experiment=rpi/v_lstm_epo        train one method (a row of the paper's table)
  epo sweep rpi_main                         train and score all rows with several seeds; skips finished runs
  epo sweep status rpi_main                  show the state of all these runs
  epo train resume=<run folder>              continue after a kill
  epo evaluate runs=runs                     score finished runs on the test split
  epo predict run=<run folder> out=<folder>  write and draw forecasts
  epo explore run=<run folder>               change inferred games on a page and see what follows
  epo export run=<run folder> out=<file>     write a forecaster as a program that runs without this package
  epo drive run=<run folder> out=<folder>    plan for one agent in closed loop while the others react
  epo report rpi_main                        write the table with the paper's values, figures, and one HTML page
  epo config experiment=rpi/v_lstm_epo       print the resolved configuration
  epo config check experiment=...            check it, without loading anything

Everything after the verb is a Hydra override, key=value. `epo <verb> --help` lists what can be set.

Options
  -m, --multirun        run every combination of comma-separated values (epo train -m seed=0,1,2)
  --stop-on-failure     epo sweep: start no more runs after one has failed
  --config-dir FOLDER   look for configurations here first
  --traceback           show the Python traceback of an error
  --version
  -h, --help
"""

SWEEP_USAGE = """\
epo sweep <name> [key=value ...]             train and score all runs of a sweep that are not finished yet
epo sweep generate <name> [key=value ...]    make the data sets of its runs that do not exist yet
epo sweep status [<name or label>]           show the state of its runs
epo sweep                                    list the sweeps

  choices=<file>      train experiments with the settings that a search has chosen (choices.yaml of its report)
  --stop-on-failure   start no more runs after one has failed
"""

VERBS = {
    "generate": "make a data set and print its report",
    "train": "train a forecaster into a run folder",
    "sweep": "train and score all runs of a table or figure; `epo sweep status` shows their state",
    "evaluate": "score runs on the test split",
    "predict": "write and draw a run's forecasts",
    "explore": "a page on which a run's inferred games are changed by hand and solved anew",
    "export": "write a run's forecaster as a program that runs without this package",
    "drive": "plan with a run for one agent in closed loop while the others react",
    "report": "tables and figures of evaluated runs",
    "config": "print or check a resolved configuration",
}


@dataclass
class Arguments:
    """A parsed command line.

    Attributes:
        verb: the first word, one of ``VERBS``; empty if there is none.
        overrides: the words after the verb, mostly Hydra overrides.
        extra: folders of ``--config-dir``.
    """

    verb: str
    overrides: list[str] = field(default_factory=list)
    multirun: bool = False
    stop_on_failure: bool = False
    help: bool = False
    extra: list[str] = field(default_factory=list)


def parse(words: Sequence[str]) -> Arguments:
    """Parse a command line.

    Raises:
        ConfigError: an unknown verb or option.
    """
    found = Arguments(verb="")
    rest = iter(words)
    for word in rest:
        if word in ("-h", "--help"):
            found.help = True
        elif word in ("-m", "--multirun"):
            found.multirun = True
        elif word == "--stop-on-failure":
            found.stop_on_failure = True
        elif word == "--config-dir" or word.startswith("--config-dir="):
            folder = word.partition("=")[2] or next(rest, "")
            if not folder:
                raise ConfigError("--config-dir needs a folder")
            found.extra.append(folder)
        elif word.startswith("-"):
            known = ("--multirun", "--stop-on-failure", "--config-dir", "--traceback", "--version", "--help")
            raise ConfigError(f"unknown option {word}: {nearest(word, known)}")
        elif not found.verb:
            if word not in VERBS:
                raise ConfigError(f"unknown verb {word!r}: {nearest(word, VERBS)}")
            found.verb = word
        else:
            # Hydra would read the word nan as a floating-point number.
            found.overrides.append("debug='nan'" if word == "debug=nan" else word)
    _refuse_without_effect(found.overrides)
    if found.stop_on_failure and found.verb != "sweep":
        raise ConfigError("--stop-on-failure belongs to epo sweep")
    return found


def _refuse_without_effect(overrides: Sequence[str]) -> None:
    """Refuse a key that is set twice (Hydra would silently use the last value) and an empty mapping (it changes nothing)."""
    seen: dict[str, str] = {}
    for word in overrides:
        key, equals, value = word.lstrip("+").partition("=")
        if value.strip() == "{}" and not word.startswith("+"):
            raise ConfigError(
                f"{word} would change nothing: Hydra merges an empty mapping into the keys that are there. Set single keys, "
                f"as {key}.<name>=<value>, or remove one, as ~{key}.<name>"
            )
        if equals and key in seen:
            raise ConfigError(f"{key} is set twice, by {seen[key]} and by {word}: leave one of them out")
        seen[key] = word
