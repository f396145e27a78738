"""Figures of a report over many runs, each with a title, a caption and the numbers that it shows."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

from matplotlib.figure import Figure

from epo_lightning.report.curves import (
    Curve,
    StepsCurve,
    draw_learning,
    draw_steps,
    learning_curves,
    look,
    steps_curves,
    steps_names,
)
from epo_lightning.report.efficiency import Efficiency, draw_efficiency, efficiencies
from epo_lightning.report.paper import RUNTIME, RUNTIME_MODES
from epo_lightning.report.runtime import OURS, THEIRS, draw_modes, heat_map
from epo_lightning.report.tables import Table, distinct, trained_rows
from epo_lightning.report.timings import Timing, grid, methods, over_modes, places, time_text

Size = tuple[float, float]


@dataclass(frozen=True)
class Key:
    """One entry of a legend: what a line means, and how it looks."""

    label: str
    color: str
    dashed: bool = False


@dataclass(frozen=True)
class Chart:
    """One figure.

    Attributes:
        section: section of the page that shows the figure.
        name: stem of the figure's file name.
        title, caption: what the figure shows, and how to read it.
        draw: function that draws the figure, given its size [inch] and whether it has a legend.
        wide, narrow: sizes [inch] for a wide page and for a phone.
        legend: legend entries; entry i describes the line whose id is ``row<i>-line``.
        header, numbers: the plotted data as text.
        notes: notes on missing data.
    """

    section: str
    name: str
    title: str
    caption: str
    draw: Callable[[Size, bool], Figure]
    wide: Size
    narrow: Size
    legend: tuple[Key, ...]
    header: tuple[str, ...]
    numbers: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


LONGEST_WORD = 40
"""Largest number of characters of a data set's name in the name of a file."""

LEARNING, STEPS, EFFICIENCY, RUNTIMES = "Learning curves", "S curve", "Data efficiency", "Runtime"


def charts_of(tables: Sequence[Table], timings: Sequence[Timing]) -> list[Chart]:
    """All figures that these tables and timings allow."""
    return [*_learning(tables), *_steps(tables), *_efficiency(tables), *_runtimes(timings)]


def _learning(tables: Sequence[Table]) -> Iterable[Chart]:
    """Learning curves, one chart per data set."""
    by_data = trained_rows(tables)
    for data, rows in by_data.items():
        curves, notes = learning_curves(rows)
        if curves:
            yield Chart(
                section=LEARNING,
                name="learning_curves" + (f"_{_word(data)}" if len(by_data) > 1 else ""),
                title=f"Learning curves, {data}",
                caption="minSADE on the validation split while training: mean over seeds, with a band from the best "
                "to the worst seed. A line ends where the first of its seeds stopped.",
                draw=partial(draw_learning, curves),
                wide=(8.8, 4.3),
                narrow=(4.0, 3.5),
                legend=_keys(curves),
                header=("row", "seeds", "last step", "minSADE there", "smallest mean", "at step"),
                numbers=tuple(_summary(curve) for curve in curves),
                notes=tuple(notes),
            )


def _keys(curves: Iterable[Curve]) -> tuple[Key, ...]:
    """Legend of a chart with one line per curve."""
    return tuple(Key(curve.name, look(i)[0], look(i)[1] != "-") for i, curve in enumerate(curves))


def _summary(curve: Curve) -> tuple[str, ...]:
    """Last and best scores of a learning curve."""
    best = min(range(len(curve.x)), key=lambda i: curve.mean[i])
    return (
        curve.name,
        str(curve.seeds),
        str(curve.x[-1]),
        f"{curve.mean[-1]:.4f}",
        f"{curve.mean[best]:.4f}",
        str(curve.x[best]),
    )


def _steps(tables: Sequence[Table]) -> Iterable[Chart]:
    """Charts over the solver's steps S, one per curve."""
    curves = steps_curves(distinct(tables))
    for number, curve in enumerate(curves, 1):
        yield Chart(
            section=STEPS,
            name="steps" + (f"_{number}" if len(curves) > 1 else ""),
            title=f"{curve.name} over optimisation steps, {curve.split}",
            caption="minSADE of what the game's solution predicts (optimised) and of what the network alone predicts "
            "(initial): mean over seeds, with a band from the best to the worst."
            + (" Dashed: the paper's figure, on its RPI validation split." if curve.paper else ""),
            draw=partial(draw_steps, curve),
            wide=(8.8, 4.1),
            narrow=(4.0, 3.3),
            legend=tuple(Key(*entry) for entry in steps_names(curve)),
            header=("S", "seeds", "optimised [m]", "initial [m]"),
            numbers=tuple(_steps_numbers(curve)),
        )


def _steps_numbers(curve: StepsCurve) -> Iterable[tuple[str, ...]]:
    initial = {} if curve.initial is None else dict(zip(curve.initial.x, curve.initial.mean, strict=True))
    for steps, mean, seeds in zip(curve.optimised.x, curve.optimised.mean, curve.seeds, strict=True):
        yield (
            str(steps),
            str(seeds),
            f"{mean:.4f}",
            f"{initial[steps]:.4f}" if steps in initial else "-",
        )


def _efficiency(tables: Sequence[Table]) -> Iterable[Chart]:
    """Charts over the share of the training games, one per data set and split."""
    found = efficiencies(distinct(tables))
    for number, entry in enumerate(found, 1):
        yield Chart(
            section=EFFICIENCY,
            name="data_efficiency" + (f"_{number}" if len(found) > 1 else ""),
            title=f"minSADE over the share of the training games, {entry.data}",
            caption="minSADE of rows trained on a share of the games: mean over seeds, with a band from the best "
            "to the worst.",
            draw=partial(draw_efficiency, entry.curves),
            wide=(8.8, 4.3),
            narrow=(4.0, 3.5),
            legend=_keys(entry.curves),
            header=("row", "share of the games", "seeds", "minSADE [m]"),
            numbers=tuple(_efficiency_numbers(entry)),
        )


def _efficiency_numbers(entry: Efficiency) -> Iterable[tuple[str, ...]]:
    for curve, counts in zip(entry.curves, entry.seeds, strict=True):
        for share, mean, seeds in zip(curve.x, curve.mean, counts, strict=True):
            yield curve.name, f"{100 * share:.3g} %", str(seeds), f"{mean:.5f}"


def _runtimes(timings: Sequence[Timing]) -> Iterable[Chart]:
    """Heat map over N and S, and line over M, for every machine and method with several sizes."""
    found = [(where, same) for where, members in places(timings).items() for same in methods(members)]
    found = [(where, same) for where, same in found if len({(t.agents, t.steps, t.modes) for t in same}) > 1]
    for number, (where, members) in enumerate(found, 1):
        suffix = f"_{number}" if len(found) > 1 else ""
        header = ("N", "S", "M", "mean", "median", "10 % to 90 %", "forecasts", "run")
        numbers = tuple(_timing_numbers(timing) for timing in sorted(members, key=_position))
        modes, seconds = grid(members)
        if len(seconds) > 1:
            yield Chart(
                section=RUNTIMES,
                name=f"runtime{suffix}",
                title=f"Runtime over agents and steps: {where}",
                caption=f"Mean time of one joint forecast with M = {modes} modes. Below it the paper's, with M = 4, "
                "on its own machine.",
                draw=lambda size, _, seconds=seconds: heat_map(seconds, RUNTIME, size),  # type: ignore[misc]
                wide=(8.8, 4.8),
                narrow=(4.0, 4.4),
                legend=(),
                header=header,
                numbers=numbers,
            )
        (agents, steps), by_modes = over_modes(members)
        if len(by_modes) > 1:
            paper = RUNTIME_MODES if (agents, steps) == (4, 2) else {}
            yield Chart(
                section=RUNTIMES,
                name=f"runtime_modes{suffix}",
                title=f"Runtime over modes: {where}",
                caption=f"Mean time of one joint forecast with N = {agents} agents"
                + (f" and S = {steps} steps." if steps is not None else ".")
                + (" The paper's own two panels differ where they meet (N = 4, S = 2, M = 4)." if paper else ""),
                draw=partial(draw_modes, by_modes, paper),
                wide=(8.8, 3.3),
                narrow=(4.0, 2.9),
                legend=(Key("here", OURS), *([Key("paper", THEIRS, True)] if paper else [])),
                header=header,
                numbers=numbers,
            )


def _position(timing: Timing) -> tuple[int, int, int, str]:
    return timing.agents, timing.steps or 0, timing.modes, str(timing.run.path)


def _timing_numbers(timing: Timing) -> tuple[str, ...]:
    return (
        str(timing.agents),
        "-" if timing.steps is None else str(timing.steps),
        str(timing.modes),
        time_text(timing.mean),
        time_text(timing.median),
        f"{time_text(timing.p10)} to {time_text(timing.p90)}",
        str(timing.samples),
        str(timing.run.path),
    )


def _word(text: str) -> str:
    """Text with everything but letters, digits and underscores replaced, for a file name; a long one ends with a hash."""
    word = re.sub(r"\W+", "_", text)
    if len(word) <= LONGEST_WORD:
        return word
    return f"{word[:LONGEST_WORD]}_{hashlib.sha256(text.encode()).hexdigest()[:6]}"
