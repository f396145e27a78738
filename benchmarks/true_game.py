"""Accuracy of the layer on the games that made RPI: with their true weights, with wrong ones, and with calibrated ones.

    epo generate data=rpi_hard data.placements=8
    python -m benchmarks.true_game data=rpi_hard data.placements=8

Energy, solver and calibration are those of the row `rpi/v_lstm_epo_game`; overrides are those of `epo train`. Nothing is
learned: the weights are those with which the generator made the records, and the solver starts from controls of zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from scipy import stats
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.measure import cpu_milliseconds, positive
from benchmarks.rpi_runs import drawn
from epo_lightning.data.rpi.scenes import RPIData
from epo_lightning.data.rpi.subgames import FUTURE
from epo_lightning.drive.rpi import true_game
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.compose import compose
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecast import GameParameters
from epo_lightning.forecasters.calibration import Calibration
from epo_lightning.forecasters.epo import EPO
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.schema import read
from epo_lightning.solvers.base import Minimiser

FACTORS = (1.0, 0.85, 1.15, 0.5, 2.0, 0.0)
"""Factors of the true weight of the pair term."""
MISSED = 1e-3
"""SADE [m] above which a mode is missed."""
FROM = 2.0
"""Factor of the true weight from which the calibration begins."""


@dataclass(frozen=True)
class TrueGames:
    """Records of RPI with the games that made them, in float64.

    Attributes:
        scene: scenes, whose games end ``game_steps`` after t0.
        weight: w of every game [B].
        states: recorded executed and alternative modes [B, 2, N, K, 4].
        both: whether a record has an alternative mode [B].
    """

    scene: Scene
    weight: Tensor
    states: Tensor
    both: Tensor

    @classmethod
    def draw(cls, data: RPIData, split: str, count: int) -> TrueGames:
        """Random records of a split, in the same order on every machine.

        Raises:
            ConfigError: the split has fewer records.
        """
        scenes, records = data.open(split), data.records(split)
        chosen = drawn(scenes, count)
        if len(chosen) < count:
            raise ConfigError(f"the {split} split of {data.folder} has {len(chosen)} records, fewer than {count}")
        scene = scenes[chosen.sort().values].to(torch.double)
        rows = {name: values[scene.id] for name, values in records.items()}
        return cls(scene, rows["weight"].double(), rows["states"].double(), rows["modes"] == 2)

    def game(self, factor: float = 1.0) -> GameParameters:
        """The true games, with the weight of their pair term multiplied by a factor."""
        assert self.scene.goal_candidates is not None
        assert self.scene.goal_headings is not None
        assert self.scene.game_steps is not None
        goals, headings = self.scene.goal_candidates[:, :, 0], self.scene.goal_headings[:, :, 0]
        one = true_game(factor * self.weight, goals, headings, int(self.scene.game_steps.max()))
        both = one.for_every_mode(2)
        return dataclasses.replace(both, initial_controls=one.initial_controls.expand(-1, 2, -1, -1, -1))

    @torch.no_grad()
    def missed(self, solver: Minimiser, energy: Energy, game: GameParameters) -> tuple[Tensor, Tensor]:
        """minSADE [m] of the solutions, for the executed mode of every record and the alternative mode of those with one."""
        found = solver(energy, self.scene, game).states[:, :, None, :, :FUTURE, :2]
        closest = (found - self.states[:, None, ..., :2]).norm(dim=-1).mean((3, 4)).amin(1)
        return closest[:, 0], closest[self.both, 1]


def parts(overrides: Sequence[str]) -> tuple[RPIData, Minimiser, Energy, Calibration]:
    """The data, and the row's solver, energy and calibration."""
    settings = read(Settings, compose("train", ["experiment=rpi/v_lstm_epo_game", *overrides]))
    data, model = assembly.build(settings)
    if not isinstance(data, RPIData):
        raise ConfigError("the benchmark compares with the games that made RPI: choose data=rpi or data=rpi_hard")
    if not isinstance(model, EPO) or model.calibration is None or list(model.energy.pair) != ["clearance"]:
        raise ConfigError(
            "the benchmark takes the energy and the calibration of rpi/v_lstm_epo_game: leave energy and calibration out"
        )
    return data, model.solver, model.energy, model.calibration


def measure(split: str, count: int, overrides: Sequence[str]) -> None:
    """Print a line per factor of the weight, and how well the calibration finds the true weight."""
    data, solver, energy, calibration = parts(overrides)
    games = TrueGames.draw(data, split, count)
    print(
        f"{count} records of {data.folder.name}, {split}, {int(games.both.sum())} with two modes; mean (largest) SADE [m]"
    )

    def line(title: str, game: GameParameters) -> int:
        """Prints the errors of a game, and returns the number of alternative modes that are missed."""
        modes, spent = cpu_milliseconds(lambda: games.missed(solver, energy, game), count)
        executed, alternative = (f"{mode.mean():.1e} ({mode.max():.1e})" for mode in modes)
        print(f"{title:16} executed {executed}  alternative {alternative}  {spent:.1f} ms of CPU per record")
        return int((modes[1] > MISSED).sum())

    missed = [line(f"{factor:g} w", games.game(factor)) for factor in FACTORS]
    print(f"alternative modes missed by more than 1 mm with the true w: {missed[0]} of {int(games.both.sum())}")
    calibrated, spent = cpu_milliseconds(lambda: calibration(solver, energy, games.scene, games.game(FROM)), count)
    line(f"{FROM:g} w, calibrated", calibrated)
    found = calibrated.pair_weights["clearance"][:, 0, 0].square() / 2
    error = (found / games.weight - 1).abs()
    rank = stats.spearmanr(found.numpy(), games.weight.numpy()).statistic
    print(
        f"calibrated w: rank correlation {rank:.4f}, relative error median {error.median():.1e}, largest {error.max():.1e}, "
        f"{spent:.1f} ms of CPU per record"
    )


def command_line(
    name: str, text: str | None, measure: Callable[[str, int, Sequence[str]], None], argv: Sequence[str] | None
) -> None:
    """Run a measurement of records, given a split, their number, and overrides of `epo train`."""
    parser = parser_of(name, text)
    parser.add_argument("--split", default="test")
    parser.add_argument("--records", type=positive, default=400)
    parser.add_argument("overrides", nargs="*", metavar="override")
    arguments = parser.parse_args(argv)
    with measuring(parser):
        measure(arguments.split, arguments.records, arguments.overrides)


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    command_line("true_game", __doc__, measure, argv)


if __name__ == "__main__":
    main()
