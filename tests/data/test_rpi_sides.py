"""Whether the history of a record shows the side on which the agents pass."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import load_file

from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.data.rpi.sides import shown_by_history


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    made = RPIData(root=str(tmp_path_factory.mktemp("rpi")), games=3, placements=2, seed=1)
    made.generate(workers=1, progress=False)
    return {split: load_file(made.folder / f"{split}.safetensors") for split in ("train", "val", "test")}


def test_the_history_shows_the_executed_side_of_every_record(records):
    """So the most likely mode of a forecast can be the executed one. Exchanging the modes makes both rules wrong."""
    for split in records.values():
        assert shown_by_history(split) == {"rotation": 1.0, "continuation": 1.0}
        exchanged = {**split, "states": split["states"][:, ::-1]}
        assert shown_by_history(exchanged) == {"rotation": 0.0, "continuation": 0.0}


def test_the_share_is_that_of_the_records_with_two_modes(records):
    train = records["train"]
    two = {name: values[train["modes"] == 2] for name, values in train.items()}
    assert 5 < len(two["modes"]) < len(train["modes"])
    mixed = {**two, "states": two["states"].copy()}
    mixed["states"][:5] = two["states"][:5, ::-1]
    share = 1 - 5 / len(two["modes"])
    assert shown_by_history(mixed) == pytest.approx({"rotation": share, "continuation": share})
    alone = {**two, "modes": np.ones_like(two["modes"])}
    assert all(np.isnan(value) for value in shown_by_history(alone).values())
