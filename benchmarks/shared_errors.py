"""Shared errors of forecasters on RPI: what part of an error do other trainings make as well?

    python -m benchmarks.shared_errors runs/rpi/v_lstm_sc_relaxed/reduced-s3 runs/rpi/v_lstm_sc_relaxed/reduced-s4 ...

Two trainings that start from different random numbers make errors of their own, which more training or another method may
remove, and the same error where the history does not tell them what they would have to know, such as the weight w of the
interaction. Printed are, for executed and alternative futures, the root mean square e of every run's error [m], and the
correlations of the errors of every two runs,

    mean(e_i e_j) / sqrt(mean(e_i^2) mean(e_j^2)),

where e is the displacement of an agent's last position in the closest joint mode from the future, and e_i e_j an inner
product. Means are over agents and records. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.rpi_runs import forecasts
from epo_lightning.data.cache import SPLITS
from epo_lightning.data.rpi.scenes import SUBSETS
from epo_lightning.registry import ConfigError


def correlations(errors: Sequence[Float[Tensor, "B N 2"]]) -> Float[Tensor, "R R"]:
    """Correlations, about zero, of the errors [m] of every two runs."""
    units = torch.nn.functional.normalize(torch.stack([error.double().flatten() for error in errors]), dim=1)
    return units @ units.T


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("shared_errors", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs on the same data of RPI")
    parser.add_argument("--split", choices=SPLITS, default="test", help="which records")
    arguments = parser.parse_args(given)
    with measuring(parser):
        found = [forecasts(folder, arguments.split) for folder in arguments.runs]
        for folder, of_run in zip(arguments.runs, found, strict=True):
            if not torch.equal(of_run.futures, found[0].futures):
                raise ConfigError(f"{folder} has other data than {arguments.runs[0]}: name runs on the same data")
        for number, folder in enumerate(arguments.runs):
            print(f"run {number}: {folder}")
        for side, name in enumerate(SUBSETS):
            errors = [of_run.missed(side)[of_run.having(side)] for of_run in found]
            print(f"{name} futures: rms [m], and correlations with runs 0 to {len(found) - 1}")
            for number, (error, row) in enumerate(zip(errors, correlations(errors), strict=True)):
                rms = float(error.double().square().sum(-1).mean().sqrt())
                print(f"  run {number}: {rms:.4f}  " + " ".join(f"{value:5.2f}" for value in row.tolist()))


if __name__ == "__main__":
    main()
