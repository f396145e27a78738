"""Scores of trained runs for agents that turn and for the others, on the test split of their data.

    python -m benchmarks.turning runs/urban/v_lstm_epo/short-s0 runs/urban/v_lstm_sc/short-s0

An agent turns if its heading changes by more than 30 degrees from t0 to its last future state, as in ``benchmarks.goals``.
Scores are those of ``epo evaluate`` with all other agents left out of the scene, as means over the scenes that have such an
agent; the forecasts are of whole scenes. Nothing is written.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.goals import TURNING
from benchmarks.runs import opened
from epo_lightning.experiment.opening import open_data, split_of
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, Scene

SCORES = {"minADE": "ADE", "minFDE": "FDE", "minSADE": "SADE", "minSFDE": "SFDE"}
"""Displacements [m] and their headings."""


def turning(scene: Scene) -> tuple[Bool[Tensor, "B N"], Bool[Tensor, "B N"]]:
    """Masks of the agents that turn, and of the others; agents without a known end are in neither."""
    if scene.future is None or scene.future_mask is None:
        raise ConfigError("agents that turn are found by their futures, which these scenes do not have")
    known = scene.agent_mask & scene.future_mask[..., -1]
    turns = (scene.future[..., -1, HEADING] - scene.current[..., HEADING]).abs() > TURNING
    return known & turns, known & ~turns


@torch.no_grad()
def scores(folder: str) -> tuple[str, dict[str, tuple[int, Mapping[str, float]]]]:
    """Title of a run, and for ``turning`` and ``others`` the number of agents and their scores.

    Raises:
        ConfigError: no finished run, or its data is missing or has changed.
    """
    run, settings, forecaster = opened(folder)
    data = open_data(run, settings, 256)
    metrics = {name: ForecastMetrics(shape=data.task.shape) for name in ("turning", "others")}
    counts = dict.fromkeys(metrics, 0)
    for scene in split_of(data, "test"):
        forecast = forecaster.predict(scene)
        for name, members in zip(metrics, turning(scene), strict=True):
            counts[name] += int(members.sum())
            rows = members.any(1).nonzero().flatten()
            if len(rows):
                metrics[name].update(forecast[rows], dataclasses.replace(scene[rows], agent_mask=members[rows]))
    found = {name: {key: float(value) for key, value in of.compute().items()} for name, of in metrics.items()}
    return f"{settings.title}, seed {settings.seed}", {name: (counts[name], found[name]) for name in metrics}


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("turning", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs on recorded data")
    arguments = parser.parse_args(given)
    with measuring(parser):
        print(f"{'run':<36}{'agents':<9}{'number':>7}" + "".join(f"{label:>8}" for label in SCORES.values()))
        for folder in arguments.runs:
            title, found = scores(folder)
            for name, (count, values) in found.items():
                print(f"{title:<36}{name:<9}{count:>7}" + "".join(f"{values[metric]:>8.3f}" for metric in SCORES))


if __name__ == "__main__":
    main()
