"""Figures of joint predictions over the observed motion, as in the paper's Fig. 9."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MultipleLocator
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.report.scene_panels import Color, draw_path, mixed
from epo_lightning.report.style import AGENTS, HISTORY, MODES, OTHER, TRUTH, save, style
from epo_lightning.scene import Scene

PANEL = 3.1
"""Width and height of a panel [inch]."""


def joint_predictions(
    scene: Scene,
    forecasts: Mapping[str, JointForecast],
    path: str | Path,
    alternatives: Float[Tensor, "B N K 4"] | None = None,
) -> Path:
    """Figure of all joint modes of several forecasters, one scene per row, one forecaster per column. Returns its path.

    A mode has one colour for all of its agents, which grows stronger with time. The most likely mode is drawn broad and
    the others narrow on top of it, so that modes that have collapsed into one are seen as such. Discs at the ends of
    trajectories have the size of the agents.

    Args:
        scene: a few scenes with futures; goals and sizes are drawn if present.
        forecasts: forecasts of these scenes, by the name of the row in the tables.
        path: path of the PNG.
        alternatives: alternative futures (the other equilibrium); nan for scenes without one.

    Raises:
        ValueError: there is no forecast, or the scenes have no future.
    """
    if not forecasts:
        raise ValueError("joint predictions without a forecast: nothing to draw")
    if scene.future is None:
        raise ValueError("joint predictions are drawn over what happened: Scene.future is missing")
    scene, alternatives = scene.to("cpu"), None if alternatives is None else alternatives.cpu()
    rows, columns = len(scene.history), len(forecasts)
    with style():
        figure = Figure(figsize=(PANEL * columns, PANEL * rows + 0.5), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False, sharex="row", sharey="row")
        for column, (name, forecast) in enumerate(forecasts.items()):
            panels[0, column].set_title(name, weight="bold")
            forecast = forecast.to("cpu")
            for row in range(rows):
                panels[row, column].set_aspect("equal", adjustable="box")
                other = None if alternatives is None else alternatives[row]
                _draw_scene(panels[row, column], scene[row], other, AGENTS if column == 0 else ())
                _draw_modes(panels[row, column], scene[row], forecast[row])
        for row in range(rows):
            panels[row, 0].set_ylabel("y [m]")
            _limits(panels[row, 0], scene[row], [forecast.to("cpu")[row] for forecast in forecasts.values()])
        for axes in panels[-1]:
            axes.set_xlabel("x [m]")
        _explain(figure, scene, columns, max(f.states.shape[1] for f in forecasts.values()), alternatives is not None)
        return save(figure, path)


def _draw_scene(axes: Axes, scene: Scene, other: Tensor | None, agents: Sequence[str]) -> None:
    """Draw histories and observed futures of one scene (B = 1)."""
    centre = np.mean([np.concatenate(_observed(scene, i)).mean(0) for i in _present(scene)], axis=0)
    for i in _present(scene):
        history, future = _observed(scene, i)
        axes.plot(*history.T, color=HISTORY, lw=1.6, ls=(0, (1, 1)), zorder=2)
        _draw_line(axes, np.concatenate([history[-1:], future]), HISTORY, TRUTH, width=1.2, zorder=6.0)
        axes.plot(*history[0], marker="o", ms=3.5, color=HISTORY, zorder=2)
        if other is not None:
            axes.plot(*other[i, :, :2].double().numpy().T, color=OTHER, lw=1.2, ls=(0, (4, 2)), zorder=5)
        if scene.goal_candidates is not None and scene.goal_candidates.shape[2] == 1:
            goal = scene.goal_candidates[0, i, 0].double().numpy()
            axes.plot(*goal, marker="*", ms=11, mfc="white", mec=TRUTH, mew=1.0, ls="", zorder=7)
        if agents:
            _name(axes, agents[i] if i < len(agents) else f"agent {i + 1}", history[0], centre)


def _draw_modes(axes: Axes, scene: Scene, forecast: JointForecast) -> None:
    """Draw joint predictions, the most likely mode first and with the broadest lines."""
    handles = []
    probabilities = forecast.probabilities[0].double().numpy()
    for rank, m in enumerate(np.argsort(-probabilities, kind="stable")):
        color, width = MODES[m % len(MODES)], max(4.4 - 2.4 * rank, 1.2)
        for i in _present(scene):
            start = scene.current[0, i, :2].double().numpy()
            positions = np.concatenate([start[None], forecast.states[0, m, i, :, :2].double().numpy()])
            _draw_line(axes, positions, mixed("white", color, 0.25), color, width, zorder=3 + 0.2 * rank)
            if scene.size is not None:
                radius = scene.size[0, i, 0].item() / 2
                axes.add_patch(Circle(positions[-1], radius, fc=(*to_rgb(color), 0.12), ec=color, lw=1.1, zorder=3))
        handles.append((m, Line2D([], [], color=color, lw=width, label=f"p = {probabilities[m]:.2f}")))
    handles.sort(key=lambda entry: entry[0])
    axes.legend(handles=[handle for _, handle in handles], loc="best", fontsize=8, handlelength=1.2, borderpad=0.2)


def _present(scene: Scene) -> list[int]:
    assert scene.agent_mask is not None
    return [i for i in range(scene.history.shape[1]) if scene.agent_mask[0, i]]


def _observed(scene: Scene, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Observed positions of an agent, until t0 and afterwards."""
    assert scene.future is not None
    assert scene.future_mask is not None
    assert scene.history_mask is not None
    history = scene.history[0, i, :, :2][scene.history_mask[0, i]]
    return history.double().numpy(), scene.future[0, i, :, :2][scene.future_mask[0, i]].double().numpy()


def _draw_line(axes: Axes, positions: np.ndarray, start: Color, end: Color, width: float, zorder: float) -> None:
    """Draw a whole trajectory whose colour changes from ``start`` to ``end``."""
    draw_path(axes, positions, np.ones(len(positions), bool), start, end, width, zorder)


def _name(axes: Axes, name: str, where: np.ndarray, centre: np.ndarray) -> None:
    """Write an agent's name beside its first position, away from the others and towards the inside of the panel."""
    above = where[1] > centre[1]
    sideways = "left" if where[0] < centre[0] - 1 else "right" if where[0] > centre[0] + 1 else "center"
    axes.annotate(
        name,
        (float(where[0]), float(where[1])),
        (0, 6 if above else -6),
        textcoords="offset points",
        ha=sideways,
        va="bottom" if above else "top",
        color="#333333",
        fontsize=8,
        zorder=8,  # above all lines, and apart from them
        path_effects=[withStroke(linewidth=2.5, foreground="white")],
    )


def _limits(axes: Axes, scene: Scene, forecasts: Sequence[JointForecast]) -> None:
    """Set equal square limits for all panels of a row, which include all positions."""
    agents = _present(scene)
    points = [part for i in agents for part in _observed(scene, i)]
    points += [f.states[0, :, agents, :, :2].double().reshape(-1, 2).numpy() for f in forecasts]
    if scene.goal_candidates is not None and scene.goal_candidates.shape[2] == 1:
        points.append(scene.goal_candidates[0, agents, 0].double().numpy())
    everything = np.concatenate(points)
    everything = everything[np.isfinite(everything).all(-1)]
    low, high = everything.min(0), everything.max(0)
    middle, reach = (low + high) / 2, float((high - low).max()) / 2 * 1.05 + 0.45
    axes.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
    step = max(1.0, float(np.round(reach / 2.5)))
    axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.yaxis.set_major_locator(MultipleLocator(step))


def _explain(figure: Figure, scene: Scene, columns: int, modes: int, alternatives: bool) -> None:
    """Add one legend for all panels."""
    handles = [
        Line2D([], [], color=HISTORY, lw=1.6, ls=(0, (1, 1)), marker="o", ms=3.5, markevery=[0], label="history"),
        Line2D([], [], color=TRUTH, lw=1.2, label="ground truth"),
    ]
    if alternatives:
        handles.append(Line2D([], [], color=OTHER, lw=1.2, ls=(0, (4, 2)), label="other equilibrium"))
    if scene.goal_candidates is not None and scene.goal_candidates.shape[2] == 1:
        handles.append(Line2D([], [], marker="*", ms=11, mfc="white", mec=TRUTH, ls="", label="goal"))
    handles += [Line2D([], [], color=MODES[m % len(MODES)], lw=3, label=f"mode {m + 1}") for m in range(modes)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 2 * columns), fontsize=8.5)
