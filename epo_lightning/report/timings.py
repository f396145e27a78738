"""How long a forecast takes, read from runs that were timed, over agents N, optimisation steps S and modes M."""

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
from epo_lightning.report.render import Sheet
from epo_lightning.report.runs import data_name
from epo_lightning.run_folder import RunFolder, read_json

METHOD = ("forecaster", "dynamics", "energy", "solver", "backward", "objective")
SIZES = ("modes", "steps", "test_steps")
"""Sections of the configuration that make a method, and their keys that are sizes of it."""


@dataclass(frozen=True)
class Timing:
    """How long one trained row takes for a forecast.

    Attributes:
        where: what was timed and on what: timings with the same words compare.
        machine: the second of these: processor, device, threads and batch.
        method: what timings whose sizes alone differ share; empty for a forecaster that solves no game.
        agents, steps, modes: N, S (None for a forecaster that solves no game) and M.
        samples: how often it was measured.
        mean, median, p10, p90: seconds.
        run: the run folder.
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
    run: RunFolder


def read_timings(runs: Iterable[RunFolder]) -> tuple[list[Timing], list[str]]:
    """Every runtime.json of the runs that have one, and a note for each that cannot be read."""
    timings, notes = [], []
    for run in runs:
        if run.metrics_file("time").is_file():
            try:
                timings.append(_read(run))
            except ConfigError as error:
                notes.append(str(error))
    return timings, notes


def _read(run: RunFolder) -> Timing:
    file = run.metrics_file("time")
    content, config = read_json(file), run.config()
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
            f"{file} is not what `score=time` writes ({type(error).__name__}: {error}): time the run again"
        ) from error


def _method(config: Mapping[str, Any]) -> str:
    """The parts of a configuration that make a method, without the sizes that a figure of the runtime varies.

    Forecasters that solve no game have none of these parts, and stand in the figures of those that do.
    """
    if config["forecaster"]["name"] != "epo":
        return ""
    known = essence(config)
    parts = {kind: known.get(kind) or {} for kind in METHOD}
    return canonical({kind: {k: v for k, v in part.items() if k not in SIZES} for kind, part in parts.items()})


def places(timings: Sequence[Timing]) -> dict[str, list[Timing]]:
    """Timings that compare with each other, by what was timed and on what."""
    found: dict[str, list[Timing]] = {}
    for timing in timings:
        found.setdefault(timing.where, []).append(timing)
    return dict(sorted(found.items()))


def methods(timings: Sequence[Timing]) -> list[list[Timing]]:
    """Timings whose sizes alone differ, together: of these a figure can be drawn."""
    games = list(dict.fromkeys(timing.method for timing in timings if timing.method)) or [""]
    return [[timing for timing in timings if timing.method in ("", method)] for method in games]


def grid(timings: Sequence[Timing]) -> tuple[int, dict[tuple[int, int | None], float]]:
    """The number of modes that was timed with the most (N, S), and the mean seconds of each of these."""
    sizes = Counter(modes for modes, _, _ in {(t.modes, t.agents, t.steps) for t in timings})
    modes = max(sizes, key=lambda m: (sizes[m], m))
    return modes, _means({t: (t.agents, t.steps) for t in timings if t.modes == modes})


def over_modes(timings: Sequence[Timing]) -> tuple[tuple[int, int | None], dict[int, float]]:
    """The (N, S) that was timed with the most numbers of modes, and the mean seconds for each M."""
    sizes = Counter((n, s) for _, n, s in {(t.modes, t.agents, t.steps) for t in timings})
    n, s = max(sizes, key=lambda key: (sizes[key], key[0], key[1] or 0))
    found = _means({t: t.modes for t in timings if (t.agents, t.steps) == (n, s)})
    return (n, s), dict(sorted(found.items()))


def timing_sheet(where: str, timings: Sequence[Timing]) -> Sheet:
    """Times measured on one machine by sizes, with the paper's values where it has them, and methods by their titles."""
    lines = []
    named = len({timing.method for timing in timings}) > 1
    for t in sorted(timings, key=lambda t: (t.agents, t.steps or 0, t.modes)):
        paper = RUNTIME.get((t.agents, t.steps or 0)) if t.modes == 4 else None
        if paper is None and (t.agents, t.steps) == (4, 2):
            paper = RUNTIME_MODES.get(t.modes)
        sizes = (str(t.agents), "-" if t.steps is None else str(t.steps), str(t.modes))
        times = (time(t.mean), time(t.median), f"{time(t.p10)} to {time(t.p90)}")
        names = (str(t.run.config().get("title", "untitled")),) if named else ()
        lines.append((*names, *sizes, *times, str(t.samples), "" if paper is None else time(paper)))
    header = (*(("method",) if named else ()), "N", "S", "M", "mean", "median", "10 % to 90 %", "forecasts", "paper")
    return Sheet(f"Time of a forecast: {where}", header, tuple(lines), left=int(named))


def _means(keys: Mapping[Timing, Any]) -> dict[Any, float]:
    """Mean over the runs with the same key: seeds."""
    groups: dict[Any, list[float]] = {}
    for timing, key in keys.items():
        groups.setdefault(key, []).append(timing.mean)
    return {key: statistics.fmean(values) for key, values in groups.items()}


def duration(seconds: float) -> str:
    """``75 s``, ``12 min``, ``3 h 10 min``"""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def time(seconds: float) -> str:
    """Seconds as people say them: two digits, from microseconds to seconds."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        # Two digits may round up to a thousand: 0.9996 s are 1 s.
        if float(f"{seconds:.2g}") >= size or unit == "µs":
            value = float(f"{seconds / size:.2g}")
            digits = 0 if value >= 10 else 1
            return f"{value:.{digits}f} {unit}" if value >= 1 else f"{value:.2g} {unit}"
    raise AssertionError("unreachable")
