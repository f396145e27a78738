"""Folds: runs on one data set whose test splits differ, as in a cross-validation over recordings.

The groups of the test split are ``data.test``. Runs that were tested on other groups are in tables of their own; a page
takes their differences with the fold as the unit (:meth:`epo_lightning.report.template.Results.folds`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from epo_lightning.report.runs import EvaluatedRun


def fold_of(run: EvaluatedRun) -> tuple[str, ...]:
    """Groups of the test split that a run's configuration names; empty if the split is drawn."""
    return tuple(sorted(map(str, run.config["data"].get("test") or ())))


def named_by_fold(runs: Iterable[EvaluatedRun]) -> list[EvaluatedRun]:
    """Runs whose data set has the groups of their test split in its name, if runs on it have different ones."""
    runs = list(runs)
    folds: dict[str, set[tuple[str, ...]]] = {}
    for run in runs:
        folds.setdefault(run.data, set()).add(fold_of(run))
    return [
        replace(run, data=f"{run.data}, test {', '.join(fold_of(run))}")
        if len(folds[run.data]) > 1 and fold_of(run)
        else run
        for run in runs
    ]
