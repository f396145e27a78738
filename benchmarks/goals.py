"""Distance from agents' true ends to their nearest goal candidate, for agents that turn and for the others.

    python -m benchmarks.goals data=lankershim data.folder=/data/lankershim

The words are those of ``epo generate``; the data set is extracted if it does not exist. The distance is that of an oracle
that chooses the best candidate: no forecaster that chooses among the candidates can end nearer on average. An agent turns if
its heading changes by more than 30 degrees from t0 to its last future state.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from epo_lightning.data import cache
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.summary import distance_to_goals
from epo_lightning.data.recorded.tables import SceneTables
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.registry import ConfigError

TURNING = math.radians(30)
"""Smallest change of heading [rad] of an agent that turns."""
FAR = 5.0
"""Distance [m] above which a goal is missed."""


def oracle(tables: SceneTables) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Distance [m] of every agent with a known end to its nearest goal candidate, and whether the agent turns."""
    known = tables.future_mask[:, -1]
    turned = tables.future[:, -1, 2] - tables.history[:, -1, 2]
    return distance_to_goals(tables)[known], (np.abs(turned) > TURNING)[known]


def table(distance: Float[np.ndarray, " n"], turns: Bool[np.ndarray, " n"]) -> list[str]:
    """Lines of a table: mean and 95th percentile of the distance, and the share of missed goals."""
    lines = [f"{'agents':<12}{'number':>8}{'mean [m]':>10}{'95 % [m]':>10}{f'over {FAR:g} m':>10}"]
    for name, of in (("turning", turns), ("others", ~turns), ("all", np.ones_like(turns))):
        if of.any():
            chosen = distance[of]
            high, share = np.percentile(chosen, 95), (chosen > FAR).mean()
            lines.append(f"{name:<12}{of.sum():>8}{chosen.mean():>10.2f}{high:>10.2f}{share:>10.1%}")
    return lines


def main(given: Sequence[str] | None = None) -> None:
    """The command line.

    Raises:
        ConfigError: data without goal candidates, or settings that ``epo generate`` refuses.
    """
    words = list(sys.argv[1:] if given is None else given)
    if not words or "--help" in words:
        print(__doc__)
        return
    config = compose("generate", words)
    data = assembly.build_data(config["data"])
    if not isinstance(data, RecordedData) or not data.task.map:
        raise ConfigError("benchmarks.goals measures recorded data with a map: choose data=lankershim or data=us101")
    data.generate(workers=config["workers"], progress=False)
    found = []
    for split in data.report()["recordings"]:
        loaded = cache.load(data.folder, split, command=data.command, config=data.config)
        found.append(oracle(SceneTables(**{name: values.numpy() for name, values in loaded.items()})))
    distance, turns = (np.concatenate(values) for values in zip(*found, strict=True))
    print(f"{data.dataset_name}, digest {data.digest}, {data.task.candidates} candidates")
    print("\n".join(table(distance, turns)))


if __name__ == "__main__":
    try:
        main()
    except ConfigError as error:
        sys.exit(f"benchmarks.goals: {error}")
