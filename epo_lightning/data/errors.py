"""What is wrong with a recording."""

from __future__ import annotations

from pathlib import Path

from epo_lightning.registry import ConfigError


class RecordingError(ConfigError):
    """A recording that cannot be read: the message names the file, the row or element, what was expected and what to do."""

    def __init__(self, path: Path | str, problem: str, row: int | None = None) -> None:
        super().__init__(f"{path}{'' if row is None else f', row {row}'}: {problem}")
