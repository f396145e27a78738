"""Attention in one and in two stages."""

from __future__ import annotations

import math

import pytest
import torch

from epo_lightning.encoders.interaction import Attention, TwoStageAttention


def test_attention_is_a_weighted_mean_over_present_nodes():
    attention = Attention(8)
    features, sources = torch.randn(2, 3, 8), torch.randn(2, 4, 8)
    mask = torch.tensor([[True, True, False, True], [False, False, True, False]])
    result = attention(features, sources, mask)
    for b in range(2):
        seen = sources[b, mask[b]]
        for i in range(3):
            scores = attention.key(seen) @ attention.query(features[b, i]) / math.sqrt(8)
            expected = features[b, i] + scores.softmax(0) @ attention.value(seen)
            torch.testing.assert_close(result[b, i], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("sources", [0, 4])
def test_features_without_neighbours_are_unchanged(sources):
    features = torch.randn(2, 3, 8)
    mask = torch.zeros(2, sources, dtype=torch.bool)
    assert torch.equal(Attention(8)(features, torch.randn(2, sources, 8), mask), features)


def test_the_second_stage_propagates_information_of_the_first():
    """Moving a lane changes what an agent tells the others, not only what it knows itself."""
    stages = TwoStageAttention(8)
    agents, lanes = torch.randn(1, 3, 8), torch.randn(1, 4, 8)
    present, drawn = torch.ones(1, 3, dtype=torch.bool), torch.ones(1, 4, dtype=torch.bool)
    torch.nn.init.zeros_(stages.to_lanes.query.weight)
    before = stages(agents, present, lanes, drawn)
    seen = stages.to_lanes(agents, lanes, drawn)
    torch.testing.assert_close(before, stages.to_agents(seen, seen, present))
    without = TwoStageAttention(8, map_input=False)
    without.load_state_dict({k: v for k, v in stages.state_dict().items() if k.startswith("to_agents")})
    assert torch.equal(without(agents, present, lanes, drawn), stages.to_agents(agents, agents, present))
