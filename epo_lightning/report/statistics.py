"""Paired comparisons of two rows over the seeds that both have, or over the folds of a cross-validation.

With the same seed and batch size, two rows see the same batches in the same order, so differences within pairs vary less
than scores between seeds. The test is Student's two-sided paired t-test.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from epo_lightning.report.columns import Column
from epo_lightning.report.paper import is_papers
from epo_lightning.report.rows import Row
from epo_lightning.report.tables import Table, loss_of, over_folds

CONFIDENCE = 0.95
EQUAL = 1e-9
"""Largest spread of differences, relative to the scores, that counts as rounding."""


@dataclass(frozen=True)
class Difference:
    """Mean paired difference of two rows' scores, with its confidence interval and p-value.

    Attributes:
        n: number of pairs, one for each seed that both rows have.
        mean: mean of one minus other, negative where the first row is better; None without a pair.
        low, high: bounds of the 95 % confidence interval of the mean.
        p: two-sided p-value of the paired t-test.
        reason: why there is no interval and no p-value; empty if there are.
    """

    n: int
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    p: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class Comparison:
    """Differences between two rows, by metric."""

    one: Row
    other: Row
    differences: Mapping[str, Difference]

    @property
    def seeds(self) -> list[int]:
        """Seeds that both rows have."""
        return sorted({*self.one.seeds} & {*self.other.seeds})


@dataclass(frozen=True)
class Comparisons:
    """All comparisons of a table."""

    title: str
    columns: tuple[Column, ...]
    pairs: tuple[Comparison, ...] = field(repr=False)


def compare(one: Sequence[float], other: Sequence[float]) -> Difference:
    """Mean difference of paired scores, with its confidence interval and p-value.

    Args:
        one, other: scores of equal number; those with the same index are a pair.
    """
    differences = [a - b for a, b in zip(one, other, strict=True)]
    n = len(differences)
    if not n:
        return Difference(0, reason="no common seed")
    if not all(map(math.isfinite, differences)):
        return Difference(n, reason="a score is not a finite number")
    mean = statistics.fmean(differences)
    if n < 2:
        return Difference(n, mean, reason="one common seed, two are needed")
    if max(differences) - min(differences) <= EQUAL * max(map(abs, (*one, *other))):
        return Difference(n, mean, reason="equal for every seed")
    from scipy.special import stdtr, stdtrit  # Student's t distribution and its quantiles; slow to import

    error = statistics.stdev(differences) / math.sqrt(n)
    reach = error * float(stdtrit(n - 1, (1 + CONFIDENCE) / 2))
    return Difference(n, mean, mean - reach, mean + reach, 2 * float(stdtr(n - 1, -abs(mean) / error)))


def compare_rows(one: Row, other: Row, metrics: Sequence[str]) -> Comparison:
    """Comparison of two rows over the seeds and metrics that both have."""
    scores = [{run.seed: run.metrics for run in row.runs} for row in (one, other)]
    seeds = sorted({*scores[0]} & {*scores[1]})
    return Comparison(
        one,
        other,
        {
            metric: compare(*([of[seed][metric] for seed in seeds] for of in scores))
            for metric in metrics
            if metric in one.cells and metric in other.cells
        },
    )


def build_comparisons(tables: Sequence[Table]) -> list[Comparisons]:
    """Comparisons of +EPO rows with +SC rows of the same backbone, goal and power of the loss, for every main table.

    If the tables are folds of a cross-validation, comparisons with the fold as the unit stand first.
    """
    found = []
    of_folds = [(table, "split by split (mean of its seeds)") for table in over_folds(tables)]
    for table, pairing in (*of_folds, *((table, "seed by seed") for table in tables if table.main)):
        metrics = [column.metric for column in table.columns]
        pairs = tuple(
            compare_rows(one, other, metrics)
            for one in table.rows
            for other in table.rows
            if (one.forecaster, other.forecaster) == ("epo", "scene_consistent")
            and one.group == other.group
            and loss_of(one)[0] == loss_of(other)[0]
            and is_papers("epo", one.runs[0].config)
        )
        if pairs:
            found.append(Comparisons(f"{table.title}: +EPO against +SC, {pairing}", table.columns, pairs))
    return found
