"""Pictures of joint forecasts of traffic scenes on their lanes, as in the paper's Figs. 4, 10 and 11.

A picture is turned so that the road runs to the right, and everything in it is drawn to scale: both axes are in metres, and
agents have their size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from epo_lightning.forecast import JointForecast
from epo_lightning.report.scene_panels import draw_forecast, draw_known, draw_road, layout
from epo_lightning.report.scene_view import JointMode, SceneView, by_probability, joint_mode
from epo_lightning.report.style import save, style
from epo_lightning.scene import Scene

MOST_MODES = 6
"""Largest number of panels of a picture of one forecaster."""


def draw(scene: Scene, forecast: JointForecast, path: str | Path, title: str = "") -> Path:
    """Picture of all joint modes of a forecast, one panel each, most likely first (Figs. 10 and 11). Returns its path.

    Each agent has one colour, which grows stronger with the predicted steps; the ground truth goes from grey to black.
    Filled vehicles are drawn at t0, pale ones at the end of the forecast, outlined ones at the end of the ground truth.

    Args:
        scene: one scene (B = 1); future, map, sizes and kinds are optional.
        forecast: forecast of this scene; goals of the game are drawn as stars. A panel names agents with values that are
            not finite.
        path: path of the PNG.
        title: title of the picture.

    Raises:
        ValueError: not exactly one scene, a scene without agents, or a path with another ending than .png.
    """
    view = SceneView.of(scene)
    order = by_probability(forecast)
    futures = [joint_mode(forecast, m, f"mode {m + 1}") for m in order[:MOST_MODES]]
    if len(order) > MOST_MODES:
        title = ": ".join(filter(None, (title, f"the {MOST_MODES} most likely of {len(order)} modes")))
    return _picture(view, futures, path, title)


def draw_rows(scene: Scene, forecasts: Mapping[str, JointForecast], path: str | Path) -> Path:
    """Picture of the most likely joint mode of several forecasters, one panel each (Fig. 4). Returns its path.

    Args:
        scene, path: as for :func:`draw`.
        forecasts: forecasts of this scene, by the name of the row in the tables.

    Raises:
        ValueError: as for :func:`draw`, or there is no forecast.
    """
    if not forecasts:
        raise ValueError("comparison without forecasts: nothing to draw")
    view = SceneView.of(scene)
    futures = [joint_mode(forecast, by_probability(forecast)[0], name) for name, forecast in forecasts.items()]
    return _picture(view, futures, path, "")


def _picture(view: SceneView, futures: Sequence[JointMode], path: str | Path, title: str) -> Path:
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: a picture is written as a PNG, so its name must end in .png")
    futures = [view.turned(future) for future in futures]
    with style():
        figure, panels = layout(view, futures, title)
        for axes, future in zip(panels, futures, strict=True):
            draw_road(axes, view)
            draw_known(axes, view)
            draw_forecast(axes, view, future)
        return save(figure, path)
