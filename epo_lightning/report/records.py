"""Records of a run, as a report reads them: from a run folder, or from a results file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

CONFIG, RECORD, TIME = "config.yaml", "run.json", "runtime.json"
"""Names of the files with the configuration, the record and the time of a forecast (:mod:`epo_lightning.run_folder`)."""


@runtime_checkable
class Records(Protocol):
    """Everything that a report reads of one run.

    :class:`~epo_lightning.run_folder.RunFolder` reads it from the files of a run folder,
    :class:`~epo_lightning.report.results.SavedRun` holds what was read of them.
    """

    @property
    def path(self) -> Path:
        """The run folder; for saved records, the folder that they were read from."""

    @property
    def record(self) -> dict[str, Any]:
        """The contents of run.json."""

    def config(self) -> dict[str, Any]:
        """The resolved configuration."""

    def names(self) -> list[str]:
        """Names of the files with records."""

    def content(self, name: str) -> dict[str, Any]:
        """The contents of one of the JSON files."""

    def log(self) -> list[dict[str, str]]:
        """The rows of logs/metrics.csv as text."""
