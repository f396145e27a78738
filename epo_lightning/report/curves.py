"""Curves over many runs: scores over training, and over optimisation steps (the paper's S curve)."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from epo_lightning.identity import essence
from epo_lightning.registry import ConfigError
from epo_lightning.report.paper import STEPS, is_papers, papers_name
from epo_lightning.report.records import Records
from epo_lightning.report.rows import Row
from epo_lightning.report.style import MODES, VEHICLES, style

METRIC = "val/minSADE"
"""Score that a training monitors."""
SIZE = (7.4, 3.7)
"""Width and height of a chart [inch]."""
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))
"""Line styles, which distinguish rows of the same colour."""


@dataclass(frozen=True)
class Curve:
    """One quantity of one row, over training steps, optimisation steps or shares of the training data.

    Attributes:
        name: name of the row.
        x: steps or shares of the values.
        mean, low, high: mean, smallest and largest value over the seeds at every ``x``.
        seeds: number of seeds.
    """

    name: str
    x: tuple[float, ...]
    mean: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    seeds: int

    @classmethod
    def over_seeds(cls, name: str, values: Mapping[Any, Sequence[float]]) -> Curve:
        """The curve of all values, given by step or share."""
        x = tuple(sorted(values))
        return cls(
            name,
            x,
            tuple(statistics.fmean(values[at]) for at in x),
            tuple(min(values[at]) for at in x),
            tuple(max(values[at]) for at in x),
            max(len(entry) for entry in values.values()),
        )


@dataclass(frozen=True)
class StepsCurve:
    """The S curve of rows that differ only in their optimisation steps.

    Attributes:
        name: name of the row with the fewest steps.
        split: data set and split of the scores.
        optimised, initial: minSADE over S of the game's solution and of the initial strategies.
        seeds: number of seeds at every S, smaller for unfinished parts of a sweep.
        paper: whether the paper has this curve.
    """

    name: str
    split: str
    optimised: Curve
    initial: Curve | None
    seeds: tuple[int, ...]
    paper: bool = False


def learning_curves(rows: Iterable[Row]) -> tuple[list[Curve], list[str]]:
    """Learning curve of every row (validation score over training steps), and a note for each row without one.

    A row's curve ends where the first of its seeds stopped, so that its mean is always over all of them.
    """
    curves, notes = [], []
    for row in rows:
        if not any(run.learned for run in row.runs):
            continue
        try:
            logs = [validation_log(run.records, METRIC) for run in row.runs]
        except ConfigError as error:
            notes.append(f"{row.name} is left out: {error}")
            continue
        shared = set.intersection(*(set(log) for log in logs))
        if shared:
            curves.append(Curve.over_seeds(row.name, {step: [log[step] for log in logs] for step in shared}))
        else:
            notes.append(f"{row.name} is left out: its seeds share no step at which they were validated")
    return curves, notes


def validation_log(run: Records, metric: str) -> dict[int, float]:
    """The finite values of one column of a run's ``metrics.csv``, by the number of training steps done.

    If a step has several, the last one counts.

    Raises:
        ConfigError: the file cannot be read, or no row has a finite number in this column.
    """
    file = run.path / "logs" / "metrics.csv"
    try:
        rows = run.log()
    except OSError as error:
        raise ConfigError(f"cannot read {file} ({error.strerror})") from error
    values: dict[int, float] = {}
    for row in rows:
        try:
            value = float(row[metric])
        except (KeyError, ValueError, TypeError):
            continue
        if math.isfinite(value):
            values[int(row["step"]) + 1] = value  # the log counts from zero: step 3 is the fourth
    if not values:
        raise ConfigError(f"{file} {'has no finite ' + metric if rows else 'is missing or has no row'}")
    return values


def draw_learning(curves: Sequence[Curve], size: tuple[float, float] = SIZE, legend: bool = True) -> Figure:
    """Figure of learning curves: one line per row, and a band from its smallest to its largest seed.

    Lines and bands have the ids ``row<i>-line`` and ``row<i>-band``, so that a page can hide them.

    Raises:
        ValueError: there is no curve.
    """
    if not curves:
        raise ValueError("learning curves of no row: nothing to draw")
    with style():
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots()
        for i, curve in enumerate(curves):
            color, dashes = look(i)
            marker = "o" if len(curve.x) == 1 else ""
            draw_line(
                axes, curve, f"row{i}", 0.16 if len(curves) < 5 else 0.08, color=color, ls=dashes, lw=1.7, marker=marker
            )
        logarithmic_if_wide(axes, curves)
        axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
        axes.set_xlabel("training steps")
        axes.set_ylabel("minSADE, validation [m]")
        axes.margins(x=0.02)
        plain_frame(axes)
        if legend:
            figure.legend(loc="outside lower center", ncols=min(3, len(curves)), fontsize=8)
        return figure


def look(i: int) -> tuple[str, str | tuple[int, tuple[float, float]]]:
    """Colour and dashes of the i-th row."""
    return VEHICLES[i % len(VEHICLES)], DASHES[i // len(VEHICLES) % len(DASHES)]


def steps_curves(rows: Iterable[Row]) -> list[StepsCurve]:
    """S curves: rows that differ only in ``solver.steps``, joined."""
    series: dict[str, dict[int, list[Row]]] = {}
    for row in rows:
        if "minSADE" not in row.cells or row.runs[0].forecaster != "epo":
            continue
        same = essence(row.runs[0].config)
        steps = (same.get("solver") or {}).pop("steps", None)
        if isinstance(steps, int):
            # The data are those of the table; a seed is not part of a row.
            key = json.dumps([row.runs[0].data, row.runs[0].split, {**same, "seed": None}], sort_keys=True)
            series.setdefault(key, {}).setdefault(steps, []).append(row)
    curves = []
    for members in series.values():
        if len(members) < 2:
            continue
        runs = {steps: [run for row in same for run in row.runs] for steps, same in sorted(members.items())}
        first = members[min(members)][0]
        solved = {steps: [run.metrics["minSADE"] for run in group] for steps, group in runs.items()}
        initial = {
            steps: values
            for steps, group in runs.items()
            if (values := [run.metrics["initial/minSADE"] for run in group if "initial/minSADE" in run.metrics])
        }
        curves.append(
            StepsCurve(
                name=first.title,
                split=f"{first.runs[0].data}, {first.runs[0].split} split",
                optimised=Curve.over_seeds(first.name, solved),
                initial=Curve.over_seeds(first.name, initial) if initial else None,
                seeds=tuple(len(group) for group in runs.values()),
                paper=(papers_name(first.runs[0].data), first.runs[0].backbone) == ("rpi", "v_lstm")
                and is_papers("epo", first.runs[0].config),
            )
        )
    return curves


def draw_steps(curve: StepsCurve, size: tuple[float, float] = SIZE, legend: bool = True) -> Figure:
    """Figure of minSADE of optimised and initial strategies over the optimisation steps S, with the paper's dashed.

    The ids are those of :func:`draw_learning`: rows 0 and 1 are ours, 2 and 3 the paper's.
    """
    names = steps_names(curve)
    with style():
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots()
        ours = {"lw": 1.9, "marker": "o", "ms": 5}
        draw_line(axes, curve.optimised, "row0", 0.16, label=names[0][0], color=names[0][1], **ours)
        if curve.initial is not None:
            draw_line(axes, curve.initial, "row1", 0.16, label=names[1][0], color=names[1][1], **ours)
        if curve.paper:
            for which, (label, color, _) in enumerate(names[-2:]):
                axes.plot(
                    list(STEPS),
                    [values[("minSADE", "initial/minSADE")[which]] for values in STEPS.values()],
                    color=color,
                    lw=1.2,
                    ls=(0, (4, 3)),
                    marker="o",
                    ms=4.5,
                    mfc="white",
                    label=label,
                    gid=f"row{2 + which}-line",
                )
        ticks = sorted({*curve.optimised.x, *(STEPS if curve.paper else ())})
        if ticks[0] > 0:
            axes.set_xscale("log", base=2)
        else:  # zero has no logarithm
            axes.set_xscale("symlog", base=2, linthresh=1)
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("optimisation steps S")
        axes.set_ylabel("minSADE [m]")
        axes.margins(x=0.06, y=0.12)
        plain_frame(axes)
        if legend:
            figure.legend(loc="outside lower center", ncols=2, fontsize=8)
        return figure


def steps_names(curve: StepsCurve) -> list[tuple[str, str, bool]]:
    """Label, colour and whether it is dashed, of every line of an S curve in the order of their ids."""
    ours = [("optimised", MODES[1], False)] + ([("initial", MODES[0], False)] if curve.initial is not None else [])
    return ours + ([("paper, optimised", MODES[1], True), ("paper, initial", MODES[0], True)] if curve.paper else [])


def draw_line(axes: Axes, curve: Curve, gid: str, shade: float, label: str | None = None, **options: object) -> Line2D:
    """Draw a mean, and its band if there are several seeds."""
    if curve.seeds > 1:
        axes.fill_between(
            curve.x,
            curve.low,
            curve.high,
            color=str(options["color"]),
            alpha=shade,
            lw=0,
            gid=f"{gid}-band",
        )
    drawn = axes.plot(curve.x, curve.mean, label=label or curve.name, gid=f"{gid}-line", **options)  # type: ignore[arg-type]
    return drawn[0]


def logarithmic_if_wide(axes: Axes, curves: Sequence[Curve]) -> None:
    """Set a logarithmic axis, with ticks as plain numbers, for positive values that differ by more than a factor of five."""
    values = [value for curve in curves for value in (*curve.low, *curve.high)]
    if min(values) <= 0 or max(values) <= 5 * min(values):
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    low, high = axes.get_ylim()
    ticks = [m * 10.0**e for e in range(-6, 6) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    if ticks:
        axes.set_yticks(ticks)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_minor_locator(NullLocator())


def plain_frame(axes: Axes) -> None:
    """Leave out the frame's lines at the top and on the right."""
    axes.spines[["top", "right"]].set_visible(False)
