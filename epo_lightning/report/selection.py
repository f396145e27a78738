"""Selection of the best setting of a search by validation scores, with the overrides that train with it."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

from epo_lightning.checks import is_number
from epo_lightning.registry import ConfigError
from epo_lightning.report.labels import natural, value_text
from epo_lightning.report.rows import BATCH, Row, plain_rows, require_comparable, setting
from epo_lightning.report.runs import EvaluatedRun, data_option

SEARCHED = ("optimizer", "backbone", "forecaster")
"""Sections whose settings are searched for the best value, like :data:`BATCH`; others are varied for comparison."""
OF_MACHINE = ("data.root", "data.workers")
"""Words about data that say where and how they are made, and not what they are."""
FROZEN = "forecaster.frozen"
"""Path of the run that a refinement refines: another one for every seed, so that it belongs to no setting."""


@dataclass(frozen=True)
class BestSetting:
    """The best setting of an experiment.

    Attributes:
        row: runs and scores of the setting.
        metric: metric on the validation split that chose it.
        overrides: those of its searched settings, and of options and settings that the command of the search fixed.
        words: words of a command line that train with it: ``experiment=rpi/v_lstm optimizer.lr=0.0005``.
        compared: runs and scores of all settings compared, the best one included.
        left_out: the other settings, which lack seeds or have no finite score.
    """

    row: Row
    metric: str
    overrides: tuple[str, ...]
    words: str
    compared: tuple[Row, ...]
    left_out: tuple[Row, ...]

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


def at_edge(best: BestSetting) -> list[str]:
    """Notes on numbers of the best setting that are the smallest or the largest of three or more that were tried."""
    notes = []
    for key, value in best.row.settings.items():
        values = [row.settings.get(key, math.nan) for row in (*best.compared, *best.left_out)]
        tried: set[float] = {number for number in values if is_number(number) and math.isfinite(number)}
        if not (_is_searched(key) and is_number(value) and len(tried) > 2 and value in (min(tried), max(tried))):
            continue
        which, other = ("largest", "larger") if value == max(tried) else ("smallest", "smaller")
        if value != 0:
            notes.append(
                f"Best setting of {best.title}: {key}={value_text(value)} is the {which} of {len(tried)} values that were "
                f"tried; {other} ones may be better."
            )
    return notes


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
    left_out = tuple(row for row in rows if row not in whole)
    overrides = _overrides(best)
    words = " ".join(shlex.quote(word) for word in (*_row(best.runs[0], overrides), *overrides))
    return BestSetting(best, metric, overrides, words, tuple(whole), left_out)


def _overrides(row: Row) -> tuple[str, ...]:
    """Overrides for the settings of a row, and those of :data:`SEARCHED` sections in its command.

    A search may fix some settings for all of its runs, and may choose other options of these groups than the experiment.

    Raises:
        ConfigError: the recorded command is no command line.
    """
    run = row.runs[0]
    try:
        given = [word.partition("=") for word in shlex.split(run.command)]
    except ValueError as error:
        raise ConfigError(
            f"{run.path / 'run.json'}: command cannot be read ({error}): was it edited? Restore the file from a copy"
        ) from error
    texts, pluses = dict[str, str](), dict[str, str]()
    for start, _, value in given:
        key = start.lstrip("+")
        pluses[key] = start.removesuffix(key)  # of a setting that the chosen file leaves at its default
        if _is_searched(key):
            texts[key] = value_text(setting(run.config, key)) if "." in key else value
    texts |= {key: value_text(value) for key, value in row.settings.items()}
    texts.pop(FROZEN, None)
    return tuple(f"{pluses.get(key, '')}{key}={text}" for key, text in sorted(texts.items()))


def _row(run: EvaluatedRun, overrides: Iterable[str]) -> list[str]:
    """Overrides that choose the row of a run: its experiment or, without one, the parts that no other override chooses; and
    its data.
    """
    chosen = {_key(override) for override in overrides}
    if not run.experiment:
        parts = {"data": data_option(run.config["data"]), "backbone": run.backbone, "forecaster": run.forecaster}
        return [f"{group}={option}" for group, option in parts.items() if group not in chosen]
    given = {
        _key(word): word
        for before, word in pairwise(["", *shlex.split(run.command)])
        if re.match(r"\+*data[.=]", word) and before != "--config-dir" and _key(word) not in (*chosen, *OF_MACHINE)
    }
    section = run.config["data"]
    if "data" not in given and (given or section.get("split") == "hard"):
        given = {"data": f"data={data_option(section)}", **given}
    return [f"experiment={run.experiment}", *given.values()]


def _key(override: str) -> str:
    return override.lstrip("+").partition("=")[0]
