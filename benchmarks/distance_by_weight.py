"""How far agents of RPI keep apart in forecasts, against the true weight w of their interaction.

    python -m benchmarks.distance_by_weight runs/rpi/v_lstm_sc/reduced-s0 runs/rpi/v_lstm_epo/reduced-s0

The appendix of the paper says that its forecasts tell different weightings of collisions apart. Agents with a larger w
keep a larger distance. Compared are the smallest distances in the executed futures of the test split and in the joint
modes that are closest to them: their rank correlations with w, and their means in the games with the smallest and the
largest w. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.rpi_runs import forecasts


@dataclass(frozen=True)
class Distances:
    """Smallest distances [m] of the agents in one kind of futures.

    Attributes:
        correlation: rank correlation with the true w; NaN if all records have the same w.
        least: mean over the records of the smallest w.
        most: mean over the records of the largest w.
    """

    correlation: float
    least: float
    most: float


def smallest(positions: Float[Tensor, "B 2 K 2"]) -> Float[Tensor, " B"]:
    """Smallest distance [m] of the two agents over time."""
    return (positions[:, 1] - positions[:, 0]).norm(dim=-1).amin(1)


def by_weight(distance: Float[Tensor, " B"], weight: Float[Tensor, " B"]) -> Distances:
    """Distances against the weight w."""
    varied = bool((weight != weight[0]).any())
    return Distances(
        correlation=float(stats.spearmanr(distance.numpy(), weight.numpy()).statistic) if varied else float("nan"),
        least=float(distance[weight == weight.min()].mean()),
        most=float(distance[weight == weight.max()].mean()),
    )


def measure(folder: str) -> dict[str, Distances]:
    """Distances in the executed futures and in the forecasts of a run, ``true`` and ``forecast``.

    Raises:
        ConfigError: no finished run on RPI, or its data is missing or has changed.
    """
    found = forecasts(folder)
    executed = found.futures[:, 0]
    closest = (found.modes - executed[:, None]).norm(dim=-1).mean((2, 3)).argmin(1)
    chosen = found.modes[torch.arange(len(closest)), closest]
    return {
        "true": by_weight(smallest(executed), found.weight),
        "forecast": by_weight(smallest(chosen), found.weight),
    }


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("distance_by_weight", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs on RPI")
    arguments = parser.parse_args(given)
    with measuring(parser):
        width = 2 + max(map(len, arguments.runs))
        print(f"{'run':<{width}}{'futures':<10}{'correlation':>12}{'smallest w':>12}{'largest w':>11}")
        for folder in arguments.runs:
            for kind, of in measure(folder).items():
                print(f"{folder:<{width}}{kind:<10}{of.correlation:>12.2f}{of.least:>12.3f}{of.most:>11.3f}")


if __name__ == "__main__":
    main()
