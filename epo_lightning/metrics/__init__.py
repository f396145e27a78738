"""Metrics of a forecast (Section 5, Metrics): definitions in ``functional``, and a torchmetrics class that adds them up."""

from epo_lightning.metrics.forecast import METRICS, ForecastMetrics

__all__ = ["METRICS", "ForecastMetrics"]
