"""Rows of the tables of a folder of runs, by name."""

from __future__ import annotations

from pathlib import Path

from epo_lightning.report.rows import Row
from epo_lightning.report.runs import collect
from epo_lightning.report.tables import build_tables


def rows_of(folder: Path) -> dict[str, Row]:
    return {row.name: row for row in build_tables(collect(folder))[0].rows}
