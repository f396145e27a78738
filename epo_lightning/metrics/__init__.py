"""How good a forecast is (Section 5, Metrics): definitions, and torchmetrics classes that add them up."""

from epo_lightning.metrics.displacement import MinADE, MinFDE, MinSADE, MinSFDE
from epo_lightning.metrics.forecast import METRICS, ForecastMetrics
from epo_lightning.metrics.overlap import OverlapRate

__all__ = ["METRICS", "ForecastMetrics", "MinADE", "MinFDE", "MinSADE", "MinSFDE", "OverlapRate"]
