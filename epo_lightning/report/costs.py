"""Costs of every row of a report: training, parameters, and the time of a forecast if measured."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from epo_lightning.registry import ConfigError
from epo_lightning.report.columns import MISSING
from epo_lightning.report.curves import METRIC, validation_log
from epo_lightning.report.render import Sheet, signed
from epo_lightning.report.rows import Row
from epo_lightning.report.tables import Table, distinct, trained_rows
from epo_lightning.report.timings import Timing, duration_text, time_text

TRAINED = ("training", "steps", "ms per step")
SETTLED = "last fifth"
"""Column with the change of the validation score at the end of the training (:func:`last_fifth`)."""


def cost_sheets(tables: Sequence[Table], timings: Sequence[Timing]) -> list[Sheet]:
    """Cost tables, one per data set with known costs.

    Times are means over seeds. Forecasts that were timed on different machines stand in columns of their own.
    """
    shown = timings_of(tables, timings)
    machines = list(dict.fromkeys(timing.machine for timing in shown))
    labels = {
        machine: "forecast" if len(machines) == 1 else f"forecast ({number})"
        for number, machine in enumerate(machines, 1)
    }
    return [
        sheet
        for data, rows in trained_rows(tables).items()
        if (sheet := _sheet(f"Cost: {data}", rows, shown, labels)) is not None
    ]


def timings_of(tables: Sequence[Table], timings: Iterable[Timing]) -> list[Timing]:
    """The timings of the runs of these tables, in the tables' order of rows."""
    places: dict[Path, int] = {}
    for row in distinct(tables):
        for run in row.runs:
            places.setdefault(run.path, len(places))
    found = [timing for timing in timings if timing.run.path in places]
    return sorted(found, key=lambda timing: places[timing.run.path])


def _sheet(title: str, rows: Sequence[Row], timings: Sequence[Timing], labels: dict[str, str]) -> Sheet | None:
    columns = ("method", "n", *TRAINED, SETTLED, "parameters", *labels.values())
    lines = [_line(row, timings, labels) for row in rows]
    known = [place for place, name in enumerate(columns) if any(line[place] != MISSING for line in lines)]
    if not {*TRAINED, *labels.values()} & {columns[place] for place in known}:
        return None  # parameters alone are no cost, and stand below
    header = tuple(columns[place] for place in known)
    shown = tuple(tuple(line[place] for place in known) for line in lines)
    return Sheet(title, header, shown, note=_note(header, labels))


def _line(row: Row, timings: Sequence[Timing], labels: dict[str, str]) -> tuple[str, ...]:
    records = [run.records.record for run in row.runs]
    trained = [
        (float(record["seconds"]), int(record["steps"]))
        for record in records
        if record.get("steps") and record.get("seconds") is not None
    ]
    training = [MISSING] * len(TRAINED)
    if trained:
        seconds, steps = (statistics.fmean(values) for values in zip(*trained, strict=True))
        training = [duration_text(seconds), f"{steps:.0f}", f"{1000 * seconds / steps:.3g}"]
    paths = {run.path for run in row.runs}
    forecasts = []
    for machine in labels:
        medians = [t.median for t in timings if t.run.path in paths and t.machine == machine]
        forecasts.append(time_text(statistics.fmean(medians)) if medians else MISSING)
    parameters = ", ".join(dict.fromkeys(str(run.parameters) for run in row.runs if run.parameters is not None))
    return row.name, str(len(row.runs)), *training, _settled(row), parameters or MISSING, *forecasts


def last_fifth(log: Mapping[int, float]) -> float | None:
    """Relative change of the lowest validation score in the last fifth of a training.

    Near zero, the score has settled.

    Args:
        log: validation scores by the number of training steps done.

    Returns:
        The lowest of all scores divided by the lowest one in the first four fifths of the steps, minus one: zero or
        negative. None where no validation lies in the first four fifths, or its lowest score is not positive.
    """
    end = max(log)
    before = min((score for step, score in log.items() if 5 * step <= 4 * end), default=0.0)
    return min(log.values()) / before - 1 if before > 0 else None


def _settled(row: Row) -> str:
    """Mean of :func:`last_fifth` over the seeds of a row, in percent."""
    changes = []
    for run in row.runs:
        try:
            change = last_fifth(validation_log(run.records, METRIC)) if run.learned else None
        except ConfigError:  # the learning curves say what is wrong with this log
            change = None
        if change is None:
            return MISSING
        changes.append(100 * change)
    return f"{signed(statistics.fmean(changes), 1)} %"


def _note(header: Sequence[str], labels: dict[str, str]) -> str:
    """Explanation of a sheet's columns, and of the machine on which forecasts were timed."""
    training = "Training: until the last step, validation included; divided by the steps, ms per step."
    where = [
        f"{label.removeprefix('forecast')} on {machine}".strip() for machine, label in labels.items() if label in header
    ]
    settled = (
        "Last fifth: change of the lowest validation SADE in the last fifth of the steps; near zero, it has settled."
    )
    parts = (
        training if {*header} & {*TRAINED} else "",
        settled if SETTLED in header else "",
        f"Forecast: median time of one joint forecast, {'; '.join(where)}." if where else "",
        "Means over n seeds.",
    )
    return " ".join(part for part in parts if part)
