"""A tiny data set: two agents on nearly straight lines, drawn in memory from a seed.

Run as a program it is `epo` with this part known, for tests that need a process of their own.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from lightning.pytorch import LightningDataModule

from epo_lightning.registry import register
from epo_lightning.scene import Scene
from epo_lightning.task import Task

CONF = Path(__file__).parents[1] / "configs" / "conf"


def scenes(count: int, seed: int) -> Scene:
    """Agents that drive from -1 to their goal with a constant turn rate."""
    generator = torch.Generator().manual_seed(seed)
    speed = 0.5 + torch.rand(count, 2, 1, generator=generator)
    turn = 0.2 * torch.randn(count, 2, 1, generator=generator)
    start = torch.randn(count, 2, 1, 2, generator=generator)
    time = 0.1 * torch.arange(-18, 41)
    heading = turn * time
    position = start + torch.stack([speed * time, 0.5 * speed * turn * time**2], -1)
    states = torch.cat([position, heading[..., None], speed.expand(heading.shape)[..., None]], -1)
    return Scene(
        history=states[:, :, :19].contiguous(),
        future=states[:, :, 19:].contiguous(),
        dt=0.1,
        goal_candidates=states[:, :, -1:, :2].contiguous(),
        size=torch.full((count, 2, 2), 0.5),
        subset=torch.arange(count) % 2,
        id=torch.arange(count),
    )


class _Loader:
    """Whole batches by index; a shuffled order is drawn from the global random state."""

    def __init__(self, data: Scene, batch_size: int, shuffle: bool) -> None:
        self.data, self.batch_size, self.shuffle = data, batch_size, shuffle

    def __len__(self) -> int:
        return -(-len(self.data.history) // self.batch_size)

    def __iter__(self) -> Iterator[Scene]:
        count = len(self.data.history)
        order = torch.randperm(count) if self.shuffle else torch.arange(count)
        for index in order.split(self.batch_size):
            yield self.data[index]


@register("data", "tiny")
class Tiny(LightningDataModule):
    """See the module."""

    task, num_agents = Task(horizon=40, dt=0.1, subsets=("executed", "alternative")), 2

    def __init__(self, batch_size: int = 16, count: int = 64, seed: int = 0) -> None:
        super().__init__()
        self.batch_size, self.count, self.seed = batch_size, count, seed

    @property
    def digest(self) -> str:
        return f"tiny-{self.count}-{self.seed}"

    def generate(self, workers: int | None = None, progress: bool = True) -> Path:
        return Path("memory")

    def report(self) -> dict[str, object]:
        return {"scenes": {"train": self.count}, "speed": 1.0}

    def _loader(self, offset: int, shuffle: bool = False) -> _Loader:
        return _Loader(scenes(self.count, self.seed + offset), self.batch_size, shuffle)

    def train_dataloader(self) -> _Loader:
        return self._loader(0, shuffle=True)

    def val_dataloader(self) -> _Loader:
        return self._loader(1)

    def test_dataloader(self) -> _Loader:
        return self._loader(2)


if __name__ == "__main__":
    from epo_lightning.cli import main

    main([f"--config-dir={CONF}", *sys.argv[1:]])
