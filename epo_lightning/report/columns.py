"""Columns of the tables: their metrics, and how numbers are printed in them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

MISSING = "-"
"""Text of a cell without a value."""


@dataclass(frozen=True)
class Column:
    """One column of a table: its metric and its heading."""

    metric: str
    label: str

    @property
    def digits(self) -> int:
        """Number of decimals: four for overlap rates, so that one overlap in 6000 scenes is visible, else three."""
        return 4 if "overlap" in self.metric else 3

    @property
    def ranked(self) -> bool:
        """Whether rows are ranked by it; energies and their gradients and gaps have different units in each row, the
        effect of pair terms is neither good nor bad, of a correlation with the truth more is better, and of a registered
        metric it is not known."""
        return not (self.metric in OWN_UNITS or self.is_effect or self.metric.startswith(TRUE) or is_own(self.metric))

    @property
    def is_effect(self) -> bool:
        """Whether it shows the effect of pair terms, of all scenes or of a subset."""
        return self.metric.split("/")[-1] == PAIR_EFFECT

    def text(self, value: float) -> str:
        """A value as tables print it: metrics of the game with three significant digits, others with fixed decimals."""
        return significant(value) if self.metric in GAME else number(value, self.digits)

    def deviation(self, value: float, mean: float) -> str:
        """A deviation from a mean, with the decimals of the mean."""
        if self.metric in GAME or math.isnan(value) or math.isnan(mean):
            return self.text(value)
        return f"{value:.{decimals(mean, self.digits)}f}"

    def long_text(self, value: float) -> str:
        """A value with six digits."""
        return f"{value:.6g}" if self.metric in GAME and not math.isnan(value) else number(value, 6)


INTERACTIVE = "interactive"
"""Name of the subset of scenes in which agents interact (:data:`epo_lightning.metrics.functional.interaction.SUBSETS`)."""
PAIR_EFFECT = "pair_effect"
"""Metric of the displacement [m] that the pair terms of a game make."""
OWN_UNITS = ("energy_initial", "energy_solved", "energy_optimum", "gradient_norm", "nash_gap")
GAME = (*OWN_UNITS, "nash_gap_relative")
"""Metrics of the game that a forecaster solves; those of ``OWN_UNITS`` have the units of the row's own energy."""


LEAST = 1e-6
"""Numbers below this one are printed as zero."""


def number(value: float, digits: int) -> str:
    """A number with fixed decimals, or more if it would be a zero that it is not; a dash for nan."""
    return MISSING if math.isnan(value) else f"{value:.{decimals(value, digits)}f}"


def decimals(value: float, digits: int) -> int:
    """Decimals of a number: ``digits``, or those of two significant digits if it would be rounded to zero, down to 1e-6."""
    return digits if round(value, digits) or abs(value) < LEAST else 1 - math.floor(math.log10(abs(value)))


def significant(value: float) -> str:
    """A number with three digits or more: ``1534``, ``15.3``, ``0.00153``, ``1.5e-05``; a dash for nan."""
    if math.isnan(value):
        return MISSING
    rounded = float(f"{value:.3g}")
    if rounded and not 1e-3 <= abs(rounded) < 1e5:
        return f"{value:.1e}"
    digits = 2 - math.floor(math.log10(abs(rounded))) if rounded else 0
    return f"{value:.{max(digits, 0)}f}"


MAIN = (
    Column("minADE", "ADE"),
    Column("minFDE", "FDE"),
    Column("minSADE", "SADE"),
    Column("minSFDE", "SFDE"),
    Column("overlap_jfp", "OR (JFP)"),
    Column("overlap_authors", "OR (authors)"),
)

EQUILIBRIUM = (
    Column("energy_initial", "energy, initial"),
    Column("energy_solved", "energy, solved"),
    Column("energy_optimum", "energy, optimum"),
    Column("gradient_norm", "gradient norm"),
    Column("nash_gap", "Nash gap"),
    Column("nash_gap_relative", "Nash gap, relative"),
)

STOPPED = "stopped"
"""Metric of the share of joint modes that do not meet their hard constraints."""

TRUE = "true_"
"""Beginning of the names of metrics that compare inferred costs with the true ones."""

OWN = "own/"
"""Beginning of the names of metrics that users have registered: ``own/jerk``, of a subset ``executed/own/jerk``."""


def is_own(metric: str) -> bool:
    """Whether a user has registered the metric."""
    return f"/{OWN}" in f"/{metric}"


TRUTH = (
    Column(f"{TRUE}pair_rank", "w: rank correlation"),
    Column(f"{TRUE}pair_error", "w: median error"),
    Column(f"{TRUE}goal_error", "goal: median error"),
    Column(f"{TRUE}vel_error", "speed: median error"),
)

PROBABILITIES = (
    Column("minSADE_1", "SADE, k=1"),
    Column("brier_minSADE", "brier-SADE"),
    Column("ECE", "ECE"),
)

ALTERNATIVES = ("executed", "alternative")
"""Subsets that are known alternatives of the same scenes, of which a forecast should miss none."""

OF_ALTERNATIVES = (Column("minSADE_1", "SADE, k=1"), Column("missed", "missed"))

OF_MODES = re.compile(r"minSADE_(\d+)")
"""Names of the metrics minSADE among the k most likely joint modes."""
