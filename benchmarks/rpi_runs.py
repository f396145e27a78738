"""Forecasts of trained runs for the records of RPI, whose equilibria and true weights are known.

Runs whose network was told the weight (:mod:`benchmarks.hidden_weight`) are read as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from benchmarks.hidden_weight import TOLD
from benchmarks.runs import opened
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.data.rpi.subgames import FUTURE
from epo_lightning.experiment.opening import open_data
from epo_lightning.registry import ConfigError

BATCH = 1024
"""Records per batch; it changes no result."""


@dataclass(frozen=True)
class Forecasts:
    """Forecasts of one run for all records of a split, as positions [m].

    Attributes:
        modes: joint modes of the forecast.
        futures: executed and alternative future; zeros for a record without an alternative.
        both: whether a record has both futures.
        start: positions at t0.
        weight: true weight w of the interaction in the record's game.
        placement: index of the pedestrian's placement in the record's game.
        placements: number of placements of every game.
    """

    modes: Float[Tensor, "B M N K 2"]
    futures: Float[Tensor, "B 2 N K 2"]
    both: Bool[Tensor, " B"]
    start: Float[Tensor, "B N 2"]
    weight: Float[Tensor, " B"]
    placement: Int[Tensor, " B"]
    placements: int

    def missed(self, side: int) -> Float[Tensor, "B N 2"]:
        """Displacements [m] of the last positions of the closest joint mode from the executed (0) or alternative (1) future.

        The closest mode is that of SFDE. Rows of records without an alternative mean nothing for side 1.
        """
        of_modes = self.modes[:, :, :, -1] - self.futures[:, None, side, :, -1]
        closest = of_modes.norm(dim=-1).mean(2).argmin(1)
        return of_modes[torch.arange(len(closest)), closest]

    def having(self, side: int) -> Bool[Tensor, " B"]:
        """Mask of the records that have the executed (0) or alternative (1) future."""
        return self.both if side else torch.ones_like(self.both)


def drawn(scenes: RPIDataset, count: int) -> Int[Tensor, " rows"]:
    """Rows of random records with their executed futures, in the same order on every machine; fewer if there are fewer."""
    executed = scenes.executed
    return executed[torch.randperm(len(executed), generator=torch.Generator().manual_seed(0))[:count]]


@torch.no_grad()
def forecasts(folder: str, split: str = "test") -> Forecasts:
    """The forecasts of a finished run for a split of its data.

    Raises:
        ConfigError: no finished run on RPI, one whose targets are sampled, or its data is missing or has changed.
    """
    run, settings, forecaster = opened(folder)
    if settings.data["name"] not in ("rpi", TOLD):
        raise ConfigError(f"{folder} was trained on data={settings.data['name']}, but only RPI has known equilibria")
    if settings.data.get("targets") == "sampled":
        raise ConfigError(
            f"{folder} has data.targets=sampled, which keeps one future of every record; "
            "choose a run with data.targets=both or executed"
        )
    data = open_data(run, settings)
    assert isinstance(data, RPIData)
    scenes, records = data.open(split), data.records(split)
    scene = scenes[scenes.executed]
    chunks = torch.arange(len(scene.history)).split(BATCH)
    return Forecasts(
        modes=torch.cat([forecaster.predict(scene[chunk]).states[..., :2] for chunk in chunks]),
        futures=records["states"][scene.id][:, :, :, :FUTURE, :2].float(),
        both=records["modes"][scene.id] == 2,
        start=scene.current[..., :2],
        weight=records["weight"][scene.id],
        placement=records["placement"][scene.id],
        placements=data.placements,
    )
