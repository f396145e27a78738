"""Selection of the best setting of a search by validation scores, with the overrides that train with it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from epo_lightning.registry import ConfigError
from epo_lightning.report.labels import natural, word
from epo_lightning.report.rows import BATCH, Row, plain_rows, require_comparable, setting
from epo_lightning.report.runs import EvaluatedRun

SEARCHED = ("optimizer", "backbone", "forecaster")
"""Sections whose settings are searched for the best value, like :data:`BATCH`; others are varied for comparison."""


@dataclass(frozen=True)
class BestSetting:
    """The best setting of an experiment.

    Attributes:
        row: runs and scores of the setting.
        metric: metric on the validation split that chose it.
        settings: its values by dotted key, of the searched settings and of those that the command of the search fixed.
        words: overrides that train with it: ``experiment=rpi/v_lstm optimizer.lr=0.0005``.
        compared: runs and scores of all settings compared, the best one included.
        left_out: labels of settings that lack seeds or have no finite score.
    """

    row: Row
    metric: str
    settings: Mapping[str, Any]
    words: str
    compared: tuple[Row, ...]
    left_out: tuple[str, ...]

    @property
    def title(self) -> str:
        return self.row.title

    @property
    def experiment(self) -> str:
        """Name of the experiment file; empty for none."""
        return self.row.runs[0].experiment

    @property
    def candidates(self) -> int:
        """Number of settings compared."""
        return len(self.compared)


def best_settings(runs: Iterable[EvaluatedRun], metric: str = "minSADE") -> list[BestSetting]:
    """The setting with the lowest mean over seeds on the validation split, for every experiment with several settings.

    A sweep over the optimisation steps, or over the number of modes, is not a search. A setting with fewer seeds than
    another is left out: a mean over one lucky seed must not win.

    Args:
        runs: evaluated runs of a search; scores on other splits are ignored.
        metric: score to minimise.

    Raises:
        ConfigError: no run was scored on the validation split, one lacks the metric, settings are not comparable, or none is
            complete.
    """
    experiments: dict[tuple[str, str, str], list[EvaluatedRun]] = {}
    for run in runs:
        if run.split == "val":
            experiments.setdefault((run.data, run.experiment, run.name), []).append(run)
    if not experiments:
        raise ConfigError("no run was scored on the validation split: run `epo evaluate runs=<folder> split=val`")
    searched = [(members, plain_rows(members)) for _, members in sorted(experiments.items())]
    return [_best(members, rows, metric) for members, rows in searched if any(map(_is_searched, rows[0].settings))]


def _is_searched(key: str) -> bool:
    return (key.split(".")[0] in SEARCHED and key != "forecaster.modes") or key == BATCH


def _best(runs: list[EvaluatedRun], rows: list[Row], metric: str) -> BestSetting:
    require_comparable(runs)
    for row in rows:
        if metric not in row.cells:
            raise ConfigError(
                f"{row.runs[0].path} has no score {metric}, which is needed to choose the setting; it has "
                f"{', '.join(row.cells)}"
            )
    seeds = {seed for row in rows for seed in row.seeds}
    whole = [row for row in rows if {*row.seeds} == seeds and math.isfinite(row.cells[metric].mean)]
    if not whole:
        raise ConfigError(
            f"no setting of {rows[0].title!r} has finite scores for all seeds {sorted(seeds)}: finish the search first"
        )
    best = min(whole, key=lambda row: (row.cells[metric].mean, natural(row.settings)))
    left_out = tuple(row.name for row in rows if row not in whole)
    settings = dict(sorted({**_fixed(best.runs[0]), **best.settings}.items()))
    return BestSetting(best, metric, settings, _words(best.runs[0], settings), tuple(whole), left_out)


def _fixed(run: EvaluatedRun) -> dict[str, Any]:
    """The settings of :data:`SEARCHED` sections that the command of a run gives: a search may fix some for all runs."""
    keys = (word.lstrip("+").partition("=")[0] for word in shlex.split(run.command))
    return {key: setting(run.config, key) for key in sorted({*keys}) if "." in key and _is_searched(key)}


def _words(run: EvaluatedRun, settings: Mapping[str, Any]) -> str:
    parts = [f"data={run.data}", f"backbone={run.backbone}", f"forecaster={run.forecaster}"]
    chosen = [f"experiment={run.experiment}"] if run.experiment else parts
    if run.experiment and run.config["data"].get("split") == "hard":
        chosen += [f"data={run.data}"]
    return " ".join([*chosen, *(word(key, value) for key, value in settings.items())])
