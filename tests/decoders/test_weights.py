"""Decoded weights: initial values, and symmetry with respect to the order of a pair."""

from __future__ import annotations

import pytest
import torch

from epo_lightning.decoders.trajectories import Trajectories
from epo_lightning.decoders.weights import Margins, OwnWeights, PairWeights, SharedOwnWeights


def test_own_weights_start_at_their_configured_values():
    decoder = OwnWeights(8, 3, ["goal", "vel"], {"vel": 0.05}).eval()
    z, everyone = torch.randn(2, 4, 8), torch.ones(2, 4, dtype=torch.bool)
    plain = OwnWeights(8, 3, ["goal", "vel"]).eval()
    plain.load_state_dict(decoder.state_dict())
    weights, others = decoder(z, everyone), plain(z, everyone)
    assert torch.equal(weights["goal"], others["goal"])
    torch.testing.assert_close(weights["vel"], 0.05 * others["vel"])
    torch.nn.init.zeros_(decoder.mlp.output.weight)
    torch.nn.init.zeros_(decoder.mlp.output.bias)
    weights = decoder(z, everyone)
    assert (weights["goal"] == 1.0).all()
    assert (weights["vel"] == torch.tensor(0.05)).all()


def test_shared_weights_are_one_positive_number_per_feature():
    decoder = SharedOwnWeights(3, ["goal", "vel"], {"vel": 0.05})
    z, everyone = torch.randn(2, 4, 8), torch.ones(2, 4, dtype=torch.bool)
    weights = decoder(z, everyone)
    assert {name: weight.shape for name, weight in weights.items()} == dict.fromkeys(("goal", "vel"), (2, 3, 4))
    assert (weights["goal"] == 1.0).all()
    assert (weights["vel"] == torch.tensor(0.05)).all()
    sum(weight.sum() for weight in weights.values()).backward()
    torch.testing.assert_close(decoder.logarithms.grad, torch.tensor([24.0, 24.0 * 0.05]))
    with torch.no_grad():
        decoder.logarithms -= 9.0
    assert all((weight > 0).all() for weight in decoder(z, everyone).values())


@pytest.mark.parametrize("symmetric", [False, True])
def test_symmetric_pair_weights_ignore_the_order_of_agents(symmetric):
    decoder, z = PairWeights(8, 2, ["proximity"], symmetric=symmetric), torch.randn(3, 2, 8)
    weights, swapped = decoder(z)["proximity"], decoder(z.flip(1))["proximity"]
    assert torch.allclose(weights, swapped, atol=1e-6) == symmetric


@pytest.mark.parametrize("symmetric", [False, True])
def test_margins_lie_between_zero_and_the_largest(symmetric):
    decoder = Margins(8, 2, ["clearance"], largest=1.6, start=0.4, symmetric=symmetric)
    z = 100.0 * torch.randn(3, 2, 8)
    margins, swapped = decoder(z)["clearance"], decoder(z.flip(1))["clearance"]
    assert margins.shape == (3, 2, 1)
    assert ((margins > 0) & (margins < 1.6)).all()
    assert torch.allclose(margins, swapped, atol=1e-6) == symmetric
    torch.nn.init.zeros_(decoder.outputs.mlp.output.weight)
    torch.nn.init.zeros_(decoder.outputs.mlp.output.bias)
    torch.testing.assert_close(decoder(z)["clearance"], torch.full((3, 2, 1), 0.4))


def test_trajectories_are_decoded_in_units_of_the_scale():
    z, current = torch.randn(2, 3, 8), torch.zeros(2, 3, 2)
    metres, units = Trajectories(8, 2, 5), Trajectories(8, 2, 5, scale=50.0)
    units.load_state_dict(metres.state_dict())
    torch.testing.assert_close(units(z, current)[0], 50.0 * metres(z, current)[0])
    assert torch.equal(units(z, current)[1], metres(z, current)[1])
