"""How Hydra sees the configuration tree: options also in folders within a group, and ``sweeps/`` beside it as a group."""

from __future__ import annotations

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigLoadError, ConfigResult

GROUP = "sweeps"


class TreeSource(FileConfigSource):
    """A folder in which ``rpi/v_lstm`` is an option of ``experiment``, so that ``glob('rpi/*')`` finds it."""

    @staticmethod
    def scheme() -> str:
        return "tree"

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        found = super().list(config_path, results_filter)
        if results_filter is not ObjectType.CONFIG or not config_path:
            return found
        for folder in super().list(config_path, ObjectType.GROUP):
            found += [f"{folder}/{option}" for option in self.list(f"{config_path}/{folder}", ObjectType.CONFIG)]
        return sorted(found)


class SweepsSource(FileConfigSource):
    """The folder that holds ``sweeps/``, of which nothing else is seen.

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
