"""How figures look: one set of colours that colour-blind readers can tell apart, and one way to save."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

MODES = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours; the first two modes are red and blue as in the paper."""
AGENT_COLORS = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Agents, where colours do not stand for modes."""
HISTORY, TRUTH, OTHER = "#8A8A8A", "#111111", "#8A8A8A"
AGENTS = ("robot", "pedestrian")
"""What the agents of the RPI environment are called."""
DPI = 150

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.edgecolor": "#BBBBBB",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#EEEEEE",
    "grid.linewidth": 0.8,
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "xtick.labelcolor": "#444444",
    "ytick.labelcolor": "#444444",
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "figure.facecolor": "white",
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the style of this project and leave the reader's own settings as they were."""
    with mpl.rc_context(STYLE):
        yield


def save(figure: Figure, path: str | Path) -> Path:
    """Write a PNG as a whole; the same picture gives the same bytes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)  # no display, and no figure that pyplot remembers
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-", suffix=".png")
    os.close(descriptor)
    try:
        figure.savefig(temporary, dpi=DPI, bbox_inches="tight", pad_inches=0.08, metadata={"Software": None})
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path
