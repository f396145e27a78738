"""Records as scenes, and the data module ``rpi``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from epo_lightning.data import cache
from epo_lightning.data.cache import SPLITS
from epo_lightning.data.datamodule import SceneDataModule, SceneDataset, epoch_generator
from epo_lightning.data.rpi.splits import RULES
from epo_lightning.registry import ConfigError, nearest, register
from epo_lightning.scene import Scene
from epo_lightning.task import Task

TARGETS = ("executed", "sampled", "both")
SOLVERS = ("potential", "feedback")
SUBSETS = ("executed", "alternative")
DISC_DIAMETER = 0.5
"""Length and width [m] of an agent: a disc of radius 0.25 m."""


class RPIDataset:
    """Scenes of one split.

    A record holds one history and one or two modes; ``targets`` says which of them are futures to learn:
    ``executed`` (the mode that the agents followed), ``both`` (a sample per mode) or ``sampled`` (one of the record's
    modes, drawn anew from (seed, epoch, index) each epoch).

    Args:
        records: ``history`` [R, 2, 19, 4], ``goals`` [R, 2, 2], ``states`` [R, 2 modes, 2, 40, 4] and ``modes`` [R].
        targets: see above.
        seed: of the draws.
    """

    def __init__(self, records: Mapping[str, Tensor], targets: str = "both", seed: int = 0) -> None:
        self.history, self.goals = records["history"].float(), records["goals"].float()
        self.futures, self.modes = records["states"].float(), records["modes"]
        self.targets, self.seed = targets, seed
        count = len(self.history)
        self.record, self.mode = torch.arange(count), torch.zeros(count, dtype=torch.long)
        if targets == "both":
            self.record = torch.repeat_interleave(self.record, self.modes)
            self.mode = torch.zeros_like(self.record)
            self.mode[1:] = (self.record[1:] == self.record[:-1]).long()
        self.set_epoch(0)

    def set_epoch(self, epoch: int) -> None:
        """Draw the modes of an epoch."""
        if self.targets == "sampled":
            draw = torch.rand(len(self.history), generator=epoch_generator(self.seed, epoch))
            self.mode = (draw * self.modes).long()

    def __len__(self) -> int:
        return len(self.record)

    def __getitem__(self, indices: Tensor) -> Scene:
        record, mode = self.record[indices], self.mode[indices]
        history = self.history[record]
        return Scene(
            history=history,
            dt=RPIData.task.dt,
            future=self.futures[record, mode],
            goal_candidates=self.goals[record].unsqueeze(2),
            size=history.new_full((*history.shape[:2], 2), DISC_DIAMETER),
            subset=mode,
            id=record,
        )


def _whole(name: str, value: Any, least: int, why: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ConfigError(f"data.{name} is {value!r}, expected a whole number of at least {least}: {why}")
    return value


def _one_of(name: str, value: Any, known: Sequence[str]) -> str:
    if value not in known:
        raise ConfigError(f"unknown data.{name} {value!r}: {nearest(str(value), known)}")
    return value


@register("data", "rpi")
class RPIData(SceneDataModule):
    """The robot-pedestrian interaction data: generated once by ``epo generate``, then read from the cache.

    Args:
        root: folder of the cache; None for $EPO_CACHE or ``cache``.
        seed: of the games, and of the batches' order where a run sets no other.
        games: main games; one draw of w each. A tenth each, at least one, becomes validation and test.
        placements: starts of the pedestrian per main game.
        solver: ``potential`` (open-loop Nash) or ``feedback`` (iterative LQ game).
        split: ``paper`` (unseen games) or ``hard`` (unseen w and directions).
        sizes: most records of training, validation and test; None for all.
        targets: ``both``, ``executed`` or ``sampled``; see :class:`RPIDataset`.
        batch_size: scenes per batch.
        share: of the scenes of every split that is used, drawn once.
    """

    task = Task(horizon=40, dt=0.1, subsets=SUBSETS)
    num_agents = 2

    def __init__(
        self,
        root: str | None = None,
        seed: int = 0,
        games: int = 20,
        placements: int = 39,
        solver: str = "potential",
        split: str = "paper",
        sizes: Sequence[int] | None = (47822, 6228, 6228),
        targets: str = "both",
        batch_size: int = 32,
        share: float = 1.0,
    ) -> None:
        super().__init__(batch_size, seed, share)
        self.root = Path(root).expanduser() if root else cache.default_root()
        self.games = _whole("games", games, 3, "training, validation and test need main games of their own")
        self.placements = _whole("placements", placements, 1, "the pedestrian must start somewhere")
        self.solver = _one_of("solver", solver, SOLVERS)
        self.split = _one_of("split", split, RULES)
        self.targets = _one_of("targets", targets, TARGETS)
        if sizes is not None and (isinstance(sizes, str) or len(sizes) != len(SPLITS)):
            raise ConfigError(f"data.sizes is {sizes!r}, expected three numbers ({', '.join(SPLITS)}) or null for all")
        why = "an empty split is of no use"
        self.sizes = None if sizes is None else [_whole("sizes", size, 1, why) for size in sizes]

    @property
    def config(self) -> dict[str, Any]:
        """Everything that the set on disk depends on."""
        from epo_lightning.data.rpi.generate import pool_config, set_config

        return set_config(pool_config(self.seed, self.games, self.placements, self.solver), self.split, self.sizes)

    @property
    def folder(self) -> Path:
        """Where the set lies, or will lie."""
        from epo_lightning.data.rpi.generate import set_folder

        return set_folder(self.root, self.config)

    @property
    def digest(self) -> str:
        """Hash of everything that a run's data depends on: the set and which of its modes are learned."""
        return cache.digest({"set": self.config, "targets": self.targets})[:16]

    @property
    def command(self) -> str:
        """The command that makes this set, for error messages."""
        defaults = {"seed": 0, "games": 20, "placements": 39, "solver": "potential", "split": "paper"}
        words = [
            f"data.{name}={getattr(self, name)}" for name, value in defaults.items() if getattr(self, name) != value
        ]
        if self.sizes != [47822, 6228, 6228]:
            words.append("data.sizes=" + ("null" if self.sizes is None else "[" + ",".join(map(str, self.sizes)) + "]"))
        if self.root != cache.default_root():
            words.append(f"data.root={self.root}")
        return " ".join(["epo generate data=rpi", *words])

    def generate(self, workers: int | None = None, progress: bool = True) -> Path:
        """Make the set unless it is there already, and return its folder.

        Args:
            workers: processes; None for one per core. The bytes do not depend on it.
            progress: whether to show a progress bar.

        Raises:
            cache.CacheError: the folder holds something broken, or a worker was killed.
        """
        from epo_lightning.data.rpi.generate import make_set

        if workers is not None:
            _whole("workers", workers, 1, "somebody has to solve the games")
        return make_set(self.root, self.config["pool"], self.split, self.sizes, workers, progress, self.command)

    def report(self) -> dict[str, Any]:
        """The report that the set was made with.

        Raises:
            cache.CacheError: the set is missing or broken.
        """
        return cache.manifest(self.folder, self.command, self.config)["report"]

    def open(self, split: str) -> SceneDataset:
        """The scenes of a split.

        Raises:
            cache.CacheError: the set is missing, broken, of another format, or holds numbers that are not finite.
        """
        records = cache.load(self.folder, split, ("history", "goals", "states", "modes"), self.command, self.config)
        return RPIDataset(records, self.targets, self.seed)
