"""A film of one episode under several planners, side by side, in real time."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.transforms import Affine2D

from epo_lightning.drive.episodes import Episodes
from epo_lightning.drive.measures import touching
from epo_lightning.drive.world import EGO
from epo_lightning.files import whole_file
from epo_lightning.report.animation import write_gif
from epo_lightning.report.style import style
from epo_lightning.scene import HEADING

COLUMNS = 3
LETTERS = 32
"""Letters in a line of a title."""
EGO_COLOR, OTHER_COLOR, LINE_COLOR = "#c1272d", "#0055a4", "#bbbbbb"
WIDE = 60.0
"""Extent [m] from which on the picture follows the planned agent instead of showing the whole place."""
AHEAD, BEHIND, BESIDE = 60.0, 40.0, 18.0
"""What it then shows before, behind and beside the agent [m], whose first heading points to the right."""


def film(played: Mapping[str, Episodes], shape: str, path: Path) -> Path:
    """Write a GIF of one episode: what each planner expects (lines) and what happens.

    Args:
        played: the episode by name of the planner, with its plans.
        shape: shape of the bodies, ``disc`` or ``box``.
        path: path of the file.

    Returns:
        ``path``.
    """
    shown = np.concatenate([e.outcome.states[0, ..., :2][e.outcome.agent_mask[0]].numpy() for e in played.values()])
    follows = bool(np.ptp(shown, axis=0).max() > WIDE)
    columns = min(2 if follows else COLUMNS, len(played))
    rows = math.ceil(len(played) / columns)
    width, height = (4.4, 1.9) if follows else (2.2, 2.5)
    with style():
        figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
        axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
        views = []
        for (name, seen), axis in zip(played.items(), axes, strict=False):
            views.append(_View(axis, name, seen, shape, follows, shown))
        for axis in axes[len(played) :]:
            axis.set_axis_off()
        with whole_file(path, ".gif") as temporary:
            write_gif(figure, _moving(views), views[0].dt, temporary)
    return path


def _moving(views: list[_View]) -> Iterator[float]:
    for t in range(max(view.steps for view in views)):
        drawn = [artist for view in views for artist in view.draw(min(t, view.steps - 1))]
        yield t * views[0].dt
        for artist in drawn:
            artist.remove()


class _View:
    """The picture of one planner's episode, at any step."""

    def __init__(
        self, axis: Axes, name: str, seen: Episodes, shape: str, follows: bool, shown: Float[np.ndarray, "n 2"]
    ) -> None:
        self.axis, self.name, self.shape, self.follows, self.dt = axis, name, shape, follows, seen.dt
        happened = seen.outcome
        angle = -float(happened.states[0, EGO, 0, HEADING]) if follows else 0.0
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        self.states = happened.states[0].numpy().copy()
        self.states[..., :2] = self.states[..., :2] @ turn
        self.states[..., HEADING] += angle
        self.mask, self.size = happened.agent_mask[0].numpy(), happened.size[0].numpy()
        self.plans = [plan[0].numpy() @ turn for plan in seen.plans]
        self.steps = self.states.shape[1]
        self.contact = touching(happened, shape)[0].numpy()
        axis.set_title(textwrap.fill(name, LETTERS * (1 + follows)), fontsize=7)
        axis.set_aspect("equal")
        axis.set_xticks([])
        axis.set_yticks([])
        for line in happened.lines:
            axis.plot(*(line.numpy() @ turn).T, color=LINE_COLOR, lw=0.5, zorder=0)
        low, high = shown.min(0) - 0.6, shown.max(0) + 0.6
        axis.set_xlim(low[0], high[0])
        axis.set_ylim(low[1], high[1])

    def draw(self, t: int) -> list[Artist]:
        """Draw a step, and return what has to be removed before the next one."""
        drawn: list[Artist] = []
        if self.follows:
            x, y = self.states[EGO, t, :2]
            self.axis.set_xlim(x - BEHIND, x + AHEAD)
            self.axis.set_ylim(y - BESIDE, y + BESIDE)
        for agent in np.flatnonzero(self.mask[:, t]):
            color = EGO_COLOR if agent == EGO else OTHER_COLOR
            way = self.states[agent, : t + 1, :2][self.mask[agent, : t + 1]]
            drawn += self.axis.plot(*way.T, color=color, lw=0.8, alpha=0.5)
            drawn.append(self.axis.add_patch(self._body(self.states[agent, t], self.size[agent], color)))
        for place, plan in enumerate(self.plans[t] if t < len(self.plans) else ()):
            color = EGO_COLOR if place == EGO else OTHER_COLOR
            drawn += self.axis.plot(*plan.T, color=color, lw=2.5, alpha=0.3, solid_capstyle="round")
        if self.contact[t]:
            title = textwrap.fill(f"{self.name}: contact", LETTERS * (1 + self.follows))
            self.axis.set_title(title, fontsize=7, color=EGO_COLOR)
        return drawn

    def _body(self, state: Float[np.ndarray, " 4"], size: Float[np.ndarray, " 2"], color: str) -> Circle | Rectangle:
        x, y, heading, _ = state
        if self.shape == "disc":
            return Circle((x, y), size[0] / 2, color=color, zorder=5)
        turned = Affine2D().rotate(heading).translate(x, y) + self.axis.transData
        return Rectangle((-size[0] / 2, -size[1] / 2), size[0], size[1], color=color, zorder=5, transform=turned)
