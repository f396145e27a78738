"""Style of figures: colours that colour-blind readers can distinguish, and reproducible files."""

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

from epo_lightning.files import write_file

MODES = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours; the first two modes are red and blue as in the paper."""
AGENT_COLORS = ("#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of agents in figures where colours do not stand for modes."""
VEHICLES = (*MODES, "#6A3D9A", "#8C510A")
"""Colours of agents in traffic scenes with many agents."""
ROAD, LANE = "#ECECEC", "#CFCFCF"
"""Colours of lanes and of their centre lines."""
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
    """Context with matplotlib settings of this project; the user's settings are restored afterwards."""
    with mpl.rc_context(STYLE):
        yield


def save(figure: Figure, path: str | Path) -> Path:
    """Write a PNG atomically; equal figures give equal bytes."""
    FigureCanvasAgg(figure)  # no display, and no figure that pyplot remembers
    path, picture = Path(path), io.BytesIO()  # a full disk would be an encoder's error without a file's name
    metadata = {"Software": None}
    figure.savefig(picture, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.08, metadata=metadata)
    write_file(path, picture.getbuffer())
    return path


def svg(figure: Figure, name: str) -> str:
    """A figure as an HTML <svg> element without a fixed size, with text as text.

    Args:
        name: prefix of all ids, so that several figures can be in one page.
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
