"""Learning rates over a training."""

from __future__ import annotations

import pytest
import torch

from epo_lightning.optimizers import Adam
from epo_lightning.registry import ConfigError


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


def test_weights_of_all_scenes_learn_by_their_own_factor():
    """A first step of Adam has the length of the learning rate, whatever the gradient is."""
    network, shared = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    optimizer = Adam(lr=0.01, shared_factor=10).configure([network, shared], 5, shared=[shared])["optimizer"]
    for parameter in (network, shared):
        parameter.grad = torch.tensor([3.0, -1e-3])
    optimizer.step()
    torch.testing.assert_close(network.detach(), torch.tensor([-0.01, 0.01]), rtol=1e-4, atol=0)
    torch.testing.assert_close(shared.detach(), torch.tensor([-0.1, 0.1]), rtol=1e-4, atol=0)


def test_one_group_of_parameters_is_enough_without_a_factor():
    """Runs of versions without the factor can be continued."""
    network, shared = (torch.nn.Parameter(torch.zeros(1)) for _ in range(2))
    (group,) = Adam(shared_factor=1.0).configure([network, shared], 5, [shared])["optimizer"].param_groups
    assert len(group["params"]) == 2


def test_a_factor_without_shared_weights_is_refused():
    with pytest.raises(
        ConfigError, match=r"optimizer\.shared_factor=10 has no effect: .* Set it to 1, or share weights"
    ):
        Adam(shared_factor=10).configure([torch.nn.Parameter(torch.zeros(1))], 5)


def test_all_parameters_may_be_shared():
    shared = [torch.nn.Parameter(torch.zeros(1))]
    groups = Adam(lr=0.1, shared_factor=2).configure(shared, 5, shared)["optimizer"].param_groups
    assert [group["lr"] for group in groups] == [0.2]


@pytest.mark.parametrize("factor", [0, -1, float("inf")])
def test_a_factor_that_is_no_positive_number_is_refused(factor):
    with pytest.raises(ConfigError, match=r"optimizer\.shared_factor"):
        Adam(shared_factor=factor)
