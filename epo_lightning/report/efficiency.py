"""Data efficiency: scores over the share of the training games, for rows that differ in this share alone."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from epo_lightning.identity import essence, of_row
from epo_lightning.report.curves import SIZE, Curve, draw_line, logarithmic_if_wide, look, plain_frame
from epo_lightning.report.rows import Row
from epo_lightning.report.runs import data_name
from epo_lightning.report.style import style

SCORE = "minSADE"
"""Score that is drawn."""


@dataclass(frozen=True)
class Efficiency:
    """The curves of one data set and split.

    Attributes:
        data: data set and split of the scores.
        curves: minSADE of every row over the share of the training games.
        seeds: number of seeds of every curve at every share.
    """

    data: str
    curves: tuple[Curve, ...]
    seeds: tuple[tuple[int, ...], ...]


def efficiencies(rows: Iterable[Row]) -> list[Efficiency]:
    """Rows that differ only in ``data.games_share``, joined; one entry for every data set and split."""
    series: dict[str, dict[str, dict[float, Row]]] = {}
    for row in rows:
        run = row.runs[0]
        share = run.config["data"].get("games_share", 1.0)
        if SCORE not in row.cells or not run.learned or not isinstance(share, int | float):
            continue
        same = essence(of_row(run.config))  # without the runs that refined rows refine: each share has its own
        same = {**same, "data": {**same["data"], "games_share": None}}
        whole = data_name({**run.config["data"], "games_share": 1})
        members = series.setdefault(f"{whole}, {run.split} split", {})
        members.setdefault(json.dumps(same, sort_keys=True), {})[float(share)] = row
    found = []
    for data, members in series.items():
        joined = [dict(sorted(shares.items())) for shares in members.values() if len(shares) > 1]
        if joined:
            found.append(
                Efficiency(
                    data,
                    tuple(
                        Curve.over_seeds(
                            shares[max(shares)].name,
                            {share: [run.metrics[SCORE] for run in row.runs] for share, row in shares.items()},
                        )
                        for shares in joined
                    ),
                    tuple(tuple(len(row.runs) for row in shares.values()) for shares in joined),
                )
            )
    return found


def draw_efficiency(curves: Sequence[Curve], size: tuple[float, float] = SIZE, legend: bool = True) -> Figure:
    """Figure of minSADE over the share of the training games; the ids are those of :func:`draw_learning`."""
    with style():
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots()
        for i, curve in enumerate(curves):
            color, dashes = look(i)
            draw_line(axes, curve, f"row{i}", 0.16, color=color, ls=dashes, lw=1.7, marker="o", ms=5)
        shares = sorted({share for curve in curves for share in curve.x})
        axes.set_xscale("log")
        axes.set_xticks(shares, [f"{100 * share:.3g} %" for share in shares])
        axes.xaxis.set_minor_locator(NullLocator())
        logarithmic_if_wide(axes, curves)
        axes.set_xlabel("share of the training games")
        axes.set_ylabel("minSADE [m]")
        axes.margins(x=0.06, y=0.12)
        plain_frame(axes)
        if legend:
            figure.legend(loc="outside lower center", ncols=2, fontsize=8)
        return figure
