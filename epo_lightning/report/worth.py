"""Worth of the game: the scores of a row beside those of its twin without pair terms.

The agents of an inferred game interact through its pair terms (``energy.pair``) alone. Two rows whose recorded
configurations are equal in everything else show what these terms contribute to the forecasts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from epo_lightning.identity import canonical, essence
from epo_lightning.report.columns import Column
from epo_lightning.report.rows import Row
from epo_lightning.report.statistics import Comparisons, compare_rows
from epo_lightning.report.tables import Table, subset_columns

WORTH = (Column("minSADE", "SADE"), Column("minSFDE", "SFDE"), Column("overlap_jfp", "OR (JFP)"))
"""Scores of joint forecasts, which the interaction of agents can change; they are compared on every subset as well."""

LEGEND = (
    "What the game is worth: a row minus its twin, which was trained with the same settings except that its energy has "
    "fewer pair terms (`energy.pair`). Negative differences are in favour of the pair terms. They are paired by seed like "
    "the other tests. A run records means over scenes, not the scores of single scenes: the interval is over trainings "
    "with different seeds, not over scenes."
)


def build_worth(tables: Iterable[Table]) -> list[Comparisons]:
    """Comparisons of each row with its twins that have fewer pair terms, for every main table.

    Rows without a twin do not appear; a table without twins gives no comparisons.
    """
    found = []
    for table in (table for table in tables if table.main):
        columns = (*WORTH, *subset_columns(table.rows, WORTH))
        metrics = [column.metric for column in columns]
        pairs = tuple(compare_rows(one, other, metrics) for one, other in twins(table.rows))
        if pairs:
            found.append(Comparisons(f"{table.title}: what the game is worth, seed by seed", columns, pairs))
    return found


def twins(rows: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Pairs of rows whose configurations differ in ``energy.pair`` alone, in the order of the first rows.

    The pair terms of the second row are a proper subset of those of the first, usually the empty one.
    """
    families: dict[str, list[tuple[Row, frozenset[str]]]] = {}
    for row in rows:
        config = row.runs[0].config
        names = pair_terms(config)
        if names is not None:
            families.setdefault(_without_pairs(config), []).append((row, names))
    order = {row.identity: place for place, row in enumerate(rows)}
    found = [
        (one, other)
        for family in families.values()
        for one, names in family
        for other, fewer in family
        if fewer < names
    ]
    return sorted(found, key=lambda pair: (order[pair[0].identity], order[pair[1].identity]))


def pair_terms(config: Mapping[str, Any]) -> frozenset[str] | None:
    """Names of the pair terms of a configuration's energy; None for energies without such a list, and other forecasters."""
    pair = (config.get("energy") or {}).get("pair")
    forecaster = (config.get("forecaster") or {}).get("name")
    return frozenset(map(str, pair)) if forecaster == "epo" and isinstance(pair, list | tuple) else None


def _without_pairs(config: Mapping[str, Any]) -> str:
    """Text that is equal for configurations that differ only in their seed and in ``energy.pair``."""
    whole = essence({**config, "seed": None})
    return canonical({**whole, "energy": {key: value for key, value in whole["energy"].items() if key != "pair"}})
