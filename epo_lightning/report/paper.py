"""What the paper reports, as data: the values that tables show beside ours.

Keys are (data, backbone, forecaster) in this project's names. Displacements in m, overlap rates as rates.
"""

from __future__ import annotations

PAPER: dict[tuple[str, str, str], dict[str, float]] = {
    # Table 1: the RPI test split, M = 2.
    ("rpi", "v_lstm", "marginal"): {
        "minADE": 0.12,
        "minFDE": 0.20,
        "minSADE": 0.13,
        "minSFDE": 0.23,
        "overlap_jfp": 0.006,
    },
    ("rpi", "v_lstm", "scene_consistent"): {
        "minADE": 0.04,
        "minFDE": 0.11,
        "minSADE": 0.04,
        "minSFDE": 0.11,
        "overlap_jfp": 0.001,
    },
    ("rpi", "v_lstm", "epo"): {
        "minADE": 0.03,
        "minFDE": 0.08,
        "minSADE": 0.03,
        "minSFDE": 0.08,
        "overlap_jfp": 0.000,
    },
}
"""The paper defines its overlap rate as JFP does, so its value stands beside ``overlap_jfp``; the authors' later code
counts as ``overlap_authors``, which is half of that for two agents."""


def paper_values(data: str, backbone: str, forecaster: str, goal: str) -> dict[str, float]:
    """The paper's row, empty where it has none: it gives a known goal to the energy only."""
    return PAPER.get((data, backbone, forecaster), {}) if goal == "energy" else {}
