"""Complete configurations of models for random scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from games import EXID

from epo_lightning.forecasters import build_forecaster

OWN = ["goal", "vel", "acc", "turnr", "jerk", "turnacc", "velb", "accb", "turnrb", "jerkb", "turnaccb"]
LOSS_WEIGHTS = {"imitation": 1.0, "probability": 0.1}
IMITATION = {"name": "imitation", "weights": {**LOSS_WEIGHTS, "goal": 0.1, "initial": 1.0}}


def model(forecaster: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A complete configuration of a model for random scenes."""
    bounds = {
        "vel": [-0.05, 2.0],
        "acc": [-1.0, 1.0],
        "turnr": [-0.2, 0.2],
        "jerk": [-1.0, 1.0],
        "turnacc": [-1.0, 1.0],
    }
    return {
        "forecaster": forecaster,
        "backbone": {"name": "v_lstm"},
        "dynamics": {"name": "unicycle"},
        "energy": {"name": "features", "own": OWN, "pair": ["proximity"], "bounds": bounds},
        "solver": {"name": "levenberg_marquardt", "steps": 2, "step_size": 0.3, "damping": 10.0},
        "backward": {"name": "unrolled"},
        "objective": IMITATION,
        "optimizer": {"name": "adam"},
        "goal": "energy",
        "horizon": 40,
        "dt": 0.1,
        "subsets": ["executed", "alternative"],
        **changes,
    }


def highway_model(forecaster: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A complete configuration of a model for highway scenes."""
    return model(
        forecaster,
        **{
            "backbone": {"name": "v_lstm"},
            "energy": {"name": "features", "own": list(EXID), "pair": ["proximity"]},
            "horizon": 8,
            "dt": 0.2,
            "subsets": [],
            "shape": "box",
            "candidates": 6,
            "map": True,
            "scale": 50.0,
            **changes,
        },
    )


def untrained(configuration: dict[str, Any], path: Path) -> Path:
    """A checkpoint of a forecaster with initial weights, for forecasters on top of it."""
    with torch.random.fork_rng(devices=[]):
        weights = build_forecaster(configuration).state_dict()
    torch.save({"state_dict": weights, "configuration": configuration}, path)
    return path
