"""The scenes of a split, gathered from those of its recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from epo_lightning.data.recorded.extraction import Extracted
from epo_lightning.data.recorded.summary import by_unit, describe
from epo_lightning.data.recorded.tables import SceneTables, joined


def gather(
    names: Sequence[str],
    tables: Mapping[str, SceneTables | None],
    counts: Mapping[str, Mapping[str, int]],
    extracted: Mapping[str, Extracted],
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The scenes of a split, and a report about them."""
    total: Counter[str] = Counter()
    for name in names:
        total.update(counts[name])
    full = [found for found in (tables[name] for name in names) if found is not None]
    whole = joined(full)
    # A recording without scenes still has its place in the order of recordings.
    index = np.array([number for number, name in enumerate(names) if tables[name] is not None])
    columns = whole.columns()
    origin = np.zeros((len(names), 2))
    origin[index] = whole.origin
    columns["recording"], columns["origin"] = index[whole.recording].astype(np.int32), origin
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in columns.items()}
    about = {**by_unit(total), **describe(whole)}
    moving = sum(extracted[name].about.get("moving agents", 0) for name in names)
    if moving:
        far = sum(extracted[name].about.get("ends far from lanes", 0) for name in names) / moving
        about["moving agents that end over 10 m from all lanes given"] = far
    return tensors, about
