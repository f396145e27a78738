"""Energy-based potential games (EPO) for multi-agent motion forecasting.

The layer on plain tensors::

    from epo_lightning import FeatureEnergy, GameParameters, LevenbergMarquardt, Scene

A trained forecaster from any folder::

    forecaster = epo_lightning.load("RUN/checkpoints/best.ckpt")  # or one that ships: load("rpi/v_lstm_epo")
    forecast = forecaster.predict(scene)

The futures of any other model, made scene-consistent::

    forecast = epo_lightning.refine(states, probabilities, scene)

A picture of a forecast::

    epo_lightning.draw(scene, forecast, "scene.png")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from epo_lightning.data.recorded.lanes import LaneGraph
    from epo_lightning.data.recorded.road_scenes import RoadScenes
    from epo_lightning.forecast import GameParameters, JointForecast, Solution, Status
    from epo_lightning.forecasters import load
    from epo_lightning.game.dynamics import Unicycle
    from epo_lightning.game.energy import Energy
    from epo_lightning.game.feature_energy import FeatureEnergy
    from epo_lightning.predictions import read_predictions, write_predictions
    from epo_lightning.refinement import refine
    from epo_lightning.report.scenes import draw
    from epo_lightning.scene import Scene
    from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

_HOMES = {
    "load": "forecasters",
    "Unicycle": "game.dynamics",
    "Energy": "game.energy",
    "FeatureEnergy": "game.feature_energy",
    "GameParameters": "forecast",
    "JointForecast": "forecast",
    "Scene": "scene",
    "Solution": "forecast",
    "Status": "forecast",
    "LaneGraph": "data.recorded.lanes",
    "LevenbergMarquardt": "solvers.gauss_newton.levenberg_marquardt",
    "RoadScenes": "data.recorded.road_scenes",
    "draw": "report.scenes",
    "read_predictions": "predictions",
    "refine": "refinement",
    "write_predictions": "predictions",
}

__all__ = [
    "Energy",
    "FeatureEnergy",
    "GameParameters",
    "JointForecast",
    "LaneGraph",
    "LevenbergMarquardt",
    "RoadScenes",
    "Scene",
    "Solution",
    "Status",
    "Unicycle",
    "draw",
    "load",
    "read_predictions",
    "refine",
    "write_predictions",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    # Loaded when first asked for, so that `epo --help` does not wait for torch.
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
