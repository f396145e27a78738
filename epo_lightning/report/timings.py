"""Runtimes of a forecast, read from runs that were timed, by agents N, optimisation steps S and modes M."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from epo_lightning.identity import canonical, essence
from epo_lightning.registry import ConfigError
from epo_lightning.report.paper import RUNTIME, RUNTIME_MODES
from epo_lightning.report.records import TIME, Records
from epo_lightning.report.render import Sheet
from epo_lightning.report.runs import checked_records, data_name

METHOD = ("forecaster", "dynamics", "energy", "solver", "backward", "objective")
SIZES = ("modes", "steps", "test_steps")
"""Sections of the configuration that define a method, and their keys that are only sizes of it."""


@dataclass(frozen=True)
class Timing:
    """Measured runtime of one run's forecasts.

    Attributes:
        where: data, backbone and machine; only timings with equal ``where`` are compared.
        machine: processor, device, threads and batch size.
        method: canonical parts of the method without its sizes; empty for a forecaster that solves no game.
        agents, steps, modes: N, S (None for a forecaster that solves no game) and M.
        samples: number of measurements.
        mean, median, p10, p90: runtime of a forecast [s].
        run: records of the run.
    """

    where: str
    machine: str
    method: str
    agents: int
    steps: int | None
    modes: int
    samples: int
    mean: float
    median: float
    p10: float
    p90: float
    run: Records


def read_timings(runs: Iterable[Records]) -> tuple[list[Timing], list[str]]:
    """Timings of the runs that have a runtime.json, and an error message for each file that cannot be read."""
    timings, notes = [], []
    for run in runs:
        if TIME in run.names():
            try:
                timings.append(_read(run))
            except ConfigError as error:
                notes.append(str(error))
    return timings, notes


def _read(run: Records) -> Timing:
    """The timing of a run.

    Raises:
        ConfigError: its runtime.json, its configuration or its record is damaged.
    """
    content, (config, _) = run.content(TIME), checked_records(run)
    try:
        seconds = {name: float(content["seconds"][name]) for name in ("mean", "median", "p10", "p90")}
        if not all(math.isfinite(value) and value > 0 for value in seconds.values()):
            raise ValueError("seconds must be positive numbers")
        threads, batch = int(content["threads"]), int(content["batch"])
        what = f"{data_name(config['data'])}, {config['backbone']['name']}"
        machine = f"{content['machine']} ({content['device']}, {threads} thread{'s' if threads > 1 else ''})"
        machine += f", batches of {batch}" if batch > 1 else ""
        steps = content["steps"]
        return Timing(
            where=f"{what}, {machine}",
            machine=machine,
            method=_method(config),
            agents=int(content["agents"]),
            steps=None if steps is None else int(steps),
            modes=int(content["modes"]),
            samples=int(content["samples"]),
            run=run,
            **seconds,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{run.path / TIME} is not what `score=time` writes ({type(error).__name__}: {error}): time the run again"
        ) from error


def _method(config: Mapping[str, Any]) -> str:
    """The parts of a configuration that define a method, without the sizes that a runtime figure varies.

    Empty for forecasters that solve no game: they appear in the figures of all methods.
    """
    if config["forecaster"]["name"] != "epo":
        return ""
    known = essence(config)
    parts = {group: known.get(group) or {} for group in METHOD}
    return canonical({group: {k: v for k, v in part.items() if k not in SIZES} for group, part in parts.items()})


def places(timings: Sequence[Timing]) -> dict[str, list[Timing]]:
    """Timings grouped by data, backbone and machine (``where``), in sorted order."""
    found: dict[str, list[Timing]] = {}
    for timing in timings:
        found.setdefault(timing.where, []).append(timing)
    return dict(sorted(found.items()))


def methods(timings: Sequence[Timing]) -> list[list[Timing]]:
    """Timings grouped by method, one figure each; timings without a game are in every group."""
    games = list(dict.fromkeys(timing.method for timing in timings if timing.method)) or [""]
    return [[timing for timing in timings if timing.method in ("", method)] for method in games]


def grid(timings: Sequence[Timing]) -> tuple[int, dict[tuple[int, int | None], float]]:
    """The number of modes M that was timed with the most pairs (N, S), and mean seconds by (N, S) for that M."""
    sizes = Counter(modes for modes, _, _ in {(t.modes, t.agents, t.steps) for t in timings})
    modes = max(sizes, key=lambda m: (sizes[m], m))
    return modes, _means({t: (t.agents, t.steps) for t in timings if t.modes == modes})


def over_modes(timings: Sequence[Timing]) -> tuple[tuple[int, int | None], dict[int, float]]:
    """The pair (N, S) that was timed with the most values of M, and mean seconds by M for that pair."""
    sizes = Counter((n, s) for _, n, s in {(t.modes, t.agents, t.steps) for t in timings})
    n, s = max(sizes, key=lambda key: (sizes[key], key[0], key[1] or 0))
    found = _means({t: t.modes for t in timings if (t.agents, t.steps) == (n, s)})
    return (n, s), dict(sorted(found.items()))


def timing_sheet(where: str, timings: Sequence[Timing]) -> Sheet:
    """Sheet of the times measured on one machine, sorted by sizes, with the paper's values; titles if methods differ."""
    lines = []
    named = len({timing.method for timing in timings}) > 1
    for t in sorted(timings, key=lambda t: (t.agents, t.steps or 0, t.modes)):
        paper = RUNTIME.get((t.agents, t.steps or 0)) if t.modes == 4 else None
        if paper is None and (t.agents, t.steps) == (4, 2):
            paper = RUNTIME_MODES.get(t.modes)
        sizes = (str(t.agents), "-" if t.steps is None else str(t.steps), str(t.modes))
        times = (time_text(t.mean), time_text(t.median), f"{time_text(t.p10)} to {time_text(t.p90)}")
        names = (str(t.run.config().get("title", "untitled")),) if named else ()
        lines.append((*names, *sizes, *times, str(t.samples), "" if paper is None else time_text(paper)))
    header = (*(("method",) if named else ()), "N", "S", "M", "mean", "median", "10 % to 90 %", "forecasts", "paper")
    return Sheet(f"Time of a forecast: {where}", header, tuple(lines), left=int(named))


def _means(keys: Mapping[Timing, Any]) -> dict[Any, float]:
    """Mean seconds over the timings with the same key, which differ in their seed."""
    groups: dict[Any, list[float]] = {}
    for timing, key in keys.items():
        groups.setdefault(key, []).append(timing.mean)
    return {key: statistics.fmean(values) for key, values in groups.items()}


def duration_text(seconds: float) -> str:
    """A duration as text: ``75 s``, ``12 min``, ``3 h 10 min``."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def time_text(seconds: float) -> str:
    """A time as text with two significant digits and its unit: ``1.2 ms``, ``35 µs``."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        # Two digits may round up to a thousand: 0.9996 s are 1 s.
        if float(f"{seconds:.2g}") >= size or unit == "µs":
            value = float(f"{seconds / size:.2g}")
            digits = 0 if value >= 10 else 1
            return f"{value:.{digits}f} {unit}" if value >= 1 else f"{value:.2g} {unit}"
    raise AssertionError("unreachable")
