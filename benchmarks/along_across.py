"""Final errors of trained runs along and across the direction of travel, in the closest joint mode of every test scene.

    python -m benchmarks.along_across runs/us101/v_lstm_sc/short-s0 runs/us101/v_lstm_epo/short-s0

The direction is each agent's true heading at its last future state. Errors are means over scenes of means over agents: their
size, and along the direction also with their sign, which is positive where forecasts are too far ahead. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.runs import name_of, opened
from epo_lightning.experiment.opening import open_data, split_of
from epo_lightning.forecast import JointForecast
from epo_lightning.metrics.functional.displacement import closest_mode
from epo_lightning.registry import ConfigError
from epo_lightning.scene import HEADING, Scene

COLUMNS = ("along", "across", "ahead")
"""Mean size of the error along and across the direction of travel, and mean error along it with its sign [m]."""


def errors(scene: Scene, forecast: JointForecast) -> Float[Tensor, "B 3"]:
    """The values of :data:`COLUMNS` for every scene with a known final state; other scenes are left out.

    Raises:
        ConfigError: the scenes have no futures.
    """
    if scene.future is None or scene.future_mask is None:
        raise ConfigError("errors need the futures of the agents, which these scenes do not have")
    mask = scene.future_mask & scene.agent_mask[..., None]
    mode = closest_mode(forecast.states, scene.future, mask)
    end = forecast.states[torch.arange(len(mode), device=mode.device), mode, :, -1, :2]
    true = scene.future[..., -1, :]
    error, direction = end - true[..., :2], true[..., HEADING]
    along = error[..., 0] * direction.cos() + error[..., 1] * direction.sin()
    across = error[..., 1] * direction.cos() - error[..., 0] * direction.sin()
    counted = mask[..., -1]
    values = torch.stack((along.abs(), across.abs(), along), -1).where(counted[..., None], 0.0)
    known = counted.any(1)
    return values[known].sum(1) / counted[known].sum(1, keepdim=True)


@torch.no_grad()
def scores(folder: str) -> tuple[str, int, list[float]]:
    """Name of a run, its number of scenes, and the values of :data:`COLUMNS`.

    Raises:
        ConfigError: no finished run, or its data is missing or has changed.
    """
    run, settings, forecaster = opened(folder)
    data = open_data(run, settings, 256)
    found = torch.cat([errors(scene, forecaster.predict(scene)) for scene in split_of(data, "test")])
    return name_of(settings, "test"), len(found), found.mean(0).tolist()


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("along_across", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs")
    arguments = parser.parse_args(given)
    with measuring(parser):
        print(f"{'scenes':>7}" + "".join(f"{name:>8}" for name in COLUMNS) + "  run")
        for folder in arguments.runs:
            name, count, found = scores(folder)
            print(f"{count:>7}" + "".join(f"{value:>8.3f}" for value in found) + f"  {name}")


if __name__ == "__main__":
    main()
