"""Growth of the cost with agents, modes and time steps: ``python -m benchmarks.epo_layer --scaling --plot scaling.png``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter
from rich.console import Console
from rich.table import Table

from benchmarks.comparison import Measurement, measurements
from benchmarks.games import make
from benchmarks.implementations import NAMES
from epo_lightning.report.style import MODES, OTHER, save, style

AXES = (
    ("agents N, all of them close", "exid", "N", (2, 4, 8, 16, 32, 64)),
    ("agents N, one neighbour each", "sparse", "N", (2, 4, 8, 16, 32, 64)),
    ("modes M", "exid", "M", (1, 2, 4, 8, 16, 32, 64)),
    ("time steps K", "exid", "K", (10, 20, 40, 80)),
)
"""Title, setting, name of the size that grows, and its values."""
SIZES = {"B": 8, "M": 2, "N": 4, "K": 20, "S": 2}
"""Sizes that do not grow."""
LONGEST = 1e3
"""An implementation that took longer than this [ms] is not measured at larger sizes."""
ARRAYS = 12
"""Memory of automatic differentiation per step, in dense Jacobians; measured."""


def run(
    names: Sequence[str], sizes: Mapping[str, int | None], repeats: int, threads: int, console: Console
) -> dict[str, list[Measurement]]:
    """Measurements of every implementation along every axis, by title, within the limits of memory and time."""
    found: dict[str, list[Measurement]] = {title: [] for title, *_ in AXES}
    for title, setting, axis, values in AXES:
        left = list(names)
        for value in values:
            game = make(setting, **{**SIZES, **{k: v for k, v in sizes.items() if v is not None}, axis: value})
            fitting = [name for name in left if name not in ("peer", "reference") or _fits(game.sizes)]
            latest = measurements(game, fitting, repeats, threads, console, thorough=False)
            found[title] += latest
            took = {m.implementation: m.forward_backward_ms for m in latest}
            left = [name for name in left if took.get(name, LONGEST) < LONGEST]
            console.print(f"{title}: {axis} = {value}: " + ", ".join(f"{n} {ms:.2f} ms" for n, ms in took.items()))
    return found


def _fits(sizes: Mapping[str, int]) -> bool:
    """Whether dense Jacobians of all problems and steps leave half of the machine's memory free."""
    agents, horizon = sizes["N"], sizes["K"]
    rows = 9 * agents * horizon + agents * (agents - 1) // 2 * horizon
    needed = 4 * ARRAYS * sizes["B"] * sizes["M"] * sizes["S"] * rows * 2 * agents * horizon
    return needed < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2


def curves(found: Sequence[Measurement], axis: str) -> dict[str, dict[int, float]]:
    """Forward and backward [ms] by implementation and size."""
    result: dict[str, dict[int, float]] = {}
    for m in found:
        result.setdefault(m.implementation, {})[getattr(m, axis)] = m.forward_backward_ms
    return result


def table(found: Mapping[str, Sequence[Measurement]]) -> Table:
    """Milliseconds of forward and backward, one row per axis and size."""
    result = Table(title="forward and backward, in ms")
    names = [name for name in NAMES if any(m.implementation == name for line in found.values() for m in line)]
    for column in ("", "size", *names):
        result.add_column(column, justify="right" if column else "left")
    for title, _, axis, values in AXES:
        lines = curves(found[title], axis)
        for size in values:
            cells = [lines.get(name, {}).get(size) for name in names]
            result.add_row(title, str(size), *("" if ms is None else f"{ms:.2f}" for ms in cells))
        result.add_section()
    return result


def draw(found: Mapping[str, Sequence[Measurement]], path: Path) -> Path:
    """One panel per axis, both scales logarithmic."""
    colors = dict(zip(NAMES, (OTHER, MODES[4], MODES[1], MODES[0], MODES[2]), strict=True))
    with style():
        figure = Figure(figsize=(11.0, 3.0), layout="constrained")
        panels = figure.subplots(1, len(AXES), sharey=True)
        for panel, (title, _, axis, values) in zip(panels, AXES, strict=True):
            for name, line in curves(found[title], axis).items():
                panel.plot(list(line), list(line.values()), "o-", color=colors[name], markersize=3.5, label=name)
            panel.set(xscale="log", yscale="log", title=title, xlabel=axis)
            panel.set_xticks(values)
            panel.xaxis.set_major_formatter(ScalarFormatter())
            panel.xaxis.set_minor_formatter(NullFormatter())
        panels[0].set_ylabel("forward and backward [ms]")
        panels[1].legend(loc="upper right")
        return save(figure, path)
