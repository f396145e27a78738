"""The lane encoder against VectorNet's equations, one vector at a time."""

from __future__ import annotations

import pytest
import torch
from games import random_scene

from epo_lightning.encoders.polyline import LanePolylines


def test_the_encoder_and_its_gradients_equal_vectornet():
    encoder, scene = LanePolylines(16, 3, scale=2.0), random_scene(2, 1, lanes=5)
    parameters = list(encoder.parameters())
    features = encoder(scene.lanes, scene.lane_mask)
    assert features.shape == (2, 5, 16)
    expected = []
    for b in range(2):
        for lane in range(5):
            nodes = [vector / 2.0 for vector in scene.lanes[b, lane, scene.lane_mask[b, lane]]]
            for linear, norm in zip(encoder.linears, encoder.norms, strict=True):
                encoded = [norm(linear(node)).relu() for node in nodes]
                highest = torch.stack(encoded).amax(0)
                nodes = [torch.cat((node, highest)) for node in encoded]
            expected.append(torch.stack(nodes).amax(0))  # 2 x 16, of which both halves are the same
    vectornet = torch.stack(expected).reshape(2, 5, 32)
    torch.testing.assert_close(features.repeat(1, 1, 2), vectornet, rtol=0, atol=1e-5)
    weights = torch.randn(2, 5, 16)
    gradients = torch.autograd.grad((weights * features).sum(), parameters)
    by_loops = torch.autograd.grad((weights * vectornet[..., :16]).sum(), parameters)
    torch.testing.assert_close(gradients, by_loops, rtol=1e-4, atol=1e-4)


def test_equal_vectors_share_the_gradient():
    encoder = LanePolylines(8, 2).double()
    lanes = torch.randn(1, 1, 1, 4, dtype=torch.float64).repeat(1, 1, 3, 1).requires_grad_()
    encoder(lanes, torch.ones(1, 1, 3, dtype=torch.bool)).square().sum().backward()
    torch.testing.assert_close(lanes.grad[0, 0, 0], lanes.grad[0, 0, 1], rtol=1e-12, atol=0)
    torch.testing.assert_close(lanes.grad[0, 0, 0], lanes.grad[0, 0, 2], rtol=1e-12, atol=0)


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
