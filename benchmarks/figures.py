"""Figures of docs/game.md, docs/features.md and docs/rpi_results.md.

    python -m benchmarks.figures levels docs/figures/pair_features.png
    python -m benchmarks.figures weights docs/figures/inferred_w.png RUN [RUN ...]
    python -m benchmarks.figures modes docs/figures/rpi_modes.png RUN [RUN ...] --records 3280 3294

`levels` draws the level sets of the pair features. `weights` draws the inferred against the true weights of RPI's games.
`modes` draws the joint modes of runs on records of RPI's test split, and prints their energies before and after the
solver's steps. A run is a run folder, or the name of a run that ships with the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.rpi_runs import drawn
from benchmarks.runs import opened
from epo_lightning.data.rpi.scenes import RPIData, RPIDataset
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_data
from epo_lightning.experiment.truth import compare, inferred_costs
from epo_lightning.forecasters import Forecaster
from epo_lightning.game.features import PAIR_FEATURES, PairFeature
from epo_lightning.registry import ConfigError
from epo_lightning.report.figures import joint_predictions
from epo_lightning.report.style import MODES, OTHER, save, style

LENGTH, WIDTH, MARGIN = 4.5, 1.9, 1.0
"""Size of both vehicles, and the margin of pair features that take one [m]."""
SPEEDS = (20.0, 15.0)
"""Speeds [m/s] of the vehicle in the middle and of the other one; both drive to the right."""
RECORDS = 500
"""Number of records in a panel of `weights`."""


def levels(path: Path) -> None:
    """Value of every pair feature for a second vehicle with its centre at (x, y); that of the first one is at (0, 0)."""
    names = list(PAIR_FEATURES)
    with style():
        figure = Figure(figsize=(10.0, 1.15 * ((len(names) + 1) // 2)))
        axes = figure.subplots((len(names) + 1) // 2, 2, sharex=True, sharey=True).flatten()
        x, y = torch.meshgrid(torch.linspace(-40, 40, 401), torch.linspace(-6, 6, 121), indexing="xy")
        for axis, name in zip(axes, names, strict=False):
            value = _value(PAIR_FEATURES[name], x, y)
            axis.contourf(x, y, value, levels=12, cmap="Blues")
            axis.contour(x, y, value, levels=[1e-6], colors=MODES[0], linewidths=1.0)
            axis.add_patch(_body())
            axis.set_title(f"{name}, up to {value.max():.1f} m")
            axis.set_aspect("equal")
        for axis in axes[len(names) :]:
            axis.set_axis_off()
        figure.supxlabel("position of the other vehicle along the road [m]")
        figure.supylabel("across [m]")
        figure.tight_layout()
        save(figure, path)


def _value(feature: PairFeature, x: Tensor, y: Tensor) -> Tensor:
    first = torch.stack(
        (torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x), torch.full_like(x, SPEEDS[0])), -1
    )
    second = torch.stack((x, y, torch.zeros_like(x), torch.full_like(x, SPEEDS[1])), -1)
    if feature.declared:
        reach = LENGTH + (MARGIN if feature.margin else 0.0)
        return feature.function((x.square() + y.square()).sqrt(), torch.full_like(x, reach))
    # One pair per place: functions of states take [pairs, K, 4].
    first, second = first.reshape(-1, 1, 4), second.reshape(-1, 1, 4)
    size, margin = torch.tensor([LENGTH, WIDTH]).expand(len(first), 1, 2), torch.full((len(first), 1), MARGIN)
    arguments = (first, second, size, size) if feature.needs == "size" else (first, second)
    return feature.function(*arguments, *((margin,) if feature.margin else ())).view_as(x)


def _body() -> Rectangle:
    return Rectangle((-LENGTH / 2, -WIDTH / 2), LENGTH, WIDTH, color=OTHER)


def weights(path: Path, runs: Sequence[str]) -> None:
    """One panel per run: the inferred w of a record, in units of the true cost of controls, against the true w.

    Raises:
        ConfigError: a run without an inferred game, or on other data than RPI.
    """
    with style():
        figure = Figure(figsize=(3.4 * len(runs), 3.2))
        axes = figure.subplots(1, len(runs), sharey=True, squeeze=False)[0]
        for axis, run in zip(axes, runs, strict=True):
            title, costs = _costs(run)
            scores = compare(costs)
            axis.loglog([8, 110], [8, 110], color=OTHER, linewidth=1.0)
            axis.loglog(costs["true"], costs["pair"], ".", color=MODES[1], markersize=3)
            axis.set_title(
                f"{title}\nrank correlation {scores['pair_rank']:.2f}, error {100 * scores['pair_error']:.2g} %"
            )
            axis.set_xlabel("true w")
            for side in (axis.xaxis, axis.yaxis):
                side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes[0].set_ylabel("inferred w")
        figure.tight_layout()
        save(figure, path)


@torch.no_grad()
def modes(path: Path, runs: Sequence[str], records: Sequence[int]) -> None:
    """Joint modes, one column per run and one row per record with two equilibria; prints energies, true and inferred w.

    Raises:
        ConfigError: a run on other data than RPI, or a record that is not there or has one equilibrium.
    """
    forecasts = {}
    for run in runs:
        settings, forecaster, data = _open(run)
        scenes = data.open("test")
        both = [_futures(scenes, record) for record in records]
        scene, other = (scenes[torch.tensor(rows)] for rows in zip(*both, strict=True))
        forecasts[settings.title] = forecast = forecaster.predict(scene)
        if (solution := forecast.solution) is None or forecast.parameters is None:
            continue
        costs = inferred_costs(forecast.parameters, forecast.probabilities.argmax(1))
        true = data.records("test")["weight"]
        for row, record in enumerate(records):
            before, after = (
                ", ".join(f"{value:.0f}" for value in energy[row])
                for energy in (solution.initial_energy, solution.energy)
            )
            print(f"{settings.title}, record {record}: E of the modes {before} before, {after} after the steps")
            print(f"  w {costs['pair'][row]:.1f}, true {true[record]:.1f}")
    joint_predictions(scene, forecasts, path, other.future)


def _futures(scenes: RPIDataset, record: int) -> tuple[int, int]:
    """Rows of a record with the executed and the alternative future."""
    rows = (scenes.record == record).nonzero().flatten()
    if len(rows) != 2:
        raise ConfigError(f"record {record} of the test split is missing or has one equilibrium: choose another one")
    executed, alternative = sorted(rows.tolist(), key=lambda row: int(scenes.mode[row]))
    return executed, alternative


def _open(folder: str) -> tuple[Settings, Forecaster, RPIData]:
    """Settings, forecaster and data of a run.

    Raises:
        ConfigError: no finished run, one on other data than RPI, or its data is missing or has changed.
    """
    run, settings, forecaster = opened(folder)
    data = open_data(run, settings)
    if not isinstance(data, RPIData):
        raise ConfigError(f"{folder} was trained on other data than RPI, whose weights are not known")
    return settings, forecaster, data


@torch.no_grad()
def _costs(folder: str) -> tuple[str, dict[str, Tensor]]:
    """Title of a run, and true and inferred costs of random records of its test split."""
    settings, forecaster, data = _open(folder)
    scenes = data.open("test")
    scene = scenes[drawn(scenes, RECORDS)]
    assert scene.id is not None
    forecast = forecaster.predict(scene)
    if forecast.parameters is None or not forecast.parameters.pair_weights:
        raise ConfigError(f"{folder} infers no weight of a pair term")
    true = data.records("test")["weight"][scene.id].double()
    costs = inferred_costs(forecast.parameters, forecast.probabilities.argmax(1))
    return f"{settings.title}, seed {settings.seed}", {"true": true, **costs}


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("figures", __doc__)
    parser.add_argument("figure", choices=("levels", "weights", "modes"))
    parser.add_argument("path", type=Path)
    parser.add_argument("runs", nargs="*")
    parser.add_argument("--records", nargs="+", type=int, default=(), metavar="RECORD")
    arguments = parser.parse_args(argv)
    if (arguments.figure != "levels") != bool(arguments.runs):
        parser.error("`weights` and `modes` take run folders, and `levels` takes none")
    if (arguments.figure == "modes") != bool(arguments.records):
        parser.error("`modes` takes --records, and the other figures take none")
    with measuring(parser):
        if arguments.figure == "levels":
            levels(arguments.path)
        elif arguments.figure == "weights":
            weights(arguments.path, arguments.runs)
        else:
            modes(arguments.path, arguments.runs, arguments.records)


if __name__ == "__main__":
    main()
