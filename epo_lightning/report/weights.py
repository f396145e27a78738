"""Figure of the weights of inferred games."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from torch import Tensor

from epo_lightning.forecast import JointForecast
from epo_lightning.report.style import AGENT_COLORS, AGENTS, save, style

SMALLEST = 1e-6
"""Smallest squared weight on the logarithmic axis; smaller ones are drawn there."""


def learned_weights(
    forecasts: JointForecast | Mapping[str, JointForecast], path: str | Path, agents: Sequence[str] = AGENTS
) -> Path:
    """Figure of the distribution over scenes and modes of the squared weights w^2 in E = 1/2 sum w^2 c^2 (Eq. 10).

    One row of panels per forecaster that infers a game: own weights by feature and agent, and weights of pairs. A dot is
    the median, the thick line holds half of the weights, the thin line nine tenths. The axis is logarithmic; weights of
    features with different units do not compare, those of two agents do.

    Args:
        forecasts: forecasts of many scenes, one or several by the name of the row in the tables.
        path: path of the PNG.
        agents: names of the agents.

    Raises:
        ValueError: no forecast has inferred a game.
    """
    named = {"": forecasts} if isinstance(forecasts, JointForecast) else dict(forecasts)
    games = {name: forecast.parameters for name, forecast in named.items() if forecast.parameters is not None}
    if not games:
        raise ValueError(f"none of the forecasts {list(named)} has inferred a game: there are no weights to draw")
    features = max(len(game.own_weights) for game in games.values())
    with style():
        figure = Figure(figsize=(7.4, (0.42 * features + 1.2) * len(games)), layout="constrained")
        panels = figure.subplots(len(games), 2, squeeze=False, sharex="col", width_ratios=[3, 1.5])
        for (own, pair), (name, game) in zip(panels, games.items(), strict=True):
            _draw(own, {key: value.flatten(0, 1) for key, value in game.own_weights.items()})
            _draw(pair, {key: value.reshape(-1, 1) for key, value in game.pair_weights.items()}, colors=("#333333",))
            own.set_title(f"{name}: own weights" if name else "own weights", loc="left", weight="bold")
            pair.set_title("pair weights", loc="left", weight="bold")
            count = next(iter(game.own_weights.values())).shape[2]
            names = [agents[i] if i < len(agents) else f"agent {i + 1}" for i in range(count)]
        handles = [
            Line2D([], [], color=AGENT_COLORS[i % len(AGENT_COLORS)], marker="o", ms=5, lw=3.2, label=label)
            for i, label in enumerate(names)
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        for axes in panels[-1]:
            axes.set_xlabel("squared weight w² (median, 50%, 90%)")
        return save(figure, path)


def _power(value: float, _: object) -> str:
    """A power of ten as text: ``10⁻³``."""
    return "10" + str(round(math.log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _draw(axes: Axes, weights: Mapping[str, Tensor], colors: Sequence[str] = AGENT_COLORS) -> None:
    """Draw the 5, 25, 50, 75 and 95 percent quantiles of the weights [any, agent], one line per feature and agent."""
    everything = []
    for line, values in enumerate(weights.values()):
        squared = values.detach().double().square().clamp_min(SMALLEST).cpu().numpy()
        agents = squared.shape[1]
        for i in range(agents):
            height, color = line + 0.26 * (i - (agents - 1) / 2), colors[i % len(colors)]
            low, lower, median, upper, high = np.nanpercentile(squared[:, i], [5, 25, 50, 75, 95])
            everything += [low, high]
            axes.plot([low, high], [height, height], color=color, lw=1.1, alpha=0.7)
            axes.plot([lower, upper], [height, height], color=color, lw=4, alpha=0.75)
            axes.plot(median, height, marker="o", ms=5, mfc="white", mec=color, mew=1.4)
    if not everything:
        axes.set_axis_off()
        return
    # At least a decade, so that a weight that hardly varies does not look as if it did.
    low, high = np.log10(min(everything)), np.log10(max(everything))
    margin = max(0.15, (1.0 - (high - low)) / 2)
    before = axes.get_xlim() if axes.get_xscale() == "log" else (np.inf, -np.inf)
    axes.set_xscale("log")
    axes.set_xlim(min(before[0], 10 ** (low - margin)), max(before[1], 10 ** (high + margin)))
    # Powers of ten alone, but a narrow panel that holds one of them needs a second number to be read.
    tens = math.log10(axes.get_xlim()[1]) // 1 - math.log10(axes.get_xlim()[0]) // 1
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if tens > 1 else (1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(_power if tens > 1 else lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(range(len(weights)), list(weights))
    axes.set_ylim(len(weights) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
