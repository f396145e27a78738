"""Quality of the goals that trained +EPO rows choose, and scores of their games without goals and with the true ones.

    python -m benchmarks.chosen_goals runs/us101/v_lstm_epo/short-s0

Forecasts of the same inferred games are scored with the chosen goals; without the terms of goals and of the lanes on which
they lie; and with each agent's true end as its goal, on the lane of the nearest candidate. No forecaster can know that end.
Agents without candidates have no goal in any of these. Scores are means over the scenes of the test split, or of the
validation split (``--split val``). Nothing is written.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Collection, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.runs import name_of, opened
from epo_lightning import losses
from epo_lightning.decoders.goals import choose, goal_candidates
from epo_lightning.experiment.opening import open_data, split_of
from epo_lightning.forecast import GameParameters
from epo_lightning.forecasters.epo import EPO
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene

COLUMNS = ("SADE", "initial", "no goals", "true goals", "goal [m]", "entropy", "uniform")
"""Scores: SADE [m] with the chosen goals, of the initial strategies, without goals, with the true ends as goals; the mean
distance [m] of the chosen goals of all modes from the true ends, over agents; the cross entropy of the goal decoder, and
that of equal probabilities for all candidates."""


def ends(scene: Scene) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """Final positions of all agents [m], and whether they are known.

    Raises:
        ConfigError: the scenes have no futures.
    """
    if scene.future is None or scene.future_mask is None:
        raise ConfigError("goals are compared with agents' ends, and these scenes have no futures")
    return scene.future[..., -1, :2], scene.agent_mask & scene.future_mask[..., -1]


def without_goals(parameters: GameParameters, terms: Collection[str]) -> GameParameters:
    """The same games without their terms of goals and lanes."""
    own = parameters.own_weights
    zero = {name: torch.zeros_like(own[name]) for name in terms if name in own}
    return dataclasses.replace(parameters, own_weights={**own, **zero})


def with_true_goals(parameters: GameParameters, scene: Scene) -> GameParameters:
    """The same games with the known true ends as goals, on the lanes of the candidates that are nearest to them."""
    assert parameters.goals is not None
    end, observed = ends(scene)
    goals = torch.where(observed[:, None, :, None], end[:, None], parameters.goals)
    if parameters.reference is None:
        return dataclasses.replace(parameters, goals=goals)
    candidates, exists = goal_candidates(scene)
    way = (candidates - end[:, :, None]).norm(dim=-1).where(exists, torch.inf)
    _, nearest = choose(scene, way.argmin(-1)[:, None])
    assert nearest is not None
    reference = torch.where(observed[:, None], nearest, parameters.reference)
    return dataclasses.replace(parameters, goals=goals, reference=reference)


@torch.no_grad()
def scores(folder: str, split: str) -> tuple[str, int, list[float]]:
    """Name of a run, its number of scenes, and the values of :data:`COLUMNS`.

    Raises:
        ConfigError: no finished run, a row that chooses no goals, or data that is missing or has changed.
    """
    run, settings, forecaster = opened(folder)
    data = open_data(run, settings, 256)
    if not isinstance(forecaster, EPO) or "goal" not in forecaster.energy.own or data.task.candidates < 2:
        raise ConfigError(
            f"{folder}: {settings.title} does not choose goals: name runs of +EPO rows with a goal feature"
        )
    measures = [ForecastMetrics(shape=data.task.shape) for _ in range(3)]
    distances, entropies, uniform = [], [], []
    count = with_ends = 0
    for scene in split_of(data, split):
        forecast = forecaster.predict(scene)
        assert forecast.parameters is not None
        assert forecast.parameters.goals is not None
        assert forecast.goal_log_probabilities is not None
        games = (
            without_goals(forecast.parameters, forecaster.energy.goal_terms),
            with_true_goals(forecast.parameters, scene),
        )
        horizon = forecast.states.shape[-2]
        solved = (forecaster.solve(scene, game).states[..., :horizon, :] for game in games)
        for measure, states in zip(measures, (forecast.states, *solved), strict=True):
            measure.update(dataclasses.replace(forecast, states=states), scene)
        end, observed = ends(scene)
        candidates, exists = goal_candidates(scene)
        counted = observed & exists.any(-1)
        known = counted.any(1)
        way = (forecast.parameters.goals - end[:, None]).norm(dim=-1)
        distances.append(way.transpose(1, 2)[counted].flatten())
        equal = -exists.sum(-1, keepdim=True).clamp_min(1).log().expand(exists.shape)
        for values, log_probabilities in ((entropies, forecast.goal_log_probabilities), (uniform, equal)):
            of_known = (tensor[known] for tensor in (log_probabilities, candidates, exists, end, observed))
            values.append(int(known.sum()) * float(losses.goal(*of_known)))
        count, with_ends = count + len(scene.history), with_ends + int(known.sum())
    chosen, without, true = ({key: float(value) for key, value in each.compute().items()} for each in measures)
    found = [chosen["minSADE"], chosen["initial/minSADE"], without["minSADE"], true["minSADE"]]
    found += [float(torch.cat(distances).mean()), *(sum(values) / max(with_ends, 1) for values in (entropies, uniform))]
    return name_of(settings, split), count, found


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("chosen_goals", __doc__)
    parser.add_argument("runs", nargs="+", help="folders of finished runs of +EPO rows that choose goals")
    parser.add_argument("--split", choices=("test", "val"), default="test", help="split of the run's data (test)")
    arguments = parser.parse_args(given)
    with measuring(parser):
        print(f"{'scenes':>7}" + "".join(f"{name:>12}" for name in COLUMNS) + "  run")
        rows = []
        for folder in arguments.runs:
            name, count, found = scores(folder, arguments.split)
            rows.append(found)
            print(f"{count:>7}" + "".join(f"{value:>12.3f}" for value in found) + f"  {name}")
        if len(rows) > 1:
            means = [statistics.fmean(column) for column in zip(*rows, strict=True)]
            print(f"{'':>7}" + "".join(f"{value:>12.3f}" for value in means) + "  mean of the runs")


if __name__ == "__main__":
    main()
