"""A film of one episode under several planners, side by side, in real time."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.transforms import Affine2D

from epo_lightning.drive.episodes import Episodes
from epo_lightning.drive.world import EGO
from epo_lightning.report.animation import write_gif
from epo_lightning.report.style import style
from epo_lightning.run_folder import whole_file

COLUMNS = 3
LETTERS = 32
"""Letters in a line of a title."""
EGO_COLOR, OTHER_COLOR = "#c1272d", "#0055a4"


def film(played: Mapping[str, Episodes], episode: int, shape: str, path: Path) -> Path:
    """Write a GIF of one episode: what each planner expects (lines) and what happens.

    Args:
        played: episodes by name of the planner, with their plans.
        episode: index of the episode.
        shape: shape of the bodies, ``disc`` or ``box``.
        path: path of the file.

    Returns:
        ``path``.
    """
    columns = min(COLUMNS, len(played))
    rows = math.ceil(len(played) / columns)
    with style():
        figure = Figure(figsize=(2.2 * columns, 2.5 * rows), layout="constrained")
        axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
        first = next(iter(played.values()))
        for name, axis in zip(played, axes, strict=False):
            axis.set_title(textwrap.fill(name, LETTERS), fontsize=7)
            _frame(axis, played, episode)
        for axis in axes[len(played) :]:
            axis.set_axis_off()
        with whole_file(path, ".gif") as temporary:
            write_gif(figure, _moving(axes, played, episode, shape), first.dt, temporary)
    return path


def _frame(axis: Axes, played: Mapping[str, Episodes], episode: int) -> None:
    shown = np.concatenate(
        [e.states[episode, :, :, :2].numpy()[e.agent_mask[episode].numpy()] for e in played.values()]
    )
    low, high = shown.min(0) - 0.6, shown.max(0) + 0.6
    axis.set_xlim(low[0], high[0])
    axis.set_ylim(low[1], high[1])
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])


def _moving(axes: np.ndarray, played: Mapping[str, Episodes], episode: int, shape: str) -> Iterator[float]:
    steps = next(iter(played.values())).states.shape[2]
    touched: set[str] = set()
    for t in range(steps):
        drawn: list[Artist] = []
        for (name, seen), axis in zip(played.items(), axes, strict=False):
            states, sizes = seen.states[episode].numpy(), seen.size[episode].numpy()
            for agent in np.flatnonzero(seen.agent_mask[episode, :, t].numpy()):
                color = EGO_COLOR if agent == EGO else OTHER_COLOR
                drawn += axis.plot(*states[agent, : t + 1, :2].T, color=color, lw=0.8, alpha=0.5)
                if t < len(seen.plans):
                    plan = seen.plans[t][episode, agent].numpy()
                    drawn += axis.plot(*plan.T, color=color, lw=2.5, alpha=0.3, solid_capstyle="round")
                drawn.append(axis.add_patch(_body(states[agent, t], sizes[agent], shape, axis, color)))
            distance = np.hypot(*(states[1:, t, :2] - states[0, t, :2]).T).min() if shape == "disc" else np.inf
            if distance < sizes[0, 0] and name not in touched:
                touched.add(name)
                axis.set_title(textwrap.fill(f"{name}: contact", LETTERS), fontsize=7, color=EGO_COLOR)
        yield t * next(iter(played.values())).dt
        for artist in drawn:
            artist.remove()


def _body(state: np.ndarray, size: np.ndarray, shape: str, axis: Axes, color: str) -> Circle | Rectangle:
    x, y, heading, _ = state
    if shape == "disc":
        return Circle((x, y), size[0] / 2, color=color, zorder=5)
    turned = Affine2D().rotate(heading).translate(x, y) + axis.transData
    return Rectangle((-size[0] / 2, -size[1] / 2), size[0], size[1], color=color, zorder=5, transform=turned)
