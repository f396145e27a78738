"""Errors on RPI by the placement of the pedestrian: does a forecaster do better where the placement tells w?

    python -m benchmarks.placements runs/rpi/v_lstm_sc_relaxed/reduced-s0 runs/rpi/v_lstm_epo_relaxed/reduced-s0
    python -m benchmarks.placements --split train runs/rpi/v_lstm_sc_relaxed/reduced-s0

In data of recipe 1 (docs/rpi.md) the angle of the first placement is a function of the weight w of the interaction. The last
placement is the mirror image of the first one: its angles are drawn from the mirrored arc, so without such knowledge both
are about equally difficult. Printed are SFDEs [m] of a split, for executed and alternative futures: distances of the last
positions to those of the closest joint mode, as means over agents and records. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.command_line import measuring, parser_of
from benchmarks.rpi_runs import Forecasts, forecasts
from epo_lightning.data.cache import SPLITS
from epo_lightning.data.rpi.scenes import SUBSETS

PLACES = ("first", "mirrored", "others")


def errors(found: Forecasts) -> dict[str, list[float]]:
    """SFDE [m] by side, in the first placement, its mirror image and the others; NaN where there is no record."""
    first, last = found.placement == 0, found.placement == found.placements - 1
    result = {}
    for side, name in enumerate(SUBSETS):
        missed, there = found.missed(side).norm(dim=-1).mean(1), found.having(side)
        result[name] = [float(missed[there & of].mean()) for of in (first, last & ~first, ~first & ~last)]
    return result


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("placements", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs on RPI")
    parser.add_argument("--split", choices=SPLITS, default="test", help="which records")
    arguments = parser.parse_args(given)
    with measuring(parser):
        width = 2 + max(map(len, arguments.runs))
        print(f"{'run':<{width}}{'futures':<13}" + "".join(f"{place:>10}" for place in PLACES))
        for folder in arguments.runs:
            for name, row in errors(forecasts(folder, arguments.split)).items():
                print(f"{folder:<{width}}{name:<13}" + "".join(f"{value:>10.4f}" for value in row))


if __name__ == "__main__":
    main()
