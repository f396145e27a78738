"""Which joint mode of trained runs serves which side on which the agents of RPI may pass each other.

    python -m benchmarks.passing_sides runs/rpi/v_lstm_sc/reduced-s0 runs/rpi/v_lstm_epo/reduced-s0

A record of RPI with two equilibria has an executed and an alternative future, on two sides. A run has taught both sides of a
record if different joint modes are closest to its two futures. If one mode is closest to both, the paper's loss teaches the
other mode nothing in this record. Records of the test split are counted by the side of their executed future, because a
run may have taught both sides in the one kind of record and one side in the other. Nothing is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.rpi_runs import forecasts
from epo_lightning.registry import ConfigError


@dataclass(frozen=True)
class Served:
    """Means over the records whose executed future passes on one side.

    Attributes:
        records: number of records.
        by_one: share of the records in which one joint mode is the closest to both futures.
        executed: distance [m] of the closest mode from the executed future.
        alternative: the same for the alternative future.
        other: distance [m] from the executed future of the mode that is not the closest to it.
    """

    records: int
    by_one: float
    executed: float
    alternative: float
    other: float


def turns_left(positions: Float[Tensor, "B 2 K 2"]) -> Bool[Tensor, " B"]:
    """Whether the line of sight from agent 0 to agent 1 turns counter-clockwise in total."""
    way = positions[:, 1] - positions[:, 0]
    before, after = way[:, :-1], way[:, 1:]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    return torch.atan2(cross, (before * after).sum(-1)).sum(-1) > 0


def served(
    forecast: Float[Tensor, "B M N K 2"], futures: Float[Tensor, "B 2 N K 2"], left: Bool[Tensor, " B"]
) -> dict[str, Served]:
    """Means by the side of the executed future, ``left`` and ``right``; sides without records are left out.

    Args:
        forecast: positions [m] of the M = 2 joint modes.
        futures: positions [m] of the executed and the alternative future.
        left: whether the executed future passes on the left.
    """
    distance = (forecast[:, :, None] - futures[:, None]).norm(dim=-1).mean((3, 4))  # [B, M, 2 futures]
    closest, mode = distance.min(1)
    groups = {"left": left, "right": ~left}
    return {
        name: Served(
            records=int(group.sum()),
            by_one=float((mode[group, 0] == mode[group, 1]).double().mean()),
            executed=float(closest[group, 0].mean()),
            alternative=float(closest[group, 1].mean()),
            other=float(distance[group, :, 0].amax(1).mean()),
        )
        for name, group in groups.items()
        if group.any()
    }


def measure(folder: str) -> dict[str, Served]:
    """Means of a run on the test split of its data, by the side of the executed future.

    Raises:
        ConfigError: no finished run on RPI with two modes, its data is missing or has changed, or no record has two
            equilibria.
    """
    found = forecasts(folder)
    if found.modes.shape[1] != 2:
        raise ConfigError(f"{folder} has {found.modes.shape[1]} joint modes, but two are compared with two equilibria")
    if not found.both.any():
        raise ConfigError(f"no test record of {folder} has two equilibria: generate more games")
    modes, futures, start = found.modes[found.both], found.futures[found.both], found.start[found.both]
    return served(modes, futures, turns_left(torch.cat((start[:, :, None], futures[:, 0]), 2)))


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("passing_sides", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs on RPI")
    arguments = parser.parse_args(given)
    with measuring(parser):
        width = 2 + max(map(len, arguments.runs))
        print(f"{'run':<{width}}{'side':<6}{'records':>8}{'by one':>8}{'executed':>10}{'alternative':>12}{'other':>7}")
        for folder in arguments.runs:
            for side, of in measure(folder).items():
                print(
                    f"{folder:<{width}}{side:<6}{of.records:>8}{of.by_one:>8.2f}{of.executed:>10.3f}"
                    f"{of.alternative:>12.3f}{of.other:>7.3f}"
                )


if __name__ == "__main__":
    main()
