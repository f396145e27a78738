"""Settings of files that have no effect, because the file of the budget is read later and replaces them."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from epo_lightning.experiment.config.settings import CallbackSettings, TrainerSettings
from epo_lightning.experiment.config.sources import EXPERIMENTS, GROUP, file_of
from epo_lightning.identity import leaves
from epo_lightning.registry import ConfigError, parts
from epo_lightning.report.labels import value_text
from epo_lightning.report.labels import word as override

SECTIONS = ("data", "optimizer", "trainer", "callbacks")
"""Groups with settings that budgets set as well. Their files name every setting, most of them with its default value."""


def refuse_replaced(values: Mapping[str, Any], overrides: Iterable[str], found: Sequence[Replaced]) -> None:
    """Refuse settings of a file that have no effect, because the budget's file replaces them.

    Default values in the files of :data:`SECTIONS` are not refused: the user has not chosen them.

    Args:
        values: the resolved configuration.
        overrides: all overrides, and the keys of a sweep's file; such a key does not depend on the two files.
        found: settings of files to which the budget's file gives another value.

    Raises:
        ConfigError: the keys and values of both files, and where such a setting can stand.
    """
    final = dict(leaves(values))
    given = keys_of(overrides)
    without_effect = [one for one in found if one.key not in given and final.get(one.key) == one.by]
    chosen = [one for one in without_effect if one.group == EXPERIMENTS or one.value != _default(values, one.key)]
    if chosen:
        lost = [one for one in chosen if one.file == chosen[0].file]
        own = [f"{one.key}: {value_text(one.value)}" for one in lost]
        others = [f"{one.key}: {value_text(one.by)}" for one in lost]
        raise ConfigError(
            f"{lost[0].file} sets {', '.join(own)} without effect: the budget's file {lost[0].budget} is read later and "
            f"sets {', '.join(others)}; with this budget, move such settings to the command line "
            f"({' '.join(override(one.key, one.value) for one in lost)}), to the file of a sweep, or to a budget of your own"
        )


def keys_of(overrides: Iterable[str]) -> set[str]:
    """The keys that overrides set: ``data.folder`` of ``data.folder=data/us101``."""
    return {word.lstrip("+~").partition("=")[0] for word in overrides}


def _default(values: Mapping[str, Any], key: str) -> Any:
    """The default value of a setting of a section, which the constructor of its part has; empty if it has none."""
    section, _, name = key.partition(".")
    schemas: dict[str, Any] = {"trainer": TrainerSettings, "callbacks": CallbackSettings}
    part = schemas.get(section) or parts(section).get(str(values[section].get("name")))
    known = inspect.signature(part).parameters if part else {}
    return known[name].default if name in known else inspect.Parameter.empty


def keys_of_sweep(name: str | None) -> list[str]:
    """The keys that the file of a sweep sets; none without a sweep."""
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    loader: Any = GlobalHydra.instance().config_loader()
    loaded = loader.repository.load_config(f"{GROUP}/{name}") if name else None
    settings: Any = OmegaConf.to_container(loaded.config, resolve=False) if loaded else {}
    return [key for key, _ in leaves(settings)]


class Replaced(NamedTuple):
    """A setting of a file in the group of experiments or in one of :data:`SECTIONS`, and the value that the budget gives."""

    key: str
    value: Any
    group: str
    file: str
    by: Any
    budget: str


@cache
def replaced(words: tuple[str, ...], search_path: tuple[str, ...]) -> list[Replaced]:
    """The settings of the chosen files, and of those that they are based on, to which the budget gives another value.

    Args:
        words: overrides that choose the experiment, the options of :data:`SECTIONS` and the budget.
        search_path: the folders that are searched for files.
    """
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from hydra.types import RunMode
    from omegaconf import OmegaConf

    instance = GlobalHydra.instance().hydra
    assert instance is not None
    loader: Any = instance.config_loader
    try:
        entries = loader.compute_defaults_list("train", list(words), RunMode.RUN).defaults
    except HydraException:  # the files need other overrides of the run
        return []
    own: dict[str, tuple[Any, str, str]] = {}
    budget: dict[str, tuple[Any, str]] = {}
    for entry in entries:
        group, _, option = str(entry.config_path).partition("/")
        known = group in (EXPERIMENTS, *SECTIONS, "budget")
        if known and (loaded := loader.repository.load_config(f"{group}/{option}")):
            settings: Any = OmegaConf.to_container(loaded.config, resolve=False)
            file = file_of(instance, group, option)
            for key, value in leaves(settings, f"{entry.package}." if entry.package else ""):
                if group == "budget":
                    budget[key] = value, file
                else:
                    own.pop(key, None)  # in the order of the files that decide
                    own[key] = value, group, file
    return [Replaced(key, *own[key], *budget[key]) for key in own if key in budget and own[key][0] != budget[key][0]]
