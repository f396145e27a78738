"""Sources of Hydra's configuration tree: options in folders within a group, rows on highways, and the group ``sweeps``."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigLoadError, ConfigResult
from omegaconf import Container, DictConfig, ListConfig, OmegaConf
from yaml import YAMLError

from epo_lightning.identity import leaves
from epo_lightning.registry import ConfigError, one_line

if TYPE_CHECKING:
    from hydra._internal.hydra import Hydra

GROUP = "sweeps"
HIGHWAYS = ("exid", "us101", "highway_sim", "highd", "ind", "round", "unid", "interaction", "argoverse2", "waymo")
"""Data sets with lanes, each of which has all rows of ``experiment/highway/`` under its own name."""
EXPERIMENTS = "experiment"
GLOBAL = (EXPERIMENTS, GROUP, "budget", "task", "debug")
"""Groups whose files set keys of the whole configuration, not those of a section that is named after the group."""
PLACES = ("out", "results", "resume", "run", "run_dir", "runs", "save", "sweep")
"""Keys whose values are paths. A folder of such a name, as where ``--config-dir`` is the working folder, is no group."""

_PARSED: dict[tuple[str, str, str, int], bytes] = {}
"""Parsed files, pickled, by provider, folder, name and time of the last change."""


class ParsedOnce(FileConfigSource):
    """A folder whose files are parsed once per process: composing the runs of a sweep would parse them for every run."""

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path) / self._normalize_file_name(config_path)
        if not file.is_file():
            return super().load_config(config_path)  # raises
        key = (self.provider, self.path, config_path, file.stat().st_mtime_ns)
        if key not in _PARSED:
            try:
                loaded = super().load_config(config_path)
            except (YAMLError, UnicodeDecodeError) as error:
                raise ConfigError(_where(file, error)) from error
            group = config_path.partition("/")[0]
            if group in GLOBAL and loaded.header.get("package") != "_global_":
                raise ConfigError(
                    f"{file} must begin with the line `# @package _global_`, as every file in {group}/ does "
                    "(in UTF-8 without a byte order mark)"
                )
            _check_colons(file, loaded.config)
            _PARSED[key] = pickle.dumps(loaded)
        # Hydra changes what it is given, so that every composition gets a copy.
        result: ConfigResult = pickle.loads(_PARSED[key])
        return result


def _where(file: Path, error: Exception) -> str:
    """The problem in a file of YAML, with its line."""
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    line = "" if mark is None else f":{mark.line + 1}"
    return f"{file}{line} is not YAML: {one_line(problem or error)}"


def _check_colons(file: Path, config: Container) -> None:
    """Refuse a key with a blank and without a value: ``{steps 3}`` is the key ``steps 3`` in YAML.

    Raises:
        ConfigError: the file, and what to write.
    """
    values: Any = OmegaConf.to_container(config, resolve=False)
    if not isinstance(values, dict) or not any(" " in key and value is None for key, value in leaves(values)):
        return
    nodes = [yaml.compose(file.read_text(encoding="utf-8"))]  # in which an empty value is not the word null
    while nodes:
        node = nodes.pop()
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            nodes.append(value)
            name, blank, given = str(key.value).partition(" ")
            if blank and key.style is None and value.value == "" and value.style is None:
                raise ConfigError(f"in {file}, `{name} {given}` lacks a colon: write `{name}: {given}`")


class TreeSource(ParsedOnce):
    """A folder whose subfolders' files are options of a group: Hydra's ``glob('rpi/*')`` then finds ``rpi/v_lstm``.

    ``experiment=us101/vibes`` means ``experiment=highway/vibes data=us101``; there is no file with the first name.
    """

    @staticmethod
    def scheme() -> str:
        return "tree"

    def load_config(self, config_path: str) -> ConfigResult:
        row = self._row_on_highways(config_path)
        if row is None:
            found = super().load_config(config_path)
            file = Path(self.path) / self._normalize_file_name(config_path)
            if config_path.startswith(f"{EXPERIMENTS}/"):
                _check_defaults(file, found.config)
            if config_path.startswith("data/"):
                _check_name(file, found.config)
            return found
        data, name = row
        return ConfigResult(
            config=OmegaConf.create({"defaults": [f"/experiment/highway/{name}", {"override /data": data}]}),
            path=f"{self.scheme()}://{self.path}",
            provider=self.provider,
            header={"package": "_global_"},
        )

    def is_config(self, config_path: str) -> bool:
        return super().is_config(config_path) or self._row_on_highways(config_path) is not None

    def is_group(self, config_path: str) -> bool:
        return config_path not in PLACES and (super().is_group(config_path) or self._is_highway(config_path))

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        if not super().is_group(config_path) and self._is_highway(config_path):
            config_path = f"{EXPERIMENTS}/highway"
        found = super().list(config_path, results_filter)
        if config_path == EXPERIMENTS and results_filter in (None, ObjectType.GROUP):
            found += [data for data in HIGHWAYS if self._is_highway(f"{EXPERIMENTS}/{data}")]
        if results_filter is ObjectType.CONFIG and config_path:
            for folder in self.list(config_path, ObjectType.GROUP):
                found += [f"{folder}/{option}" for option in self.list(f"{config_path}/{folder}", ObjectType.CONFIG)]
        return sorted(set(found))

    def _is_highway(self, config_path: str) -> bool:
        group, _, data = config_path.partition("/")
        return group == EXPERIMENTS and data in HIGHWAYS and super().is_group(f"{EXPERIMENTS}/highway")

    def _row_on_highways(self, config_path: str) -> tuple[str, str] | None:
        """Data set and row of an option that has no file: ``us101`` and ``vibes`` of ``experiment/us101/vibes``."""
        folder, _, name = config_path.removesuffix(".yaml").rpartition("/")
        if super().is_config(config_path) or not self._is_highway(folder):
            return None
        if not super().is_config(f"{EXPERIMENTS}/highway/{name}"):
            return None
        return folder.partition("/")[2], name


def _check_defaults(file: Path, config: Container) -> None:
    """Refuse overrides without a colon, and a row that lists itself before its base, whose settings would replace its own.

    Raises:
        ConfigError: the file, and what to change.
    """
    defaults = config.get("defaults") if isinstance(config, DictConfig) else None
    if not isinstance(defaults, ListConfig):
        return
    names: list[str] = []
    for entry in defaults:
        if isinstance(entry, str) and entry.startswith("override "):
            raise ConfigError(
                f"in the defaults list of {file}, `- {entry}` lacks a colon: write `- override /<group>: <option>`"
            )
        names += [entry] if isinstance(entry, str) else map(str, entry or ())
    later = names[len(names) - names[::-1].index("_self_") :] if "_self_" in names else []
    # Rows are named from the root of the tree or, relative to this one, without a slash.
    rows = [name for name in later if name.startswith(f"/{EXPERIMENTS}") or not name.startswith(("/", "override "))]
    if rows:
        raise ConfigError(
            f"in the defaults list of {file}, `- _self_` stands before `- {rows[0]}`, whose settings would replace those of "
            "this file: put `- _self_` last"
        )


def _check_name(file: Path, config: Container) -> None:
    """Refuse a file of recordings in a format of their own that gives them no name.

    Raises:
        ConfigError: they would have the name of the base file's recordings, in tables and in the cache.
    """
    if isinstance(config, DictConfig) and "format" in config and "dataset" not in config:
        raise ConfigError(
            f"{file} sets `format` without `dataset`, so that its recordings would be named after those of its base: add a "
            f"name of their own, such as `dataset: {file.stem}`"
        )


def recorded_name(experiment: str, data: str) -> str:
    """Name under which a run is recorded: ``us101/vibes`` for ``experiment=highway/vibes data=us101``.

    Both ways to choose a row on a data set give the same run folder; rows on different data sets have different folders.
    """
    folder, _, row = experiment.partition("/")
    return f"{data}/{row}" if folder == "highway" and data in HIGHWAYS else experiment


class SweepsSource(ParsedOnce):
    """The parent folder of ``sweeps/``, whose other contents Hydra does not see.

    Hydra takes every folder below an entry of its search path for a group. The parent of ``sweeps/`` is the root of a
    checkout, where ``runs/`` would then shadow the key ``runs`` as soon as the first run was written.
    """

    @staticmethod
    def scheme() -> str:
        return "beside"

    def available(self) -> bool:
        return self.is_group(GROUP)

    def load_config(self, config_path: str) -> ConfigResult:
        if not _ours(config_path):
            raise ConfigLoadError(f"Config not found : {config_path}")
        return super().load_config(config_path)

    def is_group(self, config_path: str) -> bool:
        return _ours(config_path) and super().is_group(config_path)

    def is_config(self, config_path: str) -> bool:
        return _ours(config_path) and super().is_config(config_path)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        if not config_path:
            return [GROUP] if results_filter in (None, ObjectType.GROUP) else []
        return super().list(config_path, results_filter) if self.is_group(config_path) else []


def _ours(config_path: str) -> bool:
    return config_path == GROUP or config_path.startswith(f"{GROUP}/")


def file_of(instance: Hydra, group: str, option: str) -> str:
    """Path of the file of an option, in the first folder of the search path that has it; its usual place if none has."""
    for source in instance.config_loader.get_sources():
        if (file := Path(source.path) / group / f"{option}.yaml").is_file():
            return str(file)
    return f"{'' if group == GROUP else 'conf/'}{group}/{option}.yaml"


def options_of(instance: Hydra, group: str) -> list[str]:
    """The options of a group, also those in folders within it: ``rpi/v_lstm`` for ``experiment``."""
    return sorted(set(instance.config_loader.get_group_options(group, ObjectType.CONFIG)))
