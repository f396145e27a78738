"""Frames: forecasts are equivariant to motions of the world, from extraction to the recording's coordinates."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data.recorded.roads import FOUR, curve, recording
from data.recorded.test_windows import scenes_of
from hypothesis import given, settings
from hypothesis import strategies as st
from suites import highway_model

from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.forecasters import build_forecaster

CONFIGS = {
    "constant_velocity": {"name": "constant_velocity"},
    "marginal": {"name": "marginal", "modes": 3, "loss_weights": {"imitation": 1.0, "probability": 0.1}},
    "scene_consistent": {
        "name": "scene_consistent",
        "modes": 3,
        "loss_weights": {"imitation": 1.0, "probability": 0.1},
    },
    "epo": {
        "name": "epo",
        "modes": 3,
        "own_start": {"vel": 0.02, "velref": 0.1},
        "symmetric_pairs": True,
    },
}


def forecasts(name: str, backbone: str, place, frame: str) -> tuple[np.ndarray, torch.Tensor]:
    """Positions of all modes in the recording's own coordinates [B, M, N, K, 2], and the modes' probabilities."""
    scene, data = scenes_of(recording(place, FOUR), WindowConfig(), frame)
    of_data = {"horizon": 20, "dt": 0.2, "candidates": 60, "scale": 20.0}
    torch.manual_seed(3)
    model = build_forecaster(highway_model(CONFIGS[name], backbone={"name": backbone}, **of_data))
    forecast = model.predict(scene)
    x, y = forecast.states[..., :2].double().unbind(-1)
    origin, angle = scene.frame[:, :2], scene.frame[:, 2]
    c, s = (f(angle)[:, None, None, None] for f in (torch.cos, torch.sin))
    at = torch.stack((c * x - s * y, s * x + c * y), -1) + origin[:, None, None, None]
    by_track = [torch.tensor(np.argsort(entry["tracks"])) for entry in data.provenance(range(len(data)))]
    return torch.stack([at[b][:, order] for b, order in enumerate(by_track)]).numpy(), forecast.probabilities


def close(found: np.ndarray, expected: np.ndarray) -> None:
    """Equal to 2 cm; rounding may decide which of two equally likely goals, or of two equally near segments, comes first."""
    assert np.quantile(np.abs(found - expected), 0.98) < 0.02


@pytest.mark.parametrize("backbone", ["v_lstm", "vibes", "hivt_m"])
@pytest.mark.parametrize("name", CONFIGS)
@given(st.floats(-3.1, 3.1), st.floats(-5e3, 5e3))
@settings(max_examples=3)
def test_aligned_forecasts_turn_with_the_world(name, backbone, turn, shift):
    still, likely = forecasts(name, backbone, curve(900.0), "aligned")
    moved, as_likely = forecasts(name, backbone, curve(900.0, turn, (shift, -shift)), "aligned")
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    close(moved, still @ rotation.T + [shift, -shift])
    torch.testing.assert_close(as_likely, likely, rtol=0, atol=1e-3)


@pytest.mark.parametrize("name", CONFIGS)
@given(st.floats(-5e3, 5e3), st.floats(-5e3, 5e3))
@settings(max_examples=3)
def test_fixed_forecasts_move_with_the_world(name, x, y):
    still, likely = forecasts(name, "v_lstm", curve(900.0), "fixed")
    moved, as_likely = forecasts(name, "v_lstm", curve(900.0, 0.0, (x, y)), "fixed")
    close(moved, still + np.array([x, y]))
    # Single precision, kilometres from the origin, through batch normalisation.
    torch.testing.assert_close(as_likely, likely, rtol=0, atol=5e-3)
