"""Batch normalisation with absent agents, with a selection of the present ones and without."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from backends import HostMustNotWait

from epo_lightning.decoders import mlp
from epo_lightning.decoders.mlp import MLP


@pytest.mark.parametrize("filling", [0.0, 1e6])
@pytest.mark.parametrize("present", [0.6, 1.0])
def test_statistics_of_present_rows_need_no_selection(filling, present, monkeypatch):
    torch.manual_seed(0)
    network = MLP(5, 8, 3, norm="batch").double().train()
    state = {name: value.clone() for name, value in network.state_dict().items()}
    mask = torch.rand(6, 4) < present
    features = torch.where(mask[..., None], torch.randn(6, 4, 5, dtype=torch.float64), filling)
    found = []
    for selects in (True, False):
        monkeypatch.setattr(mlp, "readable", lambda tensor, selects=selects: selects)
        network.load_state_dict(state)
        network.zero_grad()
        given = features.clone().requires_grad_()
        with nullcontext() if selects else HostMustNotWait():
            output = network(given, mask)
        output[mask].square().sum().backward()
        gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
        statistics = [value.clone() for name, value in network.state_dict().items() if "running" in name]
        found.append([output[mask].detach(), given.grad[mask], *gradients, *statistics])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one, rtol=0, atol=1e-10)


def test_the_derivative_of_normalised_rows_is_that_of_finite_differences():
    """Also where nothing depends on the result, so that no gradient arrives."""
    rows, weight, bias = (torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in ((5, 3), (3,), (3,)))
    present = torch.tensor([True, False, True, True, False])

    def normalise(rows, weight, bias):
        return mlp._NormalisePresent.apply(rows, present, weight, bias, 1e-5)[0][present]

    assert torch.autograd.gradcheck(normalise, (rows, weight, bias))
    whole = mlp._NormalisePresent.apply(rows, present, weight, bias, 1e-5)
    gradients = torch.autograd.grad(_without_gradient(whole[0]), (rows, weight, bias), allow_unused=True)
    assert gradients == (None, None, None)


def _without_gradient(tensor):
    """A sum of the tensor whose derivative is undefined instead of zero, as a solver's of parameters that it ignores."""

    class Undefined(torch.autograd.Function):
        @staticmethod
        def forward(ctx, tensor):
            return tensor.sum()

        @staticmethod
        def backward(ctx, gradient):
            return None

    return Undefined.apply(tensor)
