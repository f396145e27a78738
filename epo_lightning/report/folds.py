"""Folds: runs on one data set whose test splits differ, as in a cross-validation over recordings.

The groups of the test split are ``data.test``. Runs that were tested on different groups are in different tables
(:func:`named_by_fold`), and rows are compared with the fold as the unit instead of the seed (:func:`one_per_fold`).
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from epo_lightning.report.runs import EvaluatedRun


def named_by_fold(runs: Iterable[EvaluatedRun]) -> list[EvaluatedRun]:
    """Runs whose data set has the groups of their test split in its name, if runs on it have different ones."""
    runs = list(runs)
    folds: dict[str, set[str]] = {}
    for run in runs:
        folds.setdefault(run.data, set()).add(_ending(run))
    return [replace(run, data=run.data + _ending(run)) if len(folds[run.data]) > 1 else run for run in runs]


def whole_data(run: EvaluatedRun) -> str:
    """Name of the data set of which a run named by :func:`named_by_fold` is a fold; empty for all other runs."""
    ending = _ending(run)
    return run.data.removesuffix(ending) if ending and run.data.endswith(ending) else ""


def one_per_fold(runs: Sequence[Sequence[EvaluatedRun]], row: str) -> list[EvaluatedRun]:
    """One run for each fold, with the number of the fold as its seed and the mean scores of the fold's runs.

    Scores that a fold lacks, as those of interactive scenes where it has none, are left out of all.

    Args:
        runs: the runs of one row in each fold; a fold may have none.
        row: name and identity of the row.
    """
    scores = {number: mean_scores(run.metrics for run in same) for number, same in enumerate(runs) if same}
    known = set.intersection(*map(set, scores.values()))
    return [
        replace(runs[number][0], name=row, row=row, seed=number, metrics={key: found[key] for key in sorted(known)})
        for number, found in scores.items()
    ]


def mean_scores(scores: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Means of the metrics that all of several scores have."""
    scores = list(scores)
    known = set.intersection(*({*each} for each in scores))
    return {key: statistics.fmean(each[key] for each in scores) for key in known}


def _ending(run: EvaluatedRun) -> str:
    """The groups of the test split that a run's configuration names; empty if the split is drawn."""
    groups = run.config["data"].get("test")
    return f", test {', '.join(map(str, groups))}" if groups else ""
