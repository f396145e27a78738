"""Runs -> tables with the paper's values beside (here) and figures (in ``figures``, which needs matplotlib)."""

from epo_lightning.report.runs import EvaluatedRun, collect
from epo_lightning.report.tables import build_tables
from epo_lightning.report.write import write_report

__all__ = ["EvaluatedRun", "build_tables", "collect", "write_report"]
