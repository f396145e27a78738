"""Scores of rows for pages of text: means, deviations, paired differences with intervals, and tables of them.

Metrics are named as in the tables of reports (``SADE``, ``OR``, ``SADE, k=1``) or as in ``metrics.json``. The name of a
subset or of a stage stands before them: ``interactive SADE``, ``initial SADE``; ``validation SADE`` is the lowest one of the
training's log.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from epo_lightning.registry import ConfigError, nearest
from epo_lightning.report.columns import EQUILIBRIUM, MAIN, PROBABILITIES, TRUTH
from epo_lightning.report.folds import mean_scores
from epo_lightning.report.render import markdown
from epo_lightning.report.statistics import compare

METRICS = {
    **{column.label: column.metric for column in (*MAIN, *PROBABILITIES, *EQUILIBRIUM, *TRUTH)},
    "OR": "overlap_jfp",
}
"""Metrics by the names that templates may use for them."""


@dataclass(frozen=True)
class Scores:
    """Scores of one row, by seed and metric.

    Attributes:
        name: name of the row, for error messages.
        by_seed: scores by metric of every seed; of a cross-validation, of every fold.
        digits: number of decimals in texts.
    """

    name: str
    by_seed: Mapping[int, Mapping[str, float]] = field(repr=False)
    digits: int = 3

    @property
    def n(self) -> int:
        """Number of seeds."""
        return len(self.by_seed)

    def values(self, metric: str) -> list[float]:
        """The score of every seed, in the order of the seeds.

        Raises:
            ConfigError: the row has no such metric, or a seed lacks it or has no finite value of it.
        """
        subset, _, label = metric.partition(" ")
        known = {key for scores in self.by_seed.values() for key in scores}
        names = (METRICS.get(metric, metric), f"{subset}/{METRICS.get(label, label)}")
        key = next((name for name in names if name in known), None)
        if key is None:
            raise ConfigError(f"row {self.name!r} has no metric {metric!r}; {nearest(names[0], known)}")
        values = {seed: self.by_seed[seed].get(key, math.nan) for seed in sorted(self.by_seed)}
        for seed, value in values.items():
            if not math.isfinite(value):
                raise ConfigError(
                    f"row {self.name!r}, seed {seed}: {key} is {value}, and a page needs a finite score of every seed"
                )
        return list(values.values())

    def mean(self, metric: str, digits: int | None = None) -> str:
        """Mean over seeds: ``.0128``."""
        return _decimal(statistics.fmean(self.values(metric)), self._places(digits))

    def text(self, metric: str, digits: int | None = None) -> str:
        """Mean and sample standard deviation over seeds: ``.0128 ± .0007``; the mean alone if all seeds agree."""
        values = self.values(metric)
        spread = statistics.stdev(values) if len({*values}) > 1 else None
        mean = self.mean(metric, digits)
        return mean if spread is None else f"{mean} ± {_decimal(spread, self._places(digits))}"

    def seeds(self, metric: str, digits: int | None = None) -> str:
        """The score of every seed: ``.087, .086, .087``."""
        return ", ".join(_decimal(value, self._places(digits)) for value in self.values(metric))

    def over(self, other: Scores, metric: str) -> str:
        """Ratio of the means of this row and another one: ``.68``."""
        return _decimal(statistics.fmean(self.values(metric)) / statistics.fmean(other.values(metric)), 2)

    def __sub__(self, other: Scores) -> Differences:
        """Differences from another row over the seeds that both have.

        Raises:
            ConfigError: the rows have no seed in common.
        """
        seeds = sorted(self.by_seed.keys() & other.by_seed.keys())
        if not seeds:
            raise ConfigError(f"rows {self.name!r} and {other.name!r} have no seed in common")
        found = {
            seed: {
                key: value - other.by_seed[seed][key]
                for key, value in self.by_seed[seed].items()
                if key in other.by_seed[seed]
            }
            for seed in seeds
        }
        return Differences(f"{self.name} - {other.name}", found, self.digits)

    def _places(self, digits: int | None) -> int:
        return self.digits if digits is None else digits


class Differences(Scores):
    """Paired differences of two rows, by seed and metric; negative where the first row has the smaller score."""

    def text(self, metric: str, digits: int | None = None) -> str:
        """Mean difference with its 95 % confidence interval (Student's t): ``-.0044 (-.0060 to -.0029)``."""
        values = self.values(metric)
        found = compare(values, [0.0] * len(values))
        shown = [value for value in (found.mean, found.low, found.high) if value is not None]
        middle, *ends = (_decimal(value, self._places(digits), sign=True) for value in shown)
        return f"{middle} ({' to '.join(ends)})" if ends else middle

    def seeds(self, metric: str, digits: int | None = None) -> str:
        """The difference of every seed: ``+.013, -.060, +.290``."""
        return ", ".join(_decimal(value, self._places(digits), sign=True) for value in self.values(metric))


def average(rows: Iterable[Scores]) -> Scores:
    """Mean of several rows, or of several differences, seed by seed, over the seeds that all of them have.

    Raises:
        ConfigError: the rows have no seed in common.
    """
    rows = list(rows)
    seeds = sorted(set.intersection(*({*row.by_seed} for row in rows)))
    if not seeds:
        raise ConfigError(f"rows {', '.join(repr(row.name) for row in rows)} have no seed in common")
    found = {seed: mean_scores(row.by_seed[seed] for row in rows) for seed in seeds}
    return type(rows[0])(f"mean of {', '.join(row.name for row in rows)}", found, rows[0].digits)


def below(rows: Iterable[Scores], metric: str, limit: float = 0.0) -> str:
    """Number of runs whose score is below a limit, or of pairs whose first run has the lower score: ``8 of 9``."""
    values = [value for row in rows for value in row.values(metric)]
    return f"{sum(value < limit for value in values)} of {len(values)}"


def table(
    name: str, rows: Mapping[str, Scores], *metrics: str, paper: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Markdown table of rows, or of differences.

    Args:
        name: heading of the first column.
        rows: rows by the names that the table gives them.
        metrics: metrics of the columns.
        paper: the paper's values by row, for as many columns as they are, which are the first ones.
    """
    paper = paper or {}
    known = max(map(len, paper.values()), default=0)
    header = (name, "n", *metrics, *(f"paper: {metric}" for metric in metrics[:known]))
    lines = []
    for title, row in rows.items():
        values = [*paper.get(title, ()), *[""] * known][:known]
        lines.append((title, str(row.n), *(row.text(metric) for metric in metrics), *values))
    return markdown(header, lines)


def _decimal(value: float, digits: int, sign: bool = False) -> str:
    """A number with fixed decimals and without a zero before the point: ``.013``, ``+.013``."""
    value = value if sign else round(value, digits) + 0.0  # no -.000 without a sign
    return re.sub(r"^([+-]?)0\.", r"\1.", f"{value:{'+' if sign else ''}.{digits}f}")
