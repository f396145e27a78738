"""Learning rates over a training."""

from __future__ import annotations

import pytest
import torch

from epo_lightning.optimizers import Adam


def test_the_cosine_schedule_ends_at_zero_after_all_steps():
    found = Adam(lr=0.1, schedule="cosine").configure([torch.nn.Parameter(torch.zeros(1))], total_steps=10)
    optimizer, schedule = found["optimizer"], found["lr_scheduler"]["scheduler"]
    rates = []
    for _ in range(11):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert found["lr_scheduler"]["interval"] == "step"
    assert rates[0] == pytest.approx(0.1)
    assert rates[5] == pytest.approx(0.05)
    assert rates[10] == pytest.approx(0.0, abs=1e-12)
