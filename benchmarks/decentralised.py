"""Decentralised against central solution of the games that a trained run infers, on the test split of its data.

    python -m benchmarks.decentralised runs/highway/v_lstm_epo_equilibrium/short-s0 --share 0.02

Every game is solved from its decoded strategies in float64: centrally (adaptive Gauss-Newton steps of all agents, then
Newton steps), and by best responses (``solver=best_response``), in turn and all at once, for several numbers of rounds. For
each: the share of games whose energy is at most 1 % above the central one, the median and the largest relative difference of
energies, the median over scenes of the relative Nash gap of the mode with the lowest energy, the largest number of plans
sent per scene, and CPU time per scene of all agents together. Nothing is written.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch

from benchmarks.command_line import measuring, parser_of
from benchmarks.measure import cpu_milliseconds
from benchmarks.runs import opened
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_data, split_of
from epo_lightning.forecast import GameParameters, JointForecast, Solution
from epo_lightning.forecasters.epo import EPO
from epo_lightning.game.energy import FEATURES
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import Minimiser
from epo_lightning.solvers.diagnostics.equilibrium import equilibrium
from epo_lightning.solvers.gauss_newton.best_response import ORDERS, BestResponse
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

ROUNDS = (1, 2, 5, 10, 20, 50)
NEAR = 0.01
"""Largest relative difference of energies that counts as none."""
CENTRAL = LevenbergMarquardt(steps=20, step_size=1.0, damping=1.0, adaptive=True, newton_steps=20)


def with_features(folder: str) -> tuple[RunFolder, Settings, EPO]:
    """A run whose forecaster infers games of features.

    Raises:
        ConfigError: no finished run, or its forecaster has no such game.
    """
    run, settings, forecaster = opened(folder)
    if not isinstance(forecaster, EPO) or FEATURES not in forecaster.energy.offers:
        raise ConfigError(f"{folder}: {settings.title} infers no game of features; choose a row of forecaster=epo")
    return run, settings, forecaster


def solved(
    forecaster: EPO, minimiser: Minimiser, games: Sequence[tuple[Scene, GameParameters]]
) -> tuple[list[Solution], float]:
    """The solutions of all games, and the CPU time per scene in milliseconds."""
    forecaster.solver = minimiser
    scenes = sum(len(scene.history) for scene, _ in games)
    return cpu_milliseconds(lambda: [forecaster.solve(scene, parameters) for scene, parameters in games], scenes)


def gaps(forecaster: EPO, games: Sequence[tuple[Scene, GameParameters]], found: Sequence[Solution]) -> torch.Tensor:
    """The relative Nash gap of the mode with the lowest energy of every scene: the largest one of its agents."""
    values = []
    for (scene, parameters), solution in zip(games, found, strict=True):
        best = (solution.energy == solution.energy.amin(1, keepdim=True)).double()
        forecast = JointForecast(solution.states, best, parameters=parameters, solution=solution)
        report = equilibrium(forecaster.energy, scene, forecast)
        assert report is not None
        values.append((report.nash_gap / report.objective.clamp_min(1e-9)).amax(1))
    return torch.cat(values)


@torch.no_grad()
def report(folder: str, share: float | None, split: str) -> None:
    """Print the rows of one run.

    Raises:
        ConfigError: as :func:`with_features`, or its data is missing or has changed.
    """
    run, settings, forecaster = with_features(folder)
    data = open_data(run, settings, 256, share)
    games = []
    for scene in split_of(data, split):
        parameters = forecaster(scene).parameters
        assert parameters is not None
        games.append((scene.to(torch.float64), dataclasses.replace(parameters.to(torch.float64), context=None)))
    agents = sum(int(scene.agent_mask.sum()) for scene, _ in games) / sum(len(scene.history) for scene, _ in games)
    print(f"{settings.title}, seed {settings.seed}: {agents:.1f} agents per scene")
    central, spent = solved(forecaster, CENTRAL, games)
    wanted = torch.cat([solution.energy.flatten() for solution in central])
    initial = torch.cat([solution.initial_energy.flatten() for solution in central])
    rows = [("central", 0, wanted, central, spent)]
    for order in ORDERS:
        for rounds in ROUNDS:
            found, spent = solved(forecaster, BestResponse(rounds=rounds, order=order), games)
            rows.append((order, rounds, torch.cat([one.energy.flatten() for one in found]), found, spent))
    print(f"{'':<10}{'rounds':>7}{'within 1%':>11}{'median':>10}{'largest':>10}{'Nash gap':>10}{'plans':>8}{'ms':>8}")
    known = wanted.isfinite() & (initial > 0)
    for order, rounds, energy, found, spent in rows:
        above = ((energy - wanted) / wanted.clamp_min(1e-9))[known]
        near = 100 * float((above <= NEAR).double().mean())
        gap = float(gaps(forecaster, games, found).nanmedian())
        print(
            f"{order:<10}{rounds or '':>7}{near:>10.1f}%{float(above.median()):>10.1e}{float(above.max()):>10.1e}"
            f"{gap:>10.1e}{_count(rounds * agents):>8}{spent:>8.1f}",
            flush=True,
        )


def _count(value: float) -> str:
    return f"{value:.0f}" if value else ""


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("decentralised", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs")
    parser.add_argument("--share", type=float, help="share of the scenes of the split (default: that of the run)")
    parser.add_argument("--split", choices=("test", "val"), default="test")
    chosen = parser.parse_args(given)
    with measuring(parser):
        for folder in chosen.runs:
            report(folder, chosen.share, chosen.split)


if __name__ == "__main__":
    main()
