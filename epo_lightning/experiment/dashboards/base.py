"""Interface of a dashboard, and the facts that it gets about a run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from epo_lightning.identity import leaves

Row = tuple[int, Mapping[str, float]]
"""An optimisation step and the metrics logged at it."""
ARTIFACTS = ("config.yaml", "run.json", "checkpoints/best.ckpt")
"""Files that are sent to a dashboard that keeps files."""


@dataclass(frozen=True)
class Facts:
    """Name, identity and configuration of a run.

    Args:
        id: unique identifier of the run, the same in all processes that work on it.
        name: title and seed, for display.
        group: label of the sweep that the run belongs to; None without a sweep.
        config: the resolved configuration without folders and machine settings.
        tags: identity, data_digest and commit.
        folder: the run folder.
    """

    id: str
    name: str
    group: str | None
    config: Mapping[str, Any]
    tags: Mapping[str, str]
    folder: Path

    def parameters(self) -> dict[str, Any]:
        """The configuration with one dotted name per value."""
        return dict(leaves(self.config))


@dataclass(frozen=True)
class Ending:
    """End of a run: its scores, its pictures, and whether it failed."""

    failed: bool = False
    summary: Mapping[str, float] = field(default_factory=dict)
    pictures: Sequence[Path] = ()


class Dashboard(ABC):
    """The interface of a dashboard for one run. Its methods may raise and be slow: they are called in a separate thread."""

    label: ClassVar[str]
    every: ClassVar[float] = 0.0
    """Seconds during which rows are collected before they are sent together; positive for dashboards with slow requests."""

    def __init__(self, facts: Facts) -> None:
        self.facts = facts

    @abstractmethod
    def open(self) -> None:
        """Begin the run, or continue it where another process stopped."""

    @abstractmethod
    def log(self, rows: Sequence[Row]) -> None:
        """Add rows. For a continued run, the dashboard may have the first rows already."""

    @abstractmethod
    def close(self, ending: Ending) -> None:
        """Send how the run ended, and wait until the dashboard has received everything."""
