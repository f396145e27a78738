"""Time of a training step whose energy has a feature of the user: ``python -m benchmarks.own_features [--rounds R]``.

One feature is added to the energies of two rows, or of those after ``--rows``. An own feature is declared in three ways: as
an elementwise function of the speed, as a function of single steps (lateral acceleration), and as one of whole trajectories
(the same function). So is a pair feature: as an elementwise function of the distance, as one of single steps and as one of
whole trajectories (the gap of discs in all three). Batches are 32 drawn scenes of the row's shape. Times are CPU times of
one thread, medians over rounds in which the energies take turns.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.command_line import parser_of
from benchmarks.measure import interleaved, positive
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecasters import Forecaster
from epo_lightning.game.features import Source, own_feature, pair_feature
from epo_lightning.scene import SPEED, TURN_RATE
from epo_lightning.schema import read

ROWS = ("rpi/v_lstm_epo", "highway/v_lstm_epo")


def lateral_acceleration(states: Tensor, controls: Tensor) -> Tensor:
    """Lateral acceleration v omega [m/s^2]."""
    return states[..., SPEED] * controls[..., TURN_RATE]


def excess(speed: Tensor) -> Tensor:
    """The amount by which the speed exceeds 1 m/s."""
    return (speed - 1.0).relu()


def missing_gap(distance: Tensor, reach: Tensor) -> Tensor:
    """The amount by which the gap of two discs is less than 1 m."""
    return (reach + 1.0 - distance).relu()


def missing_gap_of_states(one: Tensor, other: Tensor, size: Tensor, other_size: Tensor) -> Tensor:
    """The same as a function of states."""
    distance = (one[..., :2] - other[..., :2]).square().sum(-1).add(1e-12).sqrt()
    return missing_gap(distance, 0.5 * (size + other_size)[..., 0])


ADDED: dict[tuple[str, Source], tuple[Callable[..., Tensor], str | None]] = {
    ("own", Source.SPEED): (excess, None),
    ("own", Source.STEP): (lateral_acceleration, None),
    ("own", Source.TRAJECTORY): (lateral_acceleration, None),
    ("pair", Source.DISTANCE): (missing_gap, None),
    ("pair", Source.STEP): (missing_gap_of_states, "size"),
    ("pair", Source.TRAJECTORY): (missing_gap_of_states, "size"),
}
"""The added feature, and what it needs, by kind and declaration."""


def step(row: str, added: tuple[str, Source] | None) -> Callable[[], Any]:
    """A training step of a row, forward and backward, with an energy that has one more feature."""
    words = [f"experiment={row}", "data=drawn"]
    if added is not None:
        kind, source = added
        name, (function, needs) = f"added_{kind}_{source.value}", ADDED[added]
        (own_feature(name, source) if kind == "own" else pair_feature(name, source, needs))(function)
        words.append(f"energy.{kind}=[{','.join([*compose('train', words)['energy'][kind], name])}]")
    settings = read(Settings, compose("train", words))
    data = assembly.build_data(settings.data)
    model = assembly.build_model(settings, data).train()
    assert isinstance(model, Forecaster)
    data.setup("fit")
    batches = itertools.cycle(itertools.islice(iter(data.train_dataloader()), 4))

    def take() -> None:
        model.weighted_losses(next(batches))[0].backward()
        model.zero_grad()

    return take


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("own_features", __doc__)
    parser.add_argument("--rounds", type=positive, default=9, help="rounds, of which medians are taken")
    parser.add_argument("--rows", nargs="+", default=ROWS, help="experiments whose energies get the features")
    arguments = parser.parse_args(given)
    torch.set_num_threads(1)
    named = [f"+ {kind}, {source.name}" for kind, source in ADDED]
    print("| training step [ms] | built-in features | " + " | ".join(named) + " |")
    print("|:--|" + "--:|" * (1 + len(ADDED)))
    for row in arguments.rows:
        times = interleaved({added: step(row, added) for added in (None, *ADDED)}, arguments.rounds)
        print(f"| {row} | " + " | ".join(f"{time.cpu:.1f}" for time in times.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
