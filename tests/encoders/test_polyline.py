"""The lane encoder against VectorNet's equations, one vector at a time."""

from __future__ import annotations

import pytest
import torch
from games import random_scene

from epo_lightning.encoders.polyline import LanePolylines


def test_the_encoder_equals_vectornet():
    encoder, scene = LanePolylines(16, 3, scale=2.0), random_scene(2, 1, lanes=5)
    features = encoder(scene.lanes, scene.lane_mask)
    assert features.shape == (2, 5, 16)
    for b in range(2):
        for lane in range(5):
            nodes = [vector / 2.0 for vector in scene.lanes[b, lane, scene.lane_mask[b, lane]]]
            for linear, norm in zip(encoder.linears, encoder.norms, strict=True):
                encoded = [norm(linear(node)).relu() for node in nodes]
                highest = torch.stack(encoded).amax(0)
                nodes = [torch.cat((node, highest)) for node in encoded]
            polyline = torch.stack(nodes).amax(0)  # 2 x 16, of which both halves are the same
            torch.testing.assert_close(features[b, lane].repeat(2), polyline, rtol=0, atol=1e-5)


@pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
def test_absent_vectors_do_not_change_features(filling):
    encoder, scene = LanePolylines(16, 3), random_scene(3, 1, lanes=6)
    scene.lane_mask[0, 2] = False
    scene.lane_mask[1, :, 0] = False
    exists = scene.lane_mask.any(-1)
    before = encoder(scene.lanes, scene.lane_mask)[exists]
    before.square().sum().backward()
    gradients = [p.grad.clone() for p in encoder.parameters()]
    encoder.zero_grad()
    lanes = torch.where(scene.lane_mask[..., None], scene.lanes, filling)
    after = encoder(lanes, scene.lane_mask)
    assert after.isfinite().all()
    torch.testing.assert_close(after[exists], before, rtol=0, atol=1e-6)
    after[exists].square().sum().backward()
    torch.testing.assert_close([p.grad for p in encoder.parameters()], gradients, rtol=1e-4, atol=1e-5)
