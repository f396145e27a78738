"""Panels of pictures of traffic scenes: lanes, agents and trajectories to scale, with legends.

Both axes of a panel are in metres, and agents have their size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator

from epo_lightning.report.scene_view import JointMode, SceneView
from epo_lightning.report.style import HISTORY, LANE, ROAD, TRUTH, VEHICLES

Color = str | tuple[float, float, float]

MOST_NAMED = len(VEHICLES)
"""Largest number of agents in the legend: with more, colours repeat."""
LANE_WIDTH = 3.1
"""Width at which a lane is drawn [m]: less than that of real lanes, so that neighbouring lanes stay apart."""
CAR = (4.5, 1.8)
"""Length and width of an agent of unknown size [m]."""
WIDTH, LEFT, TITLE, AXIS, ROW = 8.6, 0.5, 0.27, 0.42, 0.2
"""Width of a picture, margins left of, above and below a panel, height of a line of the legend [inch]."""
PALE = 0.3
"""Strength of the colour at the first step of a forecast, 1 for the full colour."""


def layout(
    view: SceneView, futures: Sequence[JointMode], title: str, moving: bool = False
) -> tuple[Figure, Sequence[Axes]]:
    """Figure with one empty panel per joint mode, with equal scales of both axes; flat panels stand below each other."""
    low, high = view.region(futures)
    shape = float((high - low)[1] / (high - low)[0])
    columns = min(len(futures), 1 if shape < 0.3 else 2 if shape < 0.7 else 3)
    rows = -(-len(futures) // columns)
    panel = min(WIDTH / columns, 4.5) if shape >= 0.7 else WIDTH / columns
    wide = panel - LEFT - 0.1
    tall = wide * shape
    width = panel * columns
    entries = int(width / 1.05)
    legends = [handles for handles in (_named(view), _explained(view, futures, moving)) if handles]
    lines = [-(-len(handles) // entries) for handles in legends]
    legend = ROW * sum(lines) + 0.05
    top = 0.22 if title else 0.0
    # An even number of pixels in both directions, as video encoders require.
    height = round((rows * (tall + TITLE) + AXIS + legend + top) * 50) / 50
    figure = Figure(figsize=(round(width * 50) / 50, height))
    panels = []
    for index in range(len(futures)):
        row, column = divmod(index, columns)
        bottom = height - top - (row + 1) * (tall + TITLE)
        box = ((column * panel + LEFT) / width, bottom / height, wide / width, tall / height)
        axes = figure.add_axes(box)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.grid(visible=False)
        axes.yaxis.set_major_locator(MaxNLocator(max(2, int(tall / 0.3)), steps=[1, 2, 5, 10]))
        axes.set_ylabel("[m]" if view.is_road else "y [m]" if column == 0 else "", labelpad=2)
        if index + columns < len(futures):
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("along the road [m]" if view.is_road else "x [m]", labelpad=2)
        panels.append(axes)
    if title:
        figure.text(LEFT / width, 1 - 0.06 / height, title, va="top", weight="bold", fontsize=10)
    for place, handles in enumerate(legends):
        figure.legend(
            handles=handles,
            loc="lower center",
            bbox_to_anchor=(0.5, ROW * sum(lines[:place]) / height),
            ncols=min(entries, len(handles)),
            fontsize=8,
            handlelength=1.6,
            columnspacing=1.4,
            borderaxespad=0,
            borderpad=0.2,
        )
    return figure, panels


def draw_road(axes: Axes, view: SceneView) -> None:
    """Draw the lanes within the panel as light bands with a centre line."""
    if view.road is None:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    segments = shapely.linestrings(view.road[(view.road[:, 0] != view.road[:, 1]).any(-1)])
    region = shapely.box(left, bottom, right, top).buffer(LANE_WIDTH)
    lines = shapely.line_merge(shapely.union_all(segments[shapely.intersects(segments, region)]))
    surface = shapely.intersection(lines.buffer(LANE_WIDTH / 2, cap_style="square"), region)
    for piece in shapely.get_parts(surface):
        rings = [np.asarray(ring.coords) for ring in (piece.exterior, *piece.interiors)]
        outline = Outline.make_compound_path(*(Outline(ring, closed=True) for ring in rings))
        axes.add_patch(PathPatch(outline, fc=ROAD, ec="none", zorder=0))
    middle = [np.asarray(line.coords) for line in shapely.get_parts(lines)]
    axes.add_collection(LineCollection(middle, colors=LANE, lw=0.6, ls=(0, (6, 4)), zorder=0.5), autolim=False)


def draw_known(axes: Axes, view: SceneView) -> None:
    """Draw the agents at t0, their history and ground truth, and their last observed pose as an outline."""
    for i in range(len(view.states)):
        states, seen = view.states[i], view.seen[i]
        draw_path(axes, states[:, :2], seen, HISTORY, TRUTH, width=1.0, zorder=4)
        after = np.flatnonzero(seen[view.now + 1 :])
        if len(after):
            draw_agent(axes, view, i, states[view.now + 1 + after[-1]], fc="none", ec=TRUTH, lw=0.8, zorder=5)
        if seen[view.now]:
            draw_agent(axes, view, i, states[view.now], fc=agent_color(i), ec="#222222", lw=0.6, zorder=6)


def draw_forecast(axes: Axes, view: SceneView, future: JointMode) -> None:
    """Draw a joint mode with its goals, and a note on what cannot be drawn."""
    axes.set_title(future.title, loc="left", fontsize=9, pad=3)
    positions, finite = with_start(view, future)
    for i in range(len(positions)):
        draw_path(
            axes,
            positions[i, :, :2],
            finite[i],
            mixed("white", agent_color(i), PALE),
            agent_color(i),
            width=3.0,
            zorder=2,
        )
        if finite[i, -1]:
            draw_agent(
                axes, view, i, positions[i, -1], fc=(*to_rgb(agent_color(i)), 0.3), ec=agent_color(i), lw=0.7, zorder=3
            )
        if future.goals is not None and np.isfinite(future.goals[i]).all():
            axes.plot(*future.goals[i], "*", ms=7, mfc=agent_color(i), mec="#222222", mew=0.5, zorder=7)
    if note := undrawn_note(axes, view, future):
        axes.set_title(note, loc="right", fontsize=8, pad=3, color="#B00020")


def undrawn_note(axes: Axes, view: SceneView, future: JointMode) -> str:
    """Note on agents whose forecast is not finite or that are outside the panel; empty if there are none."""
    broken = [i for i in range(len(future.states)) if not np.isfinite(future.states[i]).all()]
    now = view.states[view.seen[:, view.now], view.now, :2]
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    outside = int(((now < low) | (now > high)).any(1).sum())
    notes = []
    if len(broken) == len(future.states):
        notes.append("the forecast is not finite")
    elif broken:
        notes.append(f"not finite: {', '.join(view.names[i] for i in broken[:3])}{' ...' if broken[3:] else ''}")
    if outside:
        notes.append(f"{outside} agent{'s' if outside > 1 else ''} farther away")
    return "; ".join(notes)


def with_start(view: SceneView, future: JointMode) -> tuple[Float[np.ndarray, "N K+1 4"], Bool[np.ndarray, "N K+1"]]:
    """States of a joint mode from t0 on, and the mask of states that can be drawn."""
    states = np.concatenate([view.states[:, view.now, None], future.states], axis=1)
    finite = np.isfinite(future.states).all(-1)
    return states, np.concatenate([view.seen[:, view.now, None], finite], axis=1)


def draw_path(
    axes: Axes,
    positions: Float[np.ndarray, "T 2"],
    mask: Bool[np.ndarray, " T"],
    start: Color,
    end: Color,
    width: float,
    zorder: float,
) -> LineCollection:
    """Draw a trajectory whose colour changes from ``start`` to ``end``, with gaps where the mask is false."""
    share = np.linspace(0, 1, max(len(positions) - 1, 1))[:, None]
    colors = (1 - share) * np.array(to_rgb(start)) + share * np.array(to_rgb(end))
    drawn = mask[:-1] & mask[1:]
    segments = np.stack([positions[:-1], positions[1:]], axis=1)[drawn]
    lines = LineCollection(
        list(segments), colors=colors[: len(drawn)][drawn], lw=width, zorder=zorder, capstyle="round"
    )
    axes.add_collection(lines, autolim=False)
    return lines


def draw_agent(axes: Axes, view: SceneView, i: int, state: Float[np.ndarray, " 4"], **look: Any) -> list[Artist]:
    """Draw an agent to scale as a disc or a box, a car's for unknown sizes; filled boxes have a triangle at the front."""
    x, y, heading, _ = state
    length, width = CAR if view.size is None else view.size[i]
    if view.disc[i]:
        ring = np.linspace(0, 2 * np.pi, 25)[:-1]
        return [
            axes.add_patch(Polygon(np.stack([x + length / 2 * np.cos(ring), y + length / 2 * np.sin(ring)], 1), **look))
        ]
    forward = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-forward[1], forward[0]])

    def at(points: Sequence[tuple[float, float]]) -> np.ndarray:
        return np.array([x, y]) + np.array([a * forward + b * left for a, b in points])

    a, b = length / 2, width / 2
    box = Polygon(at([(a, b), (-a, b), (-a, -b), (a, -b)]), **look)
    tip, reach = a - 0.12 * width, 0.75 * width
    front = Polygon(
        at([(tip, 0), (tip - reach, 0.6 * b), (tip - reach, -0.6 * b)]), fc="white", ec="none", zorder=look["zorder"]
    )
    return [axes.add_patch(box), *([] if look["fc"] == "none" else [axes.add_patch(front)])]


def agent_color(i: int) -> str:
    """Colour of agent i."""
    return VEHICLES[i % len(VEHICLES)]


def mixed(start: Color, end: Color, share: float) -> Color:
    """Linear mix of two colours: ``start`` for share 0, ``end`` for share 1."""
    red, green, blue = (1 - share) * np.array(to_rgb(start)) + share * np.array(to_rgb(end))
    return float(red), float(green), float(blue)


def _explained(view: SceneView, futures: Sequence[JointMode], moving: bool) -> list[Artist]:
    """Legend entries of history, ground truth, forecast and goals."""
    handles: list[Artist] = [Line2D([], [], color=HISTORY, lw=1.2, label="history")]
    if view.seen[:, view.now + 1 :].any():
        truth = Line2D(
            [], [], color=TRUTH, lw=1.2, marker=_shape(view), ms=5, mfc="none", mew=0.8, label="ground truth"
        )
        handles.append(truth)
    handles.append(Line2D([], [], color="#6A6A6A", alpha=0.6, lw=2.6, label="forecast"))
    if not moving and any(future.goals is not None for future in futures):
        handles.append(Line2D([], [], ls="", marker="*", ms=7, mfc="#BBBBBB", mec="#222222", mew=0.5, label="goal"))
    return handles


def _shape(view: SceneView) -> str:
    """Marker of agents in legends: square on roads, circle for pedestrians."""
    return "s" if view.is_road else "o"


def _named(view: SceneView) -> list[Artist]:
    """Legend entries of the agents' colours; none if there are more agents than colours."""
    if len(view.names) > MOST_NAMED:
        return []
    return [
        Line2D([], [], ls="", marker=_shape(view), ms=5.5, mfc=agent_color(i), mec="#222222", mew=0.5, label=name)
        for i, name in enumerate(view.names)
    ]
