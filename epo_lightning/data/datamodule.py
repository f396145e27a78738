"""Batches of scenes for Lightning: data sets that are indexed by whole batches, in a resumable order.

All records of a split stay in memory, and a batch is one ``index_select``, which is faster than worker processes. A batch
holds the scenes of an optimisation step on all devices together. The order of an epoch depends on (seed, epoch) alone: a run
that is resumed at the beginning of an epoch sees the same batches as without the interruption.

A split that may not fit in memory is read from the disk in blocks of consecutive scenes. An epoch goes through all blocks in
a random order, ``TOGETHER`` of them at a time, whose scenes are shuffled; the next ones are read in the meantime.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader
from torch.utils.data.distributed import DistributedSampler

from epo_lightning.checks import check_share
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.task import Task

OF_DATA = ("data=", "data.", "--config-dir=")
"""Beginnings of the words of a command that choose its data, after a plus."""
TOGETHER = 64
"""Number of blocks whose scenes are shuffled together."""


class SceneDataset(Protocol):
    """Interface of the scenes of a split; ``dataset[indices]`` with a LongTensor [B] is a batch of B scenes.

    A data set that may not fit in memory has an attribute ``block``, the number of consecutive scenes that are read at once,
    and a method ``read_ahead(first, last)``, which asks the system to read such scenes from the disk.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, indices: Tensor) -> Scene: ...

    def set_epoch(self, epoch: int) -> None:
        """Prepare the samples of an epoch, for data sets in which they differ between epochs."""


class Share:
    """A random share of the scenes of a data set, in their original order (``data.share``).

    The draw does not depend on the run's seed, so that every run of a table sees the same scenes.

    Args:
        whole: the data set.
        share: share of its scenes; at least one is used.
    """

    def __init__(self, whole: SceneDataset, share: float) -> None:
        count = max(1, round(share * len(whole)))
        drawn = torch.randperm(len(whole), generator=torch.Generator().manual_seed(0))
        self.whole, self.chosen = whole, drawn[:count].sort().values

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def block(self) -> int | None:
        """Number of consecutive scenes of the share that are read at once, if it may not fit in memory."""
        block = getattr(self.whole, "block", None)
        return block and max(1, round(block * len(self) / len(self.whole)))

    def read_ahead(self, first: int, last: int) -> None:
        """Ask the system to read the scenes from the position ``first`` to ``last``, inclusive, from the disk."""
        self.whole.read_ahead(int(self.chosen[first]), int(self.chosen[last]))  # type: ignore[attr-defined]

    @property
    def provenance(self) -> Any:
        """Provenance of the scenes of the underlying data set, if it has any."""
        return getattr(self.whole, "provenance", None)

    def __getitem__(self, indices: Tensor) -> Scene:
        return self.whole[self.chosen[indices]]

    def set_epoch(self, epoch: int) -> None:
        """Prepare the samples of an epoch of the whole data set."""
        self.whole.set_epoch(epoch)


class BatchSampler(DistributedSampler):
    """Index tensors of the batches of an epoch.

    Lightning calls ``set_epoch`` of a loader's sampler before each epoch; in a continued run, the number of the epoch
    continues as well. The order follows from the seed and this number. In distributed training, rank r of n takes the
    indices r, r + n, r + 2n, ... of every batch, so that all ranks together see the batch that one process would see.
    The only purpose of the base class DistributedSampler is that Lightning does not replace this sampler by its own.

    Args:
        dataset: the data set, whose ``set_epoch`` is called as well.
        batch_size: scenes per batch, of all ranks together.
        shuffle: whether the order is random; then an incomplete last batch is dropped.
        seed: seed of the random order.
    """

    def __init__(self, dataset: SceneDataset, batch_size: int, shuffle: bool, seed: int) -> None:
        super().__init__(dataset, num_replicas=1, rank=0, shuffle=shuffle, seed=seed)  # type: ignore[arg-type]
        self.scenes, self.batch_size = dataset, batch_size

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration. Validation and test are the same in every epoch."""
        if self.shuffle:
            super().set_epoch(epoch)
            self.scenes.set_epoch(epoch)

    def __iter__(self) -> Iterator[Tensor]:
        # This is a generator function, so the order is drawn when the first batch is requested. Drawn earlier, a resumed run
        # would have the order of epoch 0, because Lightning creates its iterator before it calls `set_epoch`.
        count, block = len(self.scenes), getattr(self.scenes, "block", None)
        groups: Sequence[Tensor] = ()
        if not self.shuffle:
            order = torch.arange(count)
        elif block:
            order, groups = order_in_blocks(count, block, epoch_generator(self.seed, self.epoch))
        else:
            order = torch.randperm(count, generator=epoch_generator(self.seed, self.epoch))
        together = torch.distributed.is_available() and torch.distributed.is_initialized()
        rank, world = (torch.distributed.get_rank(), torch.distributed.get_world_size()) if together else (0, 1)
        if self.shuffle:
            check_divisible(self.batch_size, world)
        batches = order.split(self.batch_size)[: len(self)]
        of_rank = (batch[rank::world] for batch in (self._reading_ahead(batches, groups) if groups else batches))
        # The last batch may have fewer scenes than there are ranks; some ranks then have none.
        yield from (indices for indices in of_rank if len(indices))

    def _reading_ahead(self, batches: Sequence[Tensor], groups: Sequence[Tensor]) -> Iterator[Tensor]:
        """The batches of an order in blocks; while a group of blocks is used, the next one is read."""
        block: int = self.scenes.block  # type: ignore[attr-defined]

        begun = 0
        for number, batch in enumerate(batches):
            used = (number + 1) * self.batch_size // (TOGETHER * block)
            for group in groups[begun : used + 2]:
                for first in (group.sort().values * block).tolist():
                    last = min(first + block, len(self.scenes)) - 1
                    self.scenes.read_ahead(first, last)  # type: ignore[attr-defined]
                begun += 1
            yield batch

    def __len__(self) -> int:
        """Batches of the epoch, the same on every rank."""
        count = len(self.scenes)
        return count // self.batch_size if self.shuffle else -(-count // self.batch_size)


def check_divisible(batch_size: int, world: int) -> None:
    """Check that all ranks have the same number of scenes, so that the mean over ranks is the mean over scenes.

    Raises:
        ConfigError: the batch cannot be divided evenly among the ranks.
    """
    if batch_size % world:
        raise ConfigError(
            f"data.batch_size is {batch_size}, which trainer.devices={world} do not divide evenly: batch_size is the number "
            "of scenes of a step on all devices together"
        )


def epoch_generator(seed: int, epoch: int) -> torch.Generator:
    """Random generator of one epoch. NumPy mixes seed and epoch into one number of 32 bits; torch uses no more bits."""
    return torch.Generator().manual_seed(int(np.random.SeedSequence([seed, epoch]).generate_state(1)[0]))


def order_in_blocks(count: int, block: int, generator: torch.Generator) -> tuple[Tensor, Sequence[Tensor]]:
    """A random order of scenes that are read in blocks of consecutive ones.

    Args:
        count: number of scenes.
        block: scenes per block.
        generator: source of the random order.

    Returns:
        the indices [count] of the scenes in order, and the numbers of the blocks in groups of ``TOGETHER``, whose scenes are
        shuffled together.
    """
    groups = torch.randperm(-(-count // block), generator=generator).split(TOGETHER)
    order = []
    for group in groups:
        scenes = (group[:, None] * block + torch.arange(block)).flatten()
        scenes = scenes[scenes < count]
        order.append(scenes[torch.randperm(len(scenes), generator=generator)])
    return torch.cat(order), groups


class SceneDataModule(LightningDataModule):
    """Loaders over the splits ``train``, ``val`` and ``test``; a subclass defines how a split is opened.

    Attributes:
        task: sizes and units of the scenes; every data module sets it, in its class or its constructor.
        share: share of the scenes of every split that is used.
        num_agents: number of agents per scene N.
        history: number of observed steps H; None if it is not known before a scene is read.
        order_seed: seed of the order of batches; the data's own seed unless a run sets its own.
        words: the words of the user's command, for error messages.
    """

    task: Task
    num_agents: int
    history: int | None = None
    words: Sequence[str] = ()

    def __init__(self, batch_size: int, seed: int, share: float = 1.0) -> None:
        super().__init__()
        check_share("data.share", share, "the share of the scenes that is used")
        if not isinstance(batch_size, int) or isinstance(batch_size, bool) or batch_size < 2:
            raise ConfigError(
                f"data.batch_size is {batch_size!r}, expected a whole number of 2 or more, for batch normalisation"
            )
        if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**31:
            raise ConfigError(f"data.seed is {seed!r}, expected a whole number from 0 to 2^31 - 1")
        self.batch_size, self.seed, self.share = batch_size, seed, share
        self.order_seed = seed
        self._opened: dict[str, SceneDataset] = {}

    def open(self, split: str) -> SceneDataset:
        """The data set of a split, read from disk."""
        raise NotImplementedError(f"{type(self).__name__} does not define how a split is opened")

    @property
    def own_words(self) -> list[str]:
        """Overrides that choose this data set."""
        return []

    @property
    def command(self) -> str:
        """The command that makes this data set, for error messages.

        It has :attr:`own_words`, or the user's for the same keys, and the user's further words about data.
        """
        given = (word for word in self.words if word.lstrip("+").startswith(OF_DATA) and "${" not in word)
        words = (*self.own_words, *given)
        by_key = {word if word.startswith("--") else word.lstrip("+").partition("=")[0]: word for word in words}
        return shlex.join(["epo", "generate", *by_key.values()])

    def setup(self, stage: str | None = None) -> None:
        """Open the splits that a stage needs. The test split is read only by the stages ``test`` and ``predict``."""
        names = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("test",)}
        for name in names.get(stage or "fit", ("train", "val")):
            if name not in self._opened:
                whole = self.open(name)
                self._opened[name] = whole if self.share == 1 else Share(whole, self.share)

    def dataset(self, split: str) -> SceneDataset:
        """The opened data set of a split.

        Raises:
            RuntimeError: the split has not been set up.
        """
        if split not in self._opened:
            raise RuntimeError(f"the split {split!r} is not open: call setup with a stage that needs it")
        return self._opened[split]

    def _loader(self, split: str, shuffle: bool) -> DataLoader:
        data = self.dataset(split)
        sampler = BatchSampler(data, self.batch_size, shuffle, self.order_seed)
        if not len(sampler):
            raise ConfigError(
                f"data.batch_size is {self.batch_size}, but the split {split!r} has only {len(data)} samples: not one full "
                "batch"
            )
        return DataLoader(data, sampler=sampler, batch_size=None, num_workers=0)  # type: ignore[arg-type]

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """Move a batch; to a GPU from pinned memory, because otherwise the host would wait until the last step has ended."""
        if device.type == "cuda" and isinstance(batch, Scene):
            # An expanded tensor has no pinned copy of its own shape.
            return batch.map(lambda tensor: tensor.contiguous().pin_memory().to(device, non_blocking=True))
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def train_dataloader(self) -> DataLoader:
        return self._loader("train", shuffle=True)

    def val_dataloader(self) -> DataLoader:
        return self._loader("val", shuffle=False)

    def test_dataloader(self) -> DataLoader:
        return self._loader("test", shuffle=False)

    def predict_dataloader(self) -> DataLoader:
        return self._loader("test", shuffle=False)
