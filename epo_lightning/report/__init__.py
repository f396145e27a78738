"""Runs -> tables with the paper's values beside (here) and figures (in ``figures``, which needs matplotlib)."""

from epo_lightning.report.runs import EvaluatedRun, collect
from epo_lightning.report.tables import build_tables
from epo_lightning.report.write import Report, write_report

__all__ = ["EvaluatedRun", "Report", "build_tables", "collect", "write_report"]
