"""Results of closed loops, as ``epo drive`` stores them in ``results.json``: Markdown tables, and single values.

An estimate is a mean over episodes with its 95 % interval, ``{"mean", "low", "high"}``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from epo_lightning.files import read_json
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.report.render import markdown

Estimates = Mapping[str, Mapping[str, float]]
"""Estimates by measure."""
Value = TypeVar("Value")
SHARE = "%"
"""Unit of the measures that are 0 or 1 in an episode."""


def measures_table(planners: Mapping[str, Estimates], units: Mapping[str, str], measures: Sequence[str]) -> str:
    """Table with a row per planner and a column per measure.

    Args:
        planners: estimates by planner.
        units: units by measure; a measure without one has none.
        measures: measures of the columns.
    """
    heads = [measure.replace("_", " ") + (f" [{units[measure]}]" if measure in units else "") for measure in measures]
    lines = [
        (planner, *(_text(estimates[measure], units.get(measure)) for measure in measures))
        for planner, estimates in planners.items()
    ]
    return markdown(("planner", *heads), lines)


def times_table(planners: Mapping[str, Mapping[str, float]]) -> str:
    """Table with a row per planner and a column per time [ms] of a plan; the last column is the number of plans."""
    names = list(dict.fromkeys(name for times in planners.values() for name in times if name != "plans"))
    lines = [
        (planner, *(f"{times[name]:.1f}" for name in names), f"{times['plans']:.0f}")
        for planner, times in planners.items()
    ]
    return markdown(("planner", *names, "plans"), lines)


@dataclass(frozen=True)
class ClosedLoop:
    """Measures of all planners with one kind of others.

    Attributes:
        file: the file that it was read from, for error messages.
        estimates: estimates by planner (``"true game"``), and by paired difference of the file's first planner from another
            one (``"V-LSTM + SC - true game"``).
        units: units by measure.
        times: times [ms] of a plan by planner; empty if none were measured.
        commit: commit of the code that drove; None if it was not known.
    """

    file: Path
    estimates: Mapping[str, Estimates]
    units: Mapping[str, str]
    times: Mapping[str, Mapping[str, float]]
    commit: str | None

    def text(self, planner: str, measure: str) -> str:
        """An estimate of a planner or of a difference: ``0.90 (0.89 to 0.91)``; shares in percent.

        Raises:
            ConfigError: no such planner, difference or measure.
        """
        return _text(self._checked(planner, [measure])[measure], self.units.get(measure))

    def table(self, planners: Iterable[str], *measures: str) -> str:
        """Table of planners, or of differences.

        Raises:
            ConfigError: no such planner, difference or measure.
        """
        found = {planner: self._checked(planner, measures) for planner in planners}
        return measures_table(found, self.units, measures)

    def times_table(self, planners: Iterable[str]) -> str:
        """Table of the times of plans.

        Raises:
            ConfigError: a planner was not timed.
        """
        return times_table({planner: _of(self.times, planner, self.file, "times of a planner") for planner in planners})

    def _checked(self, planner: str, measures: Iterable[str]) -> Estimates:
        estimates = _of(self.estimates, planner, self.file, "planner")
        for measure in measures:
            _of(estimates, measure, self.file, "measure")
        return estimates


def read_closed_loop(file: Path, others: str) -> ClosedLoop:
    """The results of one kind of others from a ``results.json`` of ``epo drive``.

    Raises:
        ConfigError: no such file or kind of others, or a file that ``epo drive`` did not write.
    """
    content = read_json(file)
    try:
        world = _of(content["worlds"], others, file, "kind of others")
        times = content["milliseconds"].get(others, {})
        estimates = {**world["planners"], **world["differences"]}
        return ClosedLoop(file, estimates, world["units"], times, content["commit"])
    except (KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file} is no results.json of epo drive, or one of an older version ({error!r})") from error


def _of(values: Mapping[str, Value], name: str, file: Path, kind: str) -> Value:
    if name not in values:
        raise ConfigError(f"{file} has no {kind} {name!r}; {nearest(name, values)}")
    return values[name]


def _text(estimate: Mapping[str, float], unit: str | None) -> str:
    mean = estimate["mean"]
    scale, digits = (100, 1) if unit == SHARE else (1, 0 if abs(mean) >= 100 else 2 if abs(mean) >= 0.2 else 3)
    middle, *ends = (f"{scale * estimate[name]:z.{digits}f}" for name in ("mean", "low", "high"))
    return f"{middle} ({' to '.join(ends)})"
