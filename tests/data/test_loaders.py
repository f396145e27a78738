"""Loaders: the splits that a stage opens, the order of scenes in each, and the order of an epoch."""

from __future__ import annotations

import pytest
import torch

from data.test_datamodule import order, records
from epo_lightning.data import cache
from epo_lightning.data.datamodule import Share, epoch_generator
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.registry import ConfigError


@pytest.fixture
def module(tmp_path):
    made = RPIData(root=str(tmp_path), batch_size=8, targets="executed")
    splits = {name: records(count) for name, count in (("train", 50), ("val", 21), ("test", 22))}
    cache.write(made.folder, splits, made.config, {"size": 50})
    return made


@pytest.mark.parametrize(
    ("stage", "opened"),
    [
        ("fit", {"train", "val"}),
        ("validate", {"val"}),
        ("test", {"test"}),
        ("predict", {"test"}),
        (None, {"train", "val"}),
    ],
)
def test_a_stage_opens_its_splits_and_no_other(module, stage, opened):
    for name in {"train", "val", "test"} - opened:
        (module.folder / f"{name}.safetensors").unlink()
    module.setup(stage)
    assert {len(module.dataset(name)) for name in opened} == {
        {"train": 50, "val": 21, "test": 22}[name] for name in opened
    }


def test_all_scenes_are_validated_tested_and_predicted_in_their_order(module):
    for stage, loader, count in (("validate", "val", 21), ("test", "test", 22), ("predict", "predict", 22)):
        module.setup(stage)
        batches = order(getattr(module, f"{loader}_dataloader")(), 3)
        assert [index for batch in batches for index in batch] == list(range(count))


def test_a_share_has_the_samples_of_its_epoch():
    whole = RPIDataset(records(200), "sampled", seed=3)
    share = Share(whole, 0.5)
    drawn = []
    for epoch in (0, 1, 0):
        share.set_epoch(epoch)
        drawn.append(share[torch.arange(len(share))].subset.tolist())
    assert drawn[0] == drawn[2] != drawn[1]


def test_the_order_of_an_epoch_is_what_it_was():
    """Another order would change the results of all seeds."""
    assert torch.randperm(8, generator=epoch_generator(5, 3)).tolist() == [1, 6, 3, 4, 0, 7, 5, 2]


def test_a_seed_is_a_number_of_31_bits():
    RPIData(seed=2**31 - 1)
    with pytest.raises(ConfigError, match=rf"data\.seed is {2**31}, expected a whole number from 0 to 2\^31 - 1"):
        RPIData(seed=2**31)
