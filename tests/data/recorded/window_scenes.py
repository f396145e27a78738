"""Scenes of a recording as the data module gives them."""

from __future__ import annotations

import numpy as np
import torch

from epo_lightning.data.recorded.scenes import RecordedScenes
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.data.recorded.windows import WindowConfig, extract


def tables(scenes: SceneTables) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in scenes.columns().items()}


def scenes_of(of, config=WindowConfig(), frame="fixed"):  # noqa: B008 - frozen
    found, _ = extract(of, config)
    data = RecordedScenes(tables(found), config.dt, frame, [of.name])
    return data[torch.arange(len(data))], data


def crowd(seed: int, count: int = 9):
    """Vehicles all over the road, some of which change lane."""
    random = np.random.default_rng(seed)
    return [
        (
            int(number),
            random.uniform(0, 250),
            int(random.integers(0, 2)),
            random.uniform(15, 35),
            random.uniform(0, 8) if random.uniform() < 0.3 else None,
        )
        for number in random.permutation(100)[:count]
    ]
