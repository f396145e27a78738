"""How figures look: one set of colours that colour-blind readers can tell apart, and one way to save."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from epo_lightning.run_folder import write_bytes

MODES = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours; the first two modes are red and blue as in the paper."""
AGENT_COLORS = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Agents, where colours do not stand for modes."""
VEHICLES = (*MODES, "#6A3D9A", "#8C510A")
"""Agents of a traffic scene, where there are more than a few."""
ROAD, LANE = "#ECECEC", "#CFCFCF"
"""Lanes, and the line in the middle of each."""
HISTORY, TRUTH, OTHER = "#8A8A8A", "#111111", "#8A8A8A"
AGENTS = ("robot", "pedestrian")
"""Names of the agents of the RPI environment."""
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
    "text.parse_math": False,  # titles are text, whatever dollars are in them
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the style of this project and leave the reader's own settings as they were."""
    with mpl.rc_context(STYLE):
        yield


def save(figure: Figure, path: str | Path) -> Path:
    """Write a PNG as a whole; the same picture gives the same bytes."""
    FigureCanvasAgg(figure)  # no display, and no figure that pyplot remembers
    path, picture = Path(path), io.BytesIO()  # a full disk would be an encoder's error without a file's name
    metadata = {"Software": None}
    figure.savefig(picture, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.08, metadata=metadata)
    write_bytes(path, picture.getbuffer())
    return path


def svg(figure: Figure, name: str) -> str:
    """A figure as a piece of HTML: an <svg> without a size of its own, whose text is text.

    Args:
        name: begins all ids, so that several figures live in one page.
    """
    FigureCanvasAgg(figure)
    text = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(
            text, format="svg", transparent=True, bbox_inches="tight", pad_inches=0.04, metadata={"Date": None}
        )
    drawing = text.getvalue()
    drawing = drawing[drawing.index("<svg") :]
    # The page chooses fonts; a style sheet within the drawing would rule over all of the page.
    for superfluous in (r"<metadata>.*?</metadata>", r"<style.*?</style>", r"font-family: [^;\"]*; "):
        drawing = re.sub(superfluous, "", drawing, flags=re.DOTALL)
    drawing = re.sub(r'\b(id="|href="#|url\(#)', rf"\g<1>{name}-", drawing)
    return re.sub(r'^<svg[^>]*?(viewBox="[^"]*")[^>]*>', r'<svg \1 aria-hidden="true" focusable="false">', drawing)
