"""Settings of an experiment's file that have no effect, because the file of the budget is read later and replaces them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from epo_lightning.experiment.config.sources import EXPERIMENTS, GROUP, file_of
from epo_lightning.identity import leaves
from epo_lightning.registry import ConfigError
from epo_lightning.report.labels import value_text
from epo_lightning.report.labels import word as override


def refuse_replaced(values: Mapping[str, Any], overrides: Iterable[str], found: Sequence[Replaced]) -> None:
    """Refuse settings of the experiment's file that have no effect, because the budget's file replaces them.

    Args:
        values: the resolved configuration.
        overrides: all overrides, and the keys of a sweep's file; such a key does not depend on the two files.
        found: settings of the experiment's file to which the budget's file gives another value.

    Raises:
        ConfigError: the keys and values of both files, and where such a setting can stand.
    """
    final = dict(leaves(values))
    given = {word.lstrip("+~").partition("=")[0] for word in overrides}
    lost = [one for one in found if one.key not in given and final.get(one.key) == one.by]
    if lost:
        own = [f"{one.key}: {value_text(one.value)}" for one in lost]
        others = [f"{one.key}: {value_text(one.by)}" for one in lost]
        raise ConfigError(
            f"{lost[0].file} sets {', '.join(own)} without effect: the budget's file {lost[0].budget} is read later and "
            f"sets {', '.join(others)}; with this budget, move such settings to the command line "
            f"({' '.join(override(one.key, one.value) for one in lost)}), to the file of a sweep, or to a budget of your own"
        )


def keys_of_sweep(name: str | None) -> list[str]:
    """The keys that the file of a sweep sets; none without a sweep."""
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    loader: Any = GlobalHydra.instance().config_loader()
    loaded = loader.repository.load_config(f"{GROUP}/{name}") if name else None
    settings: Any = OmegaConf.to_container(loaded.config, resolve=False) if loaded else {}
    return [key for key, _ in leaves(settings)]


class Replaced(NamedTuple):
    """A setting of the file of an experiment to which the budget's file gives another value."""

    key: str
    value: Any
    file: str
    by: Any
    budget: str


@cache
def replaced(words: tuple[str, ...], search_path: tuple[str, ...]) -> list[Replaced]:
    """The settings of an experiment's file, and of the files it is based on, to which the budget gives another value."""
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
    found: dict[str, dict[str, tuple[Any, str]]] = {EXPERIMENTS: {}, "budget": {}}
    for group, _, option in (str(entry.config_path).partition("/") for entry in entries):
        loaded = loader.repository.load_config(f"{group}/{option}") if group in found else None
        if loaded is not None:
            settings: Any = OmegaConf.to_container(loaded.config, resolve=False)
            file = file_of(instance, group, option)
            found[group].update({key: (value, file) for key, value in leaves(settings)})
    own, budget = found.values()
    return [Replaced(key, *own[key], *budget[key]) for key in own if key in budget and own[key][0] != budget[key][0]]
