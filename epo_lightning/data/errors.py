"""The error for recordings that cannot be read."""

from __future__ import annotations

from pathlib import Path

from epo_lightning.registry import ConfigError


class RecordingError(ConfigError):
    """Error for a recording that cannot be read: names the file, the row or element, what was expected and the remedy."""

    def __init__(self, path: Path | str, problem: str, row: int | None = None) -> None:
        # Worker processes send exceptions pickled as class and arguments, so all arguments are passed to the base class.
        super().__init__(path, problem, row)
        self.path, self.problem, self.row = path, problem, row

    def __str__(self) -> str:
        return f"{self.path}{'' if self.row is None else f', row {self.row}'}: {self.problem}"
