"""Time of a training step whose energy has a feature of the user: ``python -m benchmarks.own_features [--rounds R]``.

One own feature is added to the energies of two rows, declared in three ways: as an elementwise function of the speed, as a
function of single steps (lateral acceleration), and as one of whole trajectories (the same function). The batches are 32
drawn scenes of the row's shape. Times are CPU times of one thread, medians over rounds in which the energies take turns.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.measure import interleaved, positive
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecasters import Forecaster
from epo_lightning.game.features import Source, own_feature
from epo_lightning.scene import SPEED, TURN_RATE
from epo_lightning.schema import read

ROWS = ("rpi/v_lstm_epo", "highway/v_lstm_epo")


def lateral_acceleration(states: Tensor, controls: Tensor) -> Tensor:
    """Lateral acceleration v omega [m/s^2]."""
    return states[..., SPEED] * controls[..., TURN_RATE]


def excess(speed: Tensor) -> Tensor:
    """The amount by which the speed exceeds 1 m/s."""
    return (speed - 1.0).relu()


ADDED = {Source.SPEED: excess, Source.STEP: lateral_acceleration, Source.TRAJECTORY: lateral_acceleration}
"""The added feature by its declaration."""


def step(row: str, added: Source | None) -> Callable[[], Any]:
    """A training step of a row, forward and backward, with an energy that has one more feature."""
    words = [f"experiment={row}", "data=drawn"]
    if added is not None:
        name = f"added_{added.value}"
        own_feature(name, added)(ADDED[added])
        words.append(f"energy.own=[{','.join([*compose('train', words)['energy']['own'], name])}]")
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
    parser = argparse.ArgumentParser(prog="python -m benchmarks.own_features", description=__doc__)
    parser.add_argument("--rounds", type=positive, default=9, help="rounds, of which medians are taken")
    arguments = parser.parse_args(given)
    torch.set_num_threads(1)
    print("| training step [ms] | built-in features | " + " | ".join(f"+ `{source}`" for source in ADDED) + " |")
    print("|:--|" + "--:|" * (1 + len(ADDED)))
    for row in ROWS:
        times = interleaved({added: step(row, added) for added in (None, *ADDED)}, arguments.rounds)
        print(f"| {row} | " + " | ".join(f"{time.cpu:.1f}" for time in times.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
