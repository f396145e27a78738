"""Scenes from RPI records, and the data module ``rpi``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Integer
from torch import Tensor

from epo_lightning.checks import check_choice, check_share, check_whole
from epo_lightning.data import cache
from epo_lightning.data.cache import SPLITS
from epo_lightning.data.datamodule import SceneDataModule, epoch_generator
from epo_lightning.data.rpi.game import AGENTS, DISC_DIAMETER, FUTURE, HISTORY, RECIPE, GameConstants
from epo_lightning.data.rpi.splits import PAPER_SIZES, RULES
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene
from epo_lightning.task import Task

TARGETS = ("executed", "sampled", "both")
SOLVERS = ("potential", "feedback", "feedback_converged")
SUBSETS = ("executed", "alternative")


class RPIDataset:
    """Scenes of one split, indexed by whole batches.

    A record has one history and one or two modes: the executed one and, if it exists, the alternative one. ``targets``
    selects the futures to learn: ``executed`` (the mode that the agents followed), ``both`` (one sample per mode) or
    ``sampled`` (one of the record's modes, drawn in every epoch from (seed, epoch, index)).

    Args:
        records: R records: ``history`` [R, 2, 19, 4], ``goals`` [R, 2, 2], ``goal_headings`` [R, 2],
            ``states`` [R, 2 modes, 2, 40, 4], ``modes`` [R], the number of modes of a record, ``game_steps`` [R], the steps
            from t0 to the end of the game, and, if they are only a part of the data set, ``id`` [R], their numbers in it.
        targets: ``executed``, ``both`` or ``sampled``.
        seed: seed of the random modes of ``sampled``.
    """

    def __init__(self, records: Mapping[str, Tensor], targets: str = "both", seed: int = 0) -> None:
        self.history, self.goals = records["history"].float(), records["goals"].float()
        self.futures, self.modes = records["states"].float(), records["modes"]
        self.goal_headings, self.game_steps = records["goal_headings"].float(), records["game_steps"]
        self.targets, self.seed = targets, seed
        count = len(self.history)
        self.ids = records.get("id", torch.arange(count))
        self.record, self.mode = torch.arange(count), torch.zeros(count, dtype=torch.long)
        if targets == "both":
            self.record = torch.repeat_interleave(self.record, self.modes)
            self.mode = torch.zeros_like(self.record)
            self.mode[1:] = (self.record[1:] == self.record[:-1]).long()
        self.set_epoch(0)

    def set_epoch(self, epoch: int) -> None:
        """Draw the modes of an epoch, if targets are sampled."""
        if self.targets == "sampled":
            draw = torch.rand(len(self.history), generator=epoch_generator(self.seed, epoch))
            self.mode = (draw * self.modes).long()

    def __len__(self) -> int:
        return len(self.record)

    @property
    def executed(self) -> Integer[Tensor, " rows"]:
        """Rows of the scenes with executed futures: one of every record, unless targets are sampled."""
        return (self.mode == 0).nonzero().flatten()

    def __getitem__(self, indices: Tensor) -> Scene:
        record, mode = self.record[indices], self.mode[indices]
        history = self.history[record]
        return Scene(
            history=history,
            dt=RPIData.task.dt,
            future=self.futures[record, mode],
            goal_candidates=self.goals[record].unsqueeze(2),
            goal_headings=self.goal_headings[record].unsqueeze(2),
            size=history.new_full((*history.shape[:2], 2), DISC_DIAMETER),
            subset=mode,
            id=self.ids[record],
            game_steps=self.game_steps[record],
        )


def in_share(game: Integer[Tensor, "records 2"], share: float) -> Bool[Tensor, " records"]:
    """Records of a share of the games, at least one, in an order of the games that is drawn once for every share."""
    games, of_record = game.unique(dim=0, return_inverse=True)
    drawn = torch.randperm(len(games), generator=torch.Generator().manual_seed(0))
    return torch.isin(of_record, drawn[: max(1, round(share * len(games)))])


@register("data", "rpi")
class RPIData(SceneDataModule):
    """The robot-pedestrian interaction data: generated once by ``epo generate``, then read from the cache.

    Args:
        root: folder of the cache; None for $EPO_CACHE or ``cache``.
        seed: seed of the games, and of the order of batches unless a run sets its own.
        games: number of main games, each with its own w. A tenth of them (at least one) is for validation, and another
            tenth for testing.
        placements: start positions of the pedestrian per main game.
        solver: ``potential`` (open-loop Nash equilibrium), ``feedback`` (iterative LQ game) or ``feedback_converged`` (the
            same, iterated until a step changes less than 1 mm).
        split: ``paper`` (unseen games) or ``hard`` (unseen w and directions).
        sizes: largest numbers of records of training, validation and test; None for all.
        targets: ``both``, ``executed`` or ``sampled``; see :class:`RPIDataset`.
        batch_size: scenes per batch.
        share: share of the scenes of every split that is used, drawn once.
        games_share: share of the training split's games that is used, drawn once; a game is a start of the pedestrian in a
            main game. Smaller shares are contained in larger ones; validation and test stay whole.
        recipe: version of the method, 2; or 1, in which the angle of the first placement is a function of w. The default is
            that of runs that were trained before this was a setting; ``conf/data/rpi.yaml`` has 2.
    """

    num_agents, history = AGENTS, HISTORY + 1
    task = Task(horizon=FUTURE, dt=GameConstants.dt, subsets=SUBSETS, history=history)

    def __init__(
        self,
        root: str | None = None,
        seed: int = 0,
        games: int = 20,
        placements: int = 39,
        solver: str = "potential",
        split: str = "paper",
        sizes: Sequence[int] | None = PAPER_SIZES,
        targets: str = "both",
        batch_size: int = 32,
        share: float = 1.0,
        games_share: float = 1.0,
        recipe: int = 1,
    ) -> None:
        super().__init__(batch_size, seed, share)
        check_whole("data.recipe", recipe)
        if recipe > RECIPE:
            raise ConfigError(f"data.recipe is {recipe}, expected {RECIPE}, or 1 for data of earlier versions")
        self.recipe = recipe
        check_share("data.games_share", games_share, "the share of the training games")
        self.games_share = games_share
        self.root = Path(root).expanduser() if root else cache.default_root()
        check_whole("data.games", games, least=3)  # training, validation and test have main games of their own
        check_whole("data.placements", placements)
        self.games, self.placements = games, placements
        check_choice("data.solver", solver, SOLVERS)
        check_choice("data.split", split, RULES)
        check_choice("data.targets", targets, TARGETS)
        self.solver, self.split, self.targets = solver, split, targets
        if sizes is not None and (
            isinstance(sizes, str) or not isinstance(sizes, Sequence) or len(sizes) != len(SPLITS)
        ):
            raise ConfigError(f"data.sizes is {sizes!r}, expected three numbers ({', '.join(SPLITS)}) or null for all")
        for size in sizes or ():
            check_whole("data.sizes", size)
        self.sizes = None if sizes is None else list(sizes)

    @property
    def config(self) -> dict[str, Any]:
        """Configuration of the data set: all values that its files depend on."""
        from epo_lightning.data.rpi.generate import pool_config

        pool = pool_config(self.seed, self.games, self.placements, self.solver, self.recipe)
        return {"pool": pool, "split": self.split, "sizes": self.sizes}

    @property
    def folder(self) -> Path:
        """Folder of the data set, whether or not it exists."""
        return self.root / f"rpi-{cache.digest(self.config)[:12]}"

    @property
    def digest(self) -> str:
        """Hash of the data set and the selection of its games and modes."""
        few = {} if self.games_share == 1 else {"games_share": self.games_share}
        return cache.digest({"set": self.config, "targets": self.targets, **few})[:16]

    @property
    def own_words(self) -> list[str]:
        """Overrides that choose this data set."""
        defaults = {
            "recipe": RECIPE,
            "seed": 0,
            "games": 20,
            "placements": 39,
            "solver": "potential",
            "split": "paper",
        }
        words = [
            f"data.{name}={getattr(self, name)}" for name, value in defaults.items() if getattr(self, name) != value
        ]
        if self.sizes != list(PAPER_SIZES):
            words.append("data.sizes=" + ("null" if self.sizes is None else "[" + ",".join(map(str, self.sizes)) + "]"))
        if self.root != cache.default_root():
            words.append(f"data.root={self.root}")
        return ["data=rpi", *words]

    def generate(self, workers: int | None = None, progress: bool = True) -> Path:
        """Make the data set unless it exists already, and return its folder.

        Args:
            workers: processes; None for one per core. The bytes do not depend on it.
            progress: whether to report progress.

        Raises:
            cache.CacheError: the data set is broken or of another configuration, or a worker was killed.
            OSError: the disk is full or read-only.
        """
        from epo_lightning.data.rpi.generate import make_set

        if workers is not None:
            check_whole("workers", workers)
        return make_set(self.folder, self.config, workers, progress, self.command)

    def report(self) -> dict[str, Any]:
        """The report that was written with the data set.

        Raises:
            cache.CacheError: the data set is missing, broken or of another configuration.
        """
        return cache.manifest(self.folder, self.command, self.config)["report"]

    def summary(self) -> list[str]:
        """Lines on what was made, for the terminal.

        Raises:
            cache.CacheError: as :meth:`report`.
        """
        from epo_lightning.data.rpi.report import summary

        return [*summary(self.report()), f"  all statistics: {self.folder / cache.MANIFEST}"]

    def open(self, split: str) -> RPIDataset:
        """The scenes of a split.

        Raises:
            cache.CacheError: the data set is missing, broken, of another configuration, or holds numbers that are not
                finite.
        """
        few = split == "train" and self.games_share < 1
        names = ("history", "goals", "states", "modes", "phi", "step", *(("game", "placement") if few else ()))
        records = cache.load(self.folder, split, names, self.command, self.config)
        if few:
            chosen = in_share(torch.stack((records["game"], records["placement"]), -1), self.games_share)
            records = {name: column[chosen] for name, column in records.items()}
            records["id"] = chosen.nonzero()[:, 0]
        # Robot and pedestrian want to arrive with the headings with which they start, 0 and phi (`game.py`); `step` is the
        # step of the main game at t0.
        phi = records["phi"]
        records["goal_headings"] = torch.stack((torch.zeros_like(phi), phi), -1)
        records["game_steps"] = GameConstants().steps - records["step"]
        return RPIDataset(records, self.targets, self.seed)

    def records(self, split: str) -> dict[str, Tensor]:
        """The records of a split [R, ...] with their modes, and the weight w and the placement of their game.

        ``Scene.id`` holds indices of records.

        Raises:
            cache.CacheError: as :meth:`open`.
        """
        return cache.load(self.folder, split, ("states", "modes", "weight", "placement"), self.command, self.config)
