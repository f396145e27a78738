"""Figures of the runtime of a forecast beside the paper's: a heat map over agents N and steps S, a line over modes M."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from epo_lightning.report.style import MODES, style
from epo_lightning.report.timings import time_text

BLUES = LinearSegmentedColormap.from_list("calm", ["#EEF5FB", "#C6DBEF", "#6BAED6", "#2171B5", "#0B3F7A"])
"""Colour map from light (fast) to dark (slow), as in the paper."""
OURS, THEIRS = MODES[1], "#8A8A8A"
"""Colours of the lines of this project and of the paper."""


def heat_map(
    seconds: Mapping[tuple[int, int | None], float],
    paper: Mapping[tuple[int, int], float],
    size: tuple[float, float] = (6.4, 4.4),
) -> Figure:
    """Heat map of the runtime over agents (x axis) and steps (y axis), with the paper's values below ours.

    Args:
        seconds: mean seconds by (N, S); S is None for a forecaster without a game.
        paper: the paper's seconds by (N, S).
        size: width and largest height [inch].

    Raises:
        ValueError: there is no timing.
    """
    if not seconds:
        raise ValueError("heat map without timings: nothing to draw")
    agents = sorted({n for n, _ in seconds})
    steps: list[int | None] = sorted({s for _, s in seconds}, key=lambda s: -1 if s is None else s)
    values = np.array([[seconds.get((n, s), math.nan) for n in agents] for s in steps])
    low, high = np.nanmin(values), np.nanmax(values)
    if high < 2 * low:  # keep nearly equal runtimes nearly equal in colour
        low, high = low / 2, high * 2
    norm = LogNorm(low, high)
    with style():
        height = min(size[1], 0.75 + 0.72 * len(steps))
        figure = Figure(figsize=(size[0], height), layout="constrained")
        axes = figure.subplots()
        axes.pcolormesh(
            np.ma.masked_invalid(values), cmap=BLUES, norm=norm, edgecolors="white", lw=2, gid="keep-mesh", snap=True
        )
        for row, s in enumerate(steps):
            for column, n in enumerate(agents):
                if (own := seconds.get((n, s))) is not None:
                    theirs = None if s is None else paper.get((n, s))
                    color = "white" if norm(own) > 0.55 else "#16324F"
                    _write_cell(axes, (column + 0.5, row + 0.5), own, theirs, color, f"keep-{n}-{s}")
        axes.set_xticks(np.arange(len(agents)) + 0.5, [str(n) for n in agents])
        axes.set_yticks(np.arange(len(steps)) + 0.5, ["no game" if s is None else str(s) for s in steps])
        axes.invert_yaxis()
        axes.set_xlabel("agents N")
        axes.set_ylabel("optimisation steps S")
        axes.tick_params(length=0)
        axes.grid(visible=False)
        axes.spines[:].set_visible(False)
        return figure


def _write_cell(axes: Axes, at: tuple[float, float], own: float, theirs: float | None, color: str, gid: str) -> None:
    """Write our seconds at a place of the heat map, and the paper's below them, if it has any."""
    centred: dict[str, Any] = {"ha": "center", "color": color}
    if theirs is None:
        axes.text(*at, time_text(own), va="center", weight="bold", gid=gid, **centred)
        return
    below: dict[str, Any] = {"textcoords": "offset points", **centred}
    axes.annotate(time_text(own), at, (0, 1), va="bottom", weight="bold", gid=gid, **below)
    axes.annotate(f"paper {time_text(theirs)}", at, (0, -2), va="top", fontsize=7.5, gid=f"{gid}-paper", **below)


def draw_modes(
    seconds: Mapping[int, float],
    paper: Mapping[int, float],
    size: tuple[float, float] = (6.4, 2.9),
    legend: bool = True,
) -> Figure:
    """Line plot of the runtime over the number of modes M, with the paper's values dashed.

    Args:
        seconds, paper: mean seconds by M, ours and the paper's; the latter may be empty.
        size: width and height [inch].
        legend: whether the figure has a legend.

    Raises:
        ValueError: there is no timing.
    """
    if not seconds:
        raise ValueError("runtime over modes without timings: nothing to draw")
    with style():
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots()
        axes.plot(
            list(seconds),
            list(seconds.values()),
            color=OURS,
            lw=1.9,
            marker="o",
            ms=5,
            label="here",
            gid="row0-line",
        )
        if paper:
            axes.plot(
                list(paper),
                list(paper.values()),
                color=THEIRS,
                lw=1.2,
                ls=(0, (4, 3)),
                marker="o",
                ms=4.5,
                mfc="white",
                label="paper",
                gid="row1-line",
            )
        axes.set_yscale("log")
        everything = [*seconds.values(), *paper.values()]
        low, high = min(everything) / 1.8, max(everything) * 1.8
        axes.set_ylim(low, high)
        ticks = [m * 10.0**e for e in range(-7, 4) for m in (1, 3) if low <= m * 10.0**e <= high]
        axes.set_yticks(ticks)
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: time_text(value)))
        marks = sorted({*seconds, *paper})
        axes.set_xticks(marks, [str(mark) for mark in marks])
        axes.set_xlabel("modes M")
        axes.set_ylabel("runtime")
        axes.spines[["top", "right"]].set_visible(False)
        if legend:
            figure.legend(loc="outside lower center", ncols=2, fontsize=8)
        return figure
