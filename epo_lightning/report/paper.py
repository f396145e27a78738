"""Results of the paper, which tables and figures show beside ours.

Keys are (data, backbone, forecaster) by their registered names. Displacements in m, overlap rates in [0, 1], runtimes in s.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

METRICS = ("minADE", "minFDE", "minSADE", "minSFDE", "overlap_jfp")

PAPER: dict[tuple[str, str, str], tuple[float, ...]] = {
    # Table 2: the RPI test split, M = 2.
    ("rpi", "v_lstm", "marginal"): (0.12, 0.20, 0.13, 0.23, 0.006),
    ("rpi", "v_lstm", "scene_consistent"): (0.04, 0.11, 0.04, 0.11, 0.001),
    ("rpi", "v_lstm", "epo"): (0.03, 0.08, 0.03, 0.08, 0.000),
    # Table 3: the exiD test split, M = 5.
    ("exid", "v_lstm", "constant_velocity"): (1.16, 2.87, 1.16, 2.87, 0.010),
    ("exid", "v_lstm", "marginal"): (1.25, 3.64, 1.98, 3.90, 0.031),
    ("exid", "v_lstm", "scene_consistent"): (0.82, 1.95, 1.07, 2.63, 0.010),
    ("exid", "v_lstm", "epo"): (0.80, 1.89, 0.99, 2.37, 0.008),
    ("exid", "vibes", "marginal"): (1.35, 1.68, 1.93, 2.93, 0.021),
    ("exid", "vibes", "scene_consistent"): (0.73, 1.71, 1.01, 2.47, 0.007),
    ("exid", "vibes", "epo"): (0.83, 1.99, 0.99, 2.40, 0.006),
    ("exid", "hivt_m", "marginal"): (1.83, 2.02, 2.39, 2.86, 0.013),
    ("exid", "hivt_m", "scene_consistent"): (0.78, 1.90, 1.04, 2.57, 0.008),
    ("exid", "hivt_m", "epo"): (0.83, 1.97, 1.03, 2.48, 0.007),
}
"""Values by row, in the order of ``METRICS``. The paper defines its overlap rate as JFP does, so its value stands beside
``overlap_jfp``; the authors' later code computes ``overlap_authors``, which is half of that for two agents."""


ABLATIONS: dict[str, tuple[float, ...]] = {
    # Table 4. The text of the paper says V-LSTM, but the row "Ours (full)" equals that of VIBES in Table 3.
    "exid/v_lstm_epo_no_init": (0.89, 2.04, 1.01, 2.47, 0.007),
    "exid/v_lstm_epo_no_goal": (0.89, 2.13, 1.10, 2.64, 0.009),
}
"""Rows whose backbone and forecaster equal those of a main row: only the experiment tells them apart."""


STEPS: dict[int, dict[str, float]] = {
    1: {"minSADE": 0.046, "initial/minSADE": 0.0573},
    2: {"minSADE": 0.045, "initial/minSADE": 0.055},
    4: {"minSADE": 0.038, "initial/minSADE": 0.065},
    8: {"minSADE": 0.038, "initial/minSADE": 0.066},
}
"""Figure over the solver's steps S: optimised and initial strategies of V-LSTM + Ours, RPI validation split."""

TABLE_STEPS = 2
"""S of the paper's tables."""


RUNTIME: dict[tuple[int, int], float] = {
    (agents, steps): seconds
    for steps, row in {
        1: (0.08, 0.09, 0.11, 0.12),
        2: (0.10, 0.12, 0.14, 0.14),
        4: (0.16, 0.17, 0.21, 0.26),
        8: (0.25, 0.27, 0.31, 0.32),
        12: (0.35, 0.36, 0.45, 0.46),
    }.items()
    for agents, seconds in zip((2, 4, 8, 12), row, strict=True)
}
"""Runtime heat map: mean seconds of a forecast by (N, S), 100 exiD samples, M = 4."""

RUNTIME_MODES: dict[int, float] = {1: 0.169, 2: 0.170, 4: 0.172, 8: 0.174, 12: 0.175}
"""Lower panel of the runtime figure: seconds by M, S = 2, N = 4. Its value at M = 4 differs from the heat map's 0.12."""


PARTS = {
    "energy": "features",
    "solver": "levenberg_marquardt",
    "backward": "unrolled",
    "objective": "imitation",
}
"""Parts of the paper's own method ("Ours"); other methods of the paper's Table 1 share its forecaster."""


def is_papers(forecaster: str, config: Mapping[str, Any]) -> bool:
    """Whether a row uses the parts of the paper's method; parts that older runs do not name count as the paper's."""
    if forecaster != "epo":
        return True
    return all((config.get(kind) or {}).get("name", name) == name for kind, name in PARTS.items())


def interacts(config: Mapping[str, Any]) -> bool:
    """Whether the energy of a row has pair terms; False for the ablation without any, which the paper does not have."""
    return (config.get("energy") or {}).get("pair") != []


def papers_name(data: str) -> str:
    """A data set's name without the recipe and the kind of RPI's players, since the paper has one of each."""
    return re.sub(r"(, recipe \d+)?(, \S+ players)?$", "", data)


def has_values(data: str) -> bool:
    """Whether the paper has values for a data set (:func:`.runs.data_name`)."""
    return any(papers_name(data) == known for known, *_ in PAPER)


def paper_values(
    data: str,
    backbone: str,
    forecaster: str,
    goal: str,
    experiment: str,
    split: str = "test",
    steps: int | None = None,
) -> dict[str, float]:
    """The paper's values of a row by metric; empty where the paper has none.

    It does not say whether the networks of its rows read given goals; its values stand beside rows whose energies alone do.

    Args:
        data: name of the data set (:func:`.runs.data_name`); the paper's values are shown beside any recipe and players.
        split: ``test`` for the tables, ``val`` for the figure over S.
        steps: the solver's steps S; None for a forecaster without a solver.
    """
    if goal != "energy":
        return {}
    data = papers_name(data)
    if split == "val":
        return STEPS.get(steps or 0, {}) if (data, backbone, forecaster) == ("rpi", "v_lstm", "epo") else {}
    if split != "test" or (forecaster == "epo" and steps not in (None, TABLE_STEPS)):
        return {}
    values = ABLATIONS.get(experiment) or PAPER.get((data, backbone, forecaster), ())
    return dict(zip(METRICS, values, strict=False))
