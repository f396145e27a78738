"""History encoders against slow reference implementations, and their treatment of gaps."""

from __future__ import annotations

import math

import pytest
import torch
from games import pad, random_scene

from epo_lightning.encoders.history import LSTMHistory, TransformerHistory, history_vectors

ENCODERS = [LSTMHistory, TransformerHistory]


@pytest.fixture
def gappy():
    """Scenes of which only some history steps were observed; one agent was seen at t0 alone, one is absent."""
    scene = random_scene(3, 4, history=8)
    scene.history_mask[..., :-1] = torch.rand(3, 4, 7) < 0.6
    scene.history_mask[1, 2, :-1] = False
    scene.agent_mask[2, 3] = False
    return scene


def test_vectors_are_those_between_observed_neighbours(gappy):
    vectors, observed = history_vectors(gappy, scale=2.0)
    for b in range(3):
        for i in range(4):
            states, seen = gappy.history[b, i, :, :2] / 2.0, gappy.history_mask[b, i]
            expected = [
                [*states[k - 1].tolist(), *states[k].tolist(), 0.1 * (k - 7)]
                for k in range(1, 8)
                if seen[k - 1] and seen[k]
            ]
            if not expected:  # one vector: its position, with a displacement of zero
                expected = [[*states[-1].tolist(), *states[-1].tolist(), 0.0]]
            if gappy.agent_mask[b, i]:
                torch.testing.assert_close(vectors[b, i, observed[b, i]], torch.tensor(expected))


def test_the_lstm_reads_observed_vectors_one_after_the_other(gappy):
    encoder = LSTMHistory(16, 2)
    features = encoder(gappy)
    vectors, observed = history_vectors(gappy)
    for b in range(3):
        for i in range(4):
            _, (hidden, _) = encoder.lstm(vectors[b, i, observed[b, i]][None])
            torch.testing.assert_close(features[b, i], hidden[-1, 0], rtol=0, atol=1e-6)


def test_the_transformer_equals_a_textbook_implementation(gappy):
    """Every token of every layer, one attention at a time, on the observed vectors alone."""
    encoder = TransformerHistory(16, 3, heads=2)
    features = encoder(gappy)
    vectors, observed = history_vectors(gappy)
    rates = [1e4 ** (-2 * index / 16) for index in range(8)]
    for b in range(3):
        for i in range(4):
            tokens = []
            for step in observed[b, i].nonzero().flatten().tolist():
                age = 6 - step
                wave = [math.sin(age * rate) for rate in rates] + [math.cos(age * rate) for rate in rates]
                tokens.append(encoder.embed(vectors[b, i, step]) + torch.tensor(wave))
            for layer in encoder.layers:
                normed = [layer.read_norm(token) for token in tokens]
                after = []
                for token, own in zip(tokens, normed, strict=True):
                    heads = []
                    for head in (slice(0, 8), slice(8, 16)):
                        query = layer.query(own)[head]
                        keys = torch.stack([layer.key_value(other)[:16][head] for other in normed])
                        values = torch.stack([layer.key_value(other)[16:][head] for other in normed])
                        heads.append((keys @ query / math.sqrt(8)).softmax(0) @ values)
                    read = token + layer.mix(torch.cat(heads))
                    after.append(read + layer.think(layer.think_norm(read)))
                tokens = after
            torch.testing.assert_close(features[b, i], encoder.norm(tokens[-1]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
def test_unobserved_steps_do_not_change_features(encoder, filling, gappy):
    encode = encoder(16, 2)
    before = encode(gappy)
    gappy.history[~gappy.history_mask] = filling
    gappy.history[2, 3] = filling
    present = gappy.agent_mask
    torch.testing.assert_close(encode(gappy)[present], before[present], rtol=0, atol=1e-6)
    after = encode(pad(gappy, agents=1, steps=3, filling=filling))
    torch.testing.assert_close(after[:, :4][present], before[present], rtol=0, atol=1e-5)
    assert after.isfinite().all()
    after.square().sum().backward()
    assert all(p.grad.isfinite().all() for p in encode.parameters())


@pytest.mark.parametrize("encoder", ENCODERS)
def test_features_depend_on_a_single_observation(encoder, gappy):
    encode = encoder(16, 2)
    before = encode(gappy)
    gappy.history[1, 2, -1, 0] += 1.0
    after = encode(gappy)
    assert (after[1, 2] - before[1, 2]).abs().max() > 1e-4
    assert torch.equal(after[0], before[0])


def test_the_transformer_depends_on_the_order_of_steps():
    """Two histories with the same moves in different order."""
    scene = random_scene(1, 2, history=3)
    scene.history[0, 0, :, 0] = torch.tensor([0.0, 1.0, 0.0])
    scene.history[0, 1, :, 0] = torch.tensor([1.0, 0.0, 1.0])
    scene.history[..., 1] = 0.0
    one, other = TransformerHistory(16, 1)(scene)[0]
    assert (one - other).abs().max() > 1e-3
