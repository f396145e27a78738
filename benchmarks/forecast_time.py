"""Time of a forecast by the forecasters that ship with the package: ``python -m benchmarks.forecast_time [NAME ...]``.

Each forecasts its example scenes, one at a time and all at once; a forecast has network, calibration and solver. Times are
CPU times of one thread, over rounds in which the forecasters take turns.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import torch

from benchmarks.command_line import parser_of
from benchmarks.measure import cpu_milliseconds, positive
from epo_lightning import load, pretrained
from epo_lightning.forecasters import Forecaster
from epo_lightning.scene import Scene


def milliseconds(forecaster: Forecaster, scenes: Scene) -> float:
    """CPU time per scene of a forecast of some scenes."""
    return cpu_milliseconds(lambda: forecaster.predict(scenes), len(scenes.history))[1]


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("forecast_time", __doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="shipped forecasters; all of them by default")
    parser.add_argument("--rounds", type=positive, default=3, help="rounds over all example scenes")
    arguments = parser.parse_args(given)
    torch.set_num_threads(1)
    names = arguments.names or pretrained.names()
    for name in names:
        if name not in pretrained.names():
            raise SystemExit(f"no forecaster {name!r} ships with the package, only {', '.join(pretrained.names())}")
    ready = [(name, load(name), pretrained.examples(name)) for name in names]
    single: dict[str, list[float]] = {name: [] for name in names}
    together: dict[str, list[float]] = {name: [] for name in names}
    for round_ in range(arguments.rounds + 1):
        for name, forecaster, scenes in ready:
            count = len(scenes.history)
            one_by_one = [milliseconds(forecaster, scenes[torch.tensor([row])]) for row in range(count)]
            at_once = milliseconds(forecaster, scenes)
            if round_ > 0:  # the first round fills caches
                single[name] += one_by_one
                together[name].append(at_once)
    for name in names:
        nine_tenths = statistics.quantiles(single[name], n=10)[-1]
        print(
            f"{name:28} one scene {statistics.median(single[name]):5.1f} ms, nine tenths below {nine_tenths:5.1f} ms;  "
            f"in a batch {statistics.median(together[name]):5.2f} ms per scene"
        )


if __name__ == "__main__":
    main()
