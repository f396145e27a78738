"""Scores of trained runs before and after a refinement without training, and its time, on the test split of their data.

    python -m benchmarks.refinement runs/highway/v_lstm/short-s0 --share 0.1
    python -m benchmarks.refinement runs/rpi/v_lstm_relaxed/reduced-s0 --weights accref=1 turnrref=0.3 clearance=3 \\
        --margins clearance=0.02 --noise 0.01

For every run: the forecasts as given; *tracked*, with the same weights but without pair terms; and *refined*
(:func:`epo_lightning.refine`). Scores are those of ``epo evaluate``, for all scenes and for interactive ones where the data
have them. OR is the overlap rate. The games are solved again by ten times as many steps in double precision, and energies
and probabilities of *refined*, with its steps and with ten, are compared with those of these solutions. The time is the
median (and the least) CPU time per scene in milliseconds, of batches of 1 and 32 scenes, without the forecaster. Nothing
is written.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.measure import cpu_milliseconds
from benchmarks.runs import opened
from epo_lightning import FeatureEnergy, JointForecast, Scene, Solution, refine
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_data, split_of
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.refinement import INVERSE_TEMPERATURE, SOLVER, WEIGHTS
from epo_lightning.refinement.game import NOISE
from epo_lightning.registry import ConfigError

SCORES = {"minSADE": "SADE", "minSFDE": "SFDE", "minSADE_1": "k=1", "overlap_jfp": "OR"}
REPEATS = 101
"""Calls whose median is the time."""
FEW = 10
"""Steps of a refinement that ends early, for comparison."""
TOLERANCE = 0.01
"""Differences of energies and probabilities that count."""

Forecasts = list[tuple[Scene, Tensor, Tensor]]
Refinement = Callable[[Tensor, Tensor, Scene], JointForecast]


@torch.no_grad()
def forecasts(folder: str, share: float | None, split: str) -> tuple[Settings, Forecasts, Sequence[str], str]:
    """Settings of a run; scenes, futures and probabilities in batches of 256; names of the subsets, and shape of agents.

    Raises:
        ConfigError: no finished run, or its data is missing or has changed.
    """
    run, settings, forecaster = opened(folder)
    data = open_data(run, settings, 256, share)
    found = []
    for scene in split_of(data, split):
        forecast = forecaster(scene)
        found.append((scene, forecast.states, forecast.probabilities))
    return settings, found, data.task.subsets, data.task.shape


def scores(given: Forecasts, subsets: Sequence[str], shape: str, refinement: Refinement) -> dict[str, float]:
    """Scores of all batches after a refinement."""
    metrics = ForecastMetrics(subsets, shape)
    for scene, states, probabilities in given:
        metrics.update(refinement(states, probabilities, scene), scene)
    return {name: float(value) for name, value in metrics.compute().items()}


def distances(given: Forecasts, refinement: Refinement, solved: Refinement) -> str:
    """How far the energies and probabilities of a refinement are from those of solved games."""
    energies, probabilities = [], []
    for scene, futures, before in given:
        ours = refinement(futures, before, scene)
        theirs = solved(futures.double(), before.double(), scene.to(torch.float64))
        energies.append((solution_of(ours).energy - solution_of(theirs).energy).flatten())
        probabilities.append((ours.probabilities - theirs.probabilities).abs().amax(1))
    above = (torch.cat(energies) > TOLERANCE).double().mean()
    apart = torch.cat(probabilities)
    return (
        f"{100 * above:.2f} % of the modes have an energy that is higher by more than {TOLERANCE}; probabilities "
        f"of {100 * (apart > TOLERANCE).double().mean():.2f} % of the scenes differ by more, at most by {apart.max():.3f}"
    )


def solution_of(forecast: JointForecast) -> Solution:
    """The solution of a forecast that a refinement made."""
    assert forecast.solution is not None
    return forecast.solution


def milliseconds(given: Forecasts, size: int, refinement: Refinement) -> tuple[float, float]:
    """Median and smallest CPU time per scene of batches of ``size`` scenes."""
    scene, states, probabilities = given[0]
    times = []
    for repeat in range(REPEATS + 1):
        rows = [(repeat * size + offset) % len(states) for offset in range(size)]
        batch = states[rows], probabilities[rows], scene[rows]
        times.append(cpu_milliseconds(functools.partial(refinement, *batch), size)[1])
    return statistics.median(times[1:]), min(times[1:])


def numbers(words: Iterable[str]) -> dict[str, float]:
    """Numbers by name.

    Raises:
        ConfigError: a word that is not name=number.
    """
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            raise ConfigError(f"{word!r} is not name=number") from None
    return found


def report(
    folder: str,
    weights: Mapping[str, float],
    margins: Mapping[str, float],
    noise: float,
    beta: float,
    share: float | None,
    split: str,
) -> None:
    """Print the rows of one run.

    Raises:
        ConfigError: as :func:`forecasts`, or an energy that cannot be used.
    """
    settings, given, subsets, shape = forecasts(folder, share, split)
    pair = [name for name in weights if name not in ("accref", "turnrref")]
    energy = FeatureEnergy(own=[name for name in weights if name not in pair], pair=pair, margins=margins)

    def plain(states: Tensor, probabilities: Tensor, scene: Scene) -> JointForecast:
        return JointForecast(states, probabilities)

    def tracked(states: Tensor, probabilities: Tensor, scene: Scene) -> JointForecast:
        alone = {**weights, **dict.fromkeys(pair, 0.0)}
        return refine(states, probabilities, scene, energy, alone, noise=noise)

    def with_steps(steps: int) -> Refinement:
        return functools.partial(
            refine,
            energy=energy,
            weights=weights,
            noise=noise,
            inverse_temperature=beta,
            solver=dataclasses.replace(SOLVER, steps=steps),
        )

    refined = with_steps(SOLVER.steps)

    groups = [("all", ""), *((name, f"{name}/") for name in subsets)]
    for label, refinement in (("given", plain), ("tracked", tracked), ("refined", refined)):
        found = scores(given, subsets, shape, refinement)
        for group, prefix in groups:
            if f"{prefix}minSADE" not in found:  # the data have no scene of this subset
                continue
            values = [found[prefix + key] for key in SCORES]
            row = f"{settings.title}, seed {settings.seed}"
            print(f"{row:<28}{label:<9}{group:<13}" + "".join(f"{value:>9.4f}" for value in values), flush=True)
    for steps in (FEW, SOLVER.steps):
        print(f"after {steps} steps, {distances(given, with_steps(steps), with_steps(10 * SOLVER.steps))}", flush=True)
    times = ", ".join("{:.2f} ({:.2f}) in batches of {}".format(*milliseconds(given, b, refined), b) for b in (1, 32))
    agents, modes = given[0][1].shape[2], given[0][1].shape[1]
    print(f"CPU ms per scene of {agents} agents and {modes} modes: {times}", flush=True)


@torch.no_grad()
def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("refinement", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs")
    parser.add_argument("--share", type=float, help="share of the scenes of the split (default: that of the run)")
    parser.add_argument("--split", choices=("test", "val"), default="test")
    parser.add_argument(
        "--weights", nargs="+", metavar="NAME=NUMBER", help="weight of each feature (default: those of refine)"
    )
    parser.add_argument("--margins", nargs="+", metavar="NAME=METRES", default=[], help="margins of pair features")
    parser.add_argument("--noise", type=float, default=NOISE, help="noise of given positions [m]")
    parser.add_argument("--beta", type=float, default=INVERSE_TEMPERATURE, help="inverse temperature")
    chosen = parser.parse_args(given)
    with measuring(parser):
        # Every call warns of the futures of marginal forecasters.
        warnings.filterwarnings("ignore", message="(.* of the given futures of agents|states)")
        print(f"{'run':<28}{'':<9}{'scenes':<13}" + "".join(f"{label:>9}" for label in SCORES.values()))
        weights = WEIGHTS if chosen.weights is None else numbers(chosen.weights)
        for folder in chosen.runs:
            report(folder, weights, numbers(chosen.margins), chosen.noise, chosen.beta, chosen.share, chosen.split)


if __name__ == "__main__":
    main()
