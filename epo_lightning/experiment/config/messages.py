"""Hydra's and OmegaConf's errors as one sentence each, with the nearest valid word."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from epo_lightning.experiment.config.sources import EXPERIMENTS, file_of, options_of
from epo_lightning.registry import ConfigError, nearest, one_line, parts

if TYPE_CHECKING:
    from hydra._internal.hydra import Hydra

PLUGINS = {
    "hydra/launcher/joblib": "local",
    "hydra/launcher/submitit_slurm": "slurm",
    "hydra/launcher/submitit_local": "slurm",
    "hydra/launcher/ray": "ray",
    "hydra/sweeper/optuna": "search",
}
"""Options that come with another package, and the extra that installs it."""

SEVERAL = "logger"
"""The only group of which a run can have several options."""


@contextmanager
def one_sentence(instance: Hydra, name: str, overrides: Sequence[str]) -> Iterator[None]:
    """Turn Hydra's and OmegaConf's exceptions into a :class:`ConfigError` that names the nearest valid word."""
    from hydra.errors import HydraException, MissingConfigException, OverrideParseException
    from omegaconf.errors import OmegaConfBaseException

    try:
        yield
    except OverrideParseException as error:
        raise ConfigError(
            f"cannot read the override {error.override!r}: write key=value without blanks, for example seed=1; "
            "a value with other than plain letters, digits and ._-/ needs quotes, \"key='value'\""
        ) from error
    except MissingConfigException as error:
        missing = error.missing_cfg_file or ""
        where = _place(instance, name, missing, overrides)
        raise ConfigError(where + _missing_option(instance, missing, str(error))) from error
    except (HydraException, OmegaConfBaseException) as error:
        repeated = re.search(r"Multiple values for ([\w./@]+)\. .*'override [\w./@]+: (\S+)'", str(error))
        if repeated:
            raise ConfigError(_override(instance, repeated.group(1), repeated.group(2), overrides)) from error
        unknown = re.search(r"Could not (?:override|delete from config\.) +'([\w./@]+)'", str(error))
        if unknown and (relative := re.fullmatch(r"experiment/(?:[\w-]+/)*([\w-]+)@[\w.-]+", unknown.group(1))):
            raise ConfigError(_override(instance, relative.group(1), "<option>", overrides)) from error
        if unknown and "Multiple values" not in str(error):
            below = str(
                getattr(error.__cause__, "full_key", None)
            )  # of a mapping: objective.weights={imitation: 1, foo: 1}
            key = below if below.startswith(f"{unknown.group(1)}.") else unknown.group(1)
            raise ConfigError(_unknown_key(instance, name, key, overrides)) from error
        if known := re.search(r"An item is already at '(.+)'\.\s+Either remove \+ prefix: '(.+)'", str(error)):
            raise ConfigError(f"{known.group(1)} has a value, so leave out the plus: {known.group(2)}") from error
        if several := re.search(r"Ambiguous value for argument '(.+?)'", str(error)):
            raise ConfigError(
                f"{several.group(1)} has several values: for a run of each, add -m, or use a sweep; a text with a comma "
                "needs quotes of its own, \"key='a,b'\""
            ) from error
        kinds = r"Error merging override ([^=]+)=(.+); Cannot merge DictConfig with ListConfig"
        if other := re.search(kinds, sentence(error)):
            raise ConfigError(_other_kind(*other.groups())) from error
        raise ConfigError(_in_file(str(error)) or sentence(error)) from error
    except ValueError as error:  # Hydra's own, for example debug=null
        if isinstance(error, ConfigError):
            raise
        if index := re.search(r"invalid literal for int\(\) with base 10: '(.+)'", str(error)):
            word = next((word for word in overrides if f".{index.group(1)}" in word.partition("=")[0]), index.group(1))
            raise ConfigError(
                f"{word} names an entry of a list, whose entries have numbers: set the whole list, as in "
                "energy.own=[goal,vel]"
            ) from error
        unnamed = "Config group override must be a string" in str(error) and _no_name(instance, overrides)
        raise ConfigError(unnamed or sentence(error)) from error


def refuse_merged(instance: Hydra, word: str, where: str = "") -> None:
    """Refuse an override that chooses a list of options of a group, which Hydra would merge into one configuration.

    Args:
        instance: Hydra with the configuration tree.
        word: the override.
        where: beginning of the message: the file that has it, if it is not from the command line.

    Raises:
        ConfigError: a list of options; the message says how to write one run of each.
    """
    group, _, value = word.lstrip("+").partition("=")
    if not value.strip().startswith("[") or group == SEVERAL or not options_of(instance, group):
        return
    options = ",".join(re.findall(r"[^\s,'\"\[\]]+", value))
    raise ConfigError(
        f"{where}{word} is a list, which would be merged into a single run: for a run of each, write {options} without "
        "brackets, in a sweep or with the option -m"
    )


def _in_file(message: str) -> str:
    """The error message for a key that Hydra's own sections do not have, in the file that has it; empty for other errors."""
    found = re.search(
        r"In '([^']+)': ConfigKeyError raised while composing config:\s*Key '(\w+)' not in '\w+'", message
    )
    if found is None:
        return ""
    file, key = found.groups()
    return f"{file}.yaml has an unknown key {key!r} under hydra: a sweep's values stand in hydra.sweeper.params"


def _other_kind(key: str, value: str) -> str:
    """The error message for a list in the place of a dictionary, or a dictionary in the place of a list."""
    key = key.lstrip("+")
    if value.startswith("["):
        return f"{key} is a dictionary, not the list {value}: set one of its entries by {key}.<name>=<value>"
    return f"{key} is a list, not the dictionary {value}: set it by {key}=[...]"


def _no_name(instance: Hydra, overrides: Sequence[str]) -> str:
    """The error message for a number or a dictionary as the option of a group; empty if no override has one."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    for word, parsed in zip(overrides, OverridesParser.create().parse_overrides(list(overrides)), strict=True):
        options = options_of(instance, parsed.key_or_group)
        if options and not isinstance(option := parsed.value(), str | list) and not parsed.is_sweep_override():
            return f"{word} chooses an option that is no name: {_known(str(option), options)}"
    return ""


def _chosen(overrides: Sequence[str]) -> str:
    """The experiment that the command line chooses."""
    chosen = [word.partition("=")[2] for word in overrides if word.startswith("experiment=")]
    return chosen[-1].strip("'\"") if chosen else "<row>"


def _override(instance: Hydra, group: str, option: str, overrides: Sequence[str]) -> str:
    """The error message for a second option of a group, from the command line or from an experiment's file."""
    if any(word.startswith(f"+{group}=") for word in overrides):
        return f"+{group}={option}: {group} has an option already, so leave out the plus: {group}={option}"
    return (
        f"{group} has an option already: in the defaults list of {file_of(instance, EXPERIMENTS, _chosen(overrides))}, "
        f"or of a file that it is based on, write `- override /{group}: {option}`, with the slash"
    )


def _place(instance: Hydra, name: str, missing: str, overrides: Sequence[str]) -> str:
    """The beginning of an error message for an option without a file: the chosen file whose defaults list has the option.

    It is empty where no chosen file is the cause alone, as for a misspelt option on the command line, and for an option of a
    package that is not installed, which is no mistake in a file.
    """
    from hydra.errors import HydraException, MissingConfigException
    from hydra.types import RunMode

    if missing.removesuffix(".yaml") in PLUGINS:
        return ""
    for word in overrides:
        group, _, value = word.lstrip("+").partition("=")
        option = value.strip("'\"")
        if option not in options_of(instance, group):
            continue
        try:
            instance.config_loader.compute_defaults_list(name, overrides=[word], run_mode=RunMode.RUN)
        except MissingConfigException as error:
            if error.missing_cfg_file == missing:
                return f"in the defaults list of {file_of(instance, group, option)}, or of a file that it is based on: "
        except HydraException:  # the choice needs others
            continue
    return ""


def _missing_option(instance: Hydra, missing: str, message: str) -> str:
    """The error message for an option without a file, such as ``experiment/rpi/v_lst``; names the options that exist."""
    if missing.removesuffix(".yaml") in PLUGINS:
        package = PLUGINS[missing.removesuffix(".yaml")]
        return (
            f"{missing.removesuffix('.yaml')} is a plugin that is not installed: pip install 'epo_lightning[{package}]'"
        )
    words = missing.removesuffix(".yaml").split("/")
    depth = 2 if words[0] == "hydra" else 1  # Hydra's own groups lie in a folder of this name
    group, option = "/".join(words[:depth]), "/".join(words[depth:])
    options = options_of(instance, group)
    if options and not option:
        return f"{group}= chooses nothing: {_known('', options)}"
    if not options:
        return f"unknown configuration {missing!r}: " + one_line(message)
    if option in parts(group):
        return (
            f"unknown option {group}={option}: there is a part of this name, but no file conf/{group}/{option}.yaml, which "
            f"begins with the line `name: {option}`; a folder of your own is searched with --config-dir <folder>. "
            f"{_known(option, options)}"
        )
    part, _, choice = option.rpartition("/")
    if group == "experiment" and part and (known := options_of(instance, part)):
        advice = "" if choice in known else f"; {_known(choice, known)}"
        return (
            f"unknown option {group}={option}: if it stands in the defaults list of an experiment, write "
            f"`- override /{part}: {choice}`{advice}"
        )
    if (file := Path("conf") / group / f"{option}.yaml").is_file():
        return f"unknown option {group}={option}: {file} is found with the option --config-dir conf"
    return f"unknown option {group}={option}: {_known(option, options)}"


def _known(option: str, options: Sequence[str]) -> str:
    """A hint for an option that does not exist: the nearest one, then the options of its folder or, failing that, all.

    Where options lie in folders, as the rows of all data sets do, the folders stand for them. An option without its folder
    is named in all folders that have it.
    """
    if same := [name for name in options if name.endswith(f"/{option}")]:
        return f"did you mean {', '.join(same)}?"
    folder = option.rpartition("/")[0] + "/"
    if beside := [name for name in options if name.startswith(folder)]:
        return nearest(option, beside)
    shown = {name.partition("/")[0] + "/..." if "/" in name else name for name in options}
    hint, known, _ = nearest(option, options).partition("known: ")
    return hint + known + ", ".join(sorted(shown))


def _unknown_key(instance: Hydra, name: str, key: str, overrides: Sequence[str]) -> str:
    """The error message for an unknown key: names its first unknown part, the section, and the keys of that section."""
    from hydra.types import RunMode
    from omegaconf import DictConfig

    config: Any = None
    for kept in (_groups(instance, overrides), []):
        try:
            config = instance.compose_config(
                config_name=name, overrides=kept, run_mode=RunMode.RUN, with_log_configuration=False
            )
            break
        except Exception:  # other overrides are wrong as well: try again without any, which is enough to list the keys
            continue
    whole, walked = config, list[str]()
    for word in key.replace("/", ".").split("."):
        if walked and not isinstance(config, DictConfig):
            where = ".".join(walked)
            if config is None:
                return f"unknown key {key!r}: {where} is null, so set all of it: {where}={{{word}: <value>, ...}}"
            return f"unknown key {key!r}: {where} is {config}, a value without keys: set it by {where}=<value>"
        names = [str(known) for known in config] if isinstance(config, DictConfig) else []
        if not walked and word != "hydra":
            names = [known for known in names if known != "hydra"]
        if word == "gate" and not walked and "." in key:  # the group's settings are those of the forecaster
            return f"unknown key {key!r}: with gate=<one of {', '.join(options_of(instance, word))}> it is forecaster.{key}"
        if walked == ["forecaster"] and word == "gate" and word not in names:
            choice = f"gate=<one of {', '.join(options_of(instance, word))}>"
            return f"{key} is a setting of a gate, but no gate is chosen: add {choice}, or leave it out"
        if word not in names and not walked and (options := options_of(instance, word)):
            defaults = instance.config_loader.compute_defaults_list(name, overrides=[], run_mode=RunMode.RUN)
            if word not in defaults.overrides.known_choices:
                return f"unknown key {key!r} of epo {name}: {word} is a choice of epo train, and a run keeps it"
            return f"{key} needs a choice of {word}: add {word}=<one of {', '.join(options)}>"
        below, known = key.split(".")[len(walked) + 1 :], _settings_in([*walked, word], whole)
        if word not in names and below and known and below[0] not in known:
            return f"unknown key {key!r}: {nearest(below[0], known)}"
        if word not in names and names and word in _settings_in(walked, whole):
            return f"{key} is a setting that the chosen file of {walked[0]} leaves at its default: set it by +{key}=<value>"
        if word not in names:
            level = f" in {'.'.join(walked)}" if walked else ""
            inner = [name for name in names if isinstance(_get(config, name), DictConfig) and word in config[name]]
            if len(inner) == 1:
                return f"unknown key {key!r}{level}: it is {'.'.join([*walked, inner[0], word])}"
            if not walked and word != "hydra":  # groups whose options have no section of their own, such as experiment
                defaults = instance.config_loader.compute_defaults_list(name, overrides=[], run_mode=RunMode.RUN)
                groups = {str(group).partition("/")[0] for group in defaults.overrides.known_choices}
                names = sorted({*names, *groups} - {"hydra"})
            return f"unknown key {key!r}{level}: {nearest(word, names)}"
        walked.append(word)
        config = _get(config, word)
    return f"unknown key {key!r}"


def _get(config: Any, name: str) -> Any:
    """A value of a configuration; None for one that the user has to set (``???``)."""
    from omegaconf import OmegaConf

    return None if OmegaConf.is_missing(config, name) else config[name]


def _settings_in(place: Sequence[str], config: Any) -> Collection[str]:
    """Names of the settings of a place in the configuration, of which its file need not list all; empty for other places.

    They are the arguments of the part that a section chooses, the fields of ``data.windows``, and the options of a format.
    """
    if list(place) == ["data", "windows"]:
        from epo_lightning.data.recorded.windows import WindowConfig

        return [field.name for field in dataclasses.fields(WindowConfig)]
    section = config.get(place[0]) if isinstance(config, Mapping) and place else None
    if not isinstance(section, Mapping):
        return ()
    if list(place) == ["data", "options"]:
        listing = parts("format").get(str(section.get("format")))
        return list(inspect.signature(listing).parameters)[1:] if listing else ()
    chosen = parts(place[0]).get(str(section.get("name"))) if len(place) == 1 else None
    return inspect.signature(chosen).parameters if chosen else ()


def _groups(instance: Hydra, overrides: Iterable[str]) -> list[str]:
    """Only those overrides that choose an option of a group."""
    groups = set(instance.config_loader.list_groups(""))
    return [text for text in overrides if text.split("=", 1)[0].split("@")[0].split("/")[0] in groups]


def sentence(error: BaseException) -> str:
    """An exception's message in one line, without OmegaConf's notes for programmers."""
    texts = [str(error)] + ([str(error.__cause__)] if error.__cause__ else [])
    lines = [line.strip() for text in texts for line in text.splitlines()]
    notes = ("object_type=", "reference_type=")
    kept = [line.replace("full_key:", "key:") for line in lines if line and not line.startswith(notes)]
    return "; ".join(dict.fromkeys(kept))
