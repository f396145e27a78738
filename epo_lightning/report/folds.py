"""Folds: runs on one data set whose test splits differ, as in a cross-validation over recordings.

The groups of the test split are ``data.test``. Runs that were tested on different groups are in different tables
(:func:`named_by_fold`), and rows are compared with the fold as the unit instead of the seed (:func:`joined`).
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from epo_lightning.identity import row_identity
from epo_lightning.report.runs import EvaluatedRun


def named_by_fold(runs: Iterable[EvaluatedRun]) -> list[EvaluatedRun]:
    """Runs whose data set has the groups of their test split in its name, if runs on it have different ones."""
    runs = list(runs)
    folds: dict[str, set[str]] = {}
    for run in runs:
        folds.setdefault(run.data, set()).add(fold(run.config))
    return [replace(run, data=run.data + fold(run.config)) if len(folds[run.data]) > 1 else run for run in runs]


def whole_data(run: EvaluatedRun) -> str:
    """Name of the data set of which a run named by :func:`named_by_fold` is a fold; empty for all other runs."""
    ending = fold(run.config)
    return run.data.removesuffix(ending) if ending and run.data.endswith(ending) else ""


def joined(runs: Sequence[EvaluatedRun]) -> list[EvaluatedRun]:
    """One run for each row and fold, with the number of the fold as its seed and the mean scores over the seeds.

    Rows are equal in everything but seed and test split. Folds are numbered in the order of their groups. Scores that a fold
    lacks, as those of interactive scenes where it has none, are left out of all.

    Args:
        runs: runs on the folds of one data set.

    Returns:
        the runs; none if there are fewer than two folds, or if folds have groups in common.
    """
    folds = sorted({_groups(run.config) for run in runs})
    groups = [group for fold in folds for group in fold]
    if len(folds) < 2 or len({*groups}) < len(groups):
        return []
    rows: dict[str, dict[int, list[EvaluatedRun]]] = {}
    for run in runs:
        rows.setdefault(row_identity(_without_test(run), ""), {}).setdefault(
            folds.index(_groups(run.config)), []
        ).append(run)
    digests = ", ".join(sorted({run.data_digest for run in runs}))
    found = []
    for row, members in rows.items():
        scores = {number: mean_scores(run.metrics for run in same) for number, same in sorted(members.items())}
        known = sorted(set.intersection(*map(set, scores.values())))
        found += [
            replace(
                members[number][0],
                data=whole_data(members[number][0]),
                data_digest=digests,
                config=_without_test(members[number][0]),
                row=row,
                seed=number,
                metrics={metric: means[metric] for metric in known},
            )
            for number, means in scores.items()
        ]
    return found


def mean_scores(scores: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Means of the metrics that all of several scores have."""
    scores = list(scores)
    known = set.intersection(*({*each} for each in scores))
    return {key: statistics.fmean(each[key] for each in scores) for key in known}


def fold(config: Mapping[str, Any]) -> str:
    """Ending of a data set's name for the groups of the test split in a configuration; empty if the split is drawn."""
    return f", test {', '.join(_groups(config))}" if _groups(config) else ""


def _groups(config: Mapping[str, Any]) -> tuple[str, ...]:
    """The groups of the test split that a configuration names, in one order; empty if the split is drawn."""
    named = config["data"].get("test")
    return tuple(sorted({*map(str, named)})) if isinstance(named, list | tuple) else ()


def _without_test(run: EvaluatedRun) -> Mapping[str, object]:
    return {**run.config, "data": {**run.config["data"], "test": None}}
