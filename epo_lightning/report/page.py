"""The report as one self-contained HTML file, without network, other files or server."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epo_lightning.report.charts import Chart
from epo_lightning.report.made import Made
from epo_lightning.report.render import (
    COMPARISON_LEGEND,
    Sheet,
    difference_text,
    own_text,
    paper_text,
    seeds_text,
    signed,
    with_ends,
)
from epo_lightning.report.rows import Row
from epo_lightning.report.style import svg
from epo_lightning.report.tables import Table, distinct
from epo_lightning.report.worth import LEGEND as WORTH_LEGEND

WIDEST, COLORS = 1500, 128
"""Largest width [pixels] and palette size of pictures: a page should be small enough to mail."""


@dataclass(frozen=True)
class Content:
    """Content of a page.

    Attributes:
        title: title of the page.
        command: command that writes the page again.
        preface, legend: Markdown; only bold, underline and code are rendered.
        tables, transfer, costs, worth, comparisons, settings: shown on the page; all but ``tables`` are text in columns.
        charts: figures, grouped by their section.
        pictures: PNG files.
        made: provenance of every row.
        left_out: run folders that were left out, each with the reason.
        notes: notes on what could not be shown.
        sweep: command that began the sweep; empty if the page shows no sweep.
    """

    title: str
    command: str
    preface: str
    legend: str
    tables: Sequence[Table]
    transfer: Sequence[Sheet]
    costs: Sequence[Sheet]
    worth: Sequence[Sheet]
    comparisons: Sequence[Sheet]
    settings: Sequence[Sheet]
    charts: Sequence[Chart]
    pictures: Sequence[Path]
    made: Sequence[Made]
    left_out: Sequence[tuple[str, str]]
    notes: Sequence[str] = ()
    sweep: str = ""


def page(content: Content) -> str:
    """The HTML of the page. Equal runs give equal bytes, because the page's date is that of the newest run."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    folder = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["marked"] = lambda text: Markup(_marked(text))
    rows = distinct(content.tables)
    places = {row.key: place for place, row in enumerate(rows)}
    cells: list[dict[str, Any]] = []
    tables = [_table(table, cells, lambda row: places[row.key]) for table in content.tables]
    pictures = [(path, picture_uri(path)) for path in content.pictures]
    scenes = [(_caption(path), uri) for path, uri in pictures if "weights" not in path.stem]
    weights = [(_caption(path), uri) for path, uri in pictures if "weights" in path.stem]
    charts: dict[str, list[dict[str, Any]]] = {}
    for chart in content.charts:
        charts.setdefault(chart.section, []).append(_drawn(chart))
    return environment.get_template("page.html.j2").render(
        content=content,
        worth_legend=WORTH_LEGEND,
        comparison_legend=COMPARISON_LEGEND,
        css=Markup((folder / "page.css").read_text(encoding="utf-8")),
        js=Markup((folder / "page.js").read_text(encoding="utf-8")),
        tables=tables,
        charts=charts,
        scenes=scenes,
        weights=weights,
        behind={"rows": [_behind(row) for row in rows], "cells": cells},
        newest=max((run.began for made in content.made for run in made.runs), default="")[:10],
        runs=len({run.folder for made in content.made for run in made.runs}),
        data=list(dict.fromkeys(made.what.split(", ")[0] for made in content.made)),
    )


def _table(table: Table, cells: list[dict[str, Any]], place: Any) -> dict[str, Any]:
    """Rows of a table for the template; details of each cell are appended to ``cells`` and found by their index."""
    rows = []
    for row, last in with_ends(table.rows):
        shown: list[dict[str, Any] | None] = []
        for column in table.columns:
            cell = row.cells.get(column.metric)
            if cell is None:
                shown.append(None)
                continue
            paper, difference = paper_text(row, column), difference_text(row, column)
            mean, _, deviation = own_text(cell, column).partition(" ± ")
            shown.append(
                {
                    "mean": mean,
                    "deviation": deviation,
                    "seeds": seeds_text(row, cell),
                    "value": repr(cell.mean),
                    "rank": {1: "best", 2: "second"}.get(cell.rank or 0, ""),
                    "paper": paper,
                    "difference": difference,
                    "index": len(cells),
                }
            )
            cells.append(
                {
                    "row": place(row),
                    "what": f"{column.label}, {table.data}, {table.split} split",
                    "mean": column.long_text(cell.mean),
                    "std": None if cell.deviation is None else column.long_text(cell.deviation),
                    "n": cell.n,
                    "paper": paper or None,
                    "difference": None if cell.difference is None else signed(cell.difference, 6),
                    "values": [column.long_text(run.metrics.get(column.metric, math.nan)) for run in row.runs],
                }
            )
        rows.append({"name": row.name, "n": len(row.runs), "cells": shown, "last": last})
    return {"title": table.title, "columns": [column.label for column in table.columns], "rows": rows}


def _behind(row: Row) -> dict[str, Any]:
    """Name and runs of a row, for the details that the page shows on a click."""
    return {
        "name": row.name,
        "runs": [
            {
                "seed": run.seed,
                "command": run.command,
                "commit": run.git_commit,
                "digest": run.data_digest,
                "trained": run.trained_digest if run.trained_digest != run.data_digest else "",
                "folder": str(run.path),
            }
            for run in row.runs
        ],
    }


def _drawn(chart: Chart) -> dict[str, Any]:
    """A chart with its two SVG drawings."""
    from markupsafe import Markup

    return {
        "chart": chart,
        "wide": Markup(svg(chart.draw(chart.wide, False), f"{chart.name}-wide")),
        "narrow": Markup(svg(chart.draw(chart.narrow, False), f"{chart.name}-narrow")),
    }


def picture_uri(path: Path) -> str:
    """A PNG, reduced in size and colours, as a data URI."""
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB")
        if small.width > WIDEST:
            small = small.resize((WIDEST, round(small.height * WIDEST / small.width)), Image.Resampling.LANCZOS)
        small = small.quantize(COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        file = io.BytesIO()
        small.save(file, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def _caption(path: Path) -> str:
    return path.stem.replace("_", " ").capitalize()


def _marked(text: str) -> str:
    """Escaped text in which ``**bold**``, ``<u>underlined</u>`` and code in backticks are marked up."""
    from markupsafe import escape

    text = str(escape(text))
    text = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)
    text = re.sub(r"&lt;u&gt;(.+?)&lt;/u&gt;", r"<u>\1</u>", text)
    return re.sub(r"`(.+?)`", r"<code>\1</code>", text)
