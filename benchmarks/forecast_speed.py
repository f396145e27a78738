"""Whether forecasts of SUMO's traffic are too fast, and what planners do whose forecasts are made faster or slower.

    python -m benchmarks.forecast_speed RUN ... --traffic dense --episodes 200 --seed 7 --change 0.85

1. SUMO's driver is at the wheel, and the neighbours are forecast once per second: by the runs, and by keeping their speed on
   their lane. The table has the mean distance of forecast from true positions, and its mean part along the heading, after
   2 and 4 s.
2. Responses to the forecasts drive the same episodes, also with a constant acceleration added to everything that the
   forecast says of the others: plus ``change`` for neighbours that keep their speed, minus ``change`` for the runs. If the
   speed of a forecast is why its planner collides, both move the rate of collisions, in opposite directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.command_line import measuring, parser_of
from benchmarks.runs import opened
from epo_lightning.drive.episodes import chunks, outside, play
from epo_lightning.drive.measures import differences, estimate, measure
from epo_lightning.drive.planners import ForecastPlanner, ResponsePlanner
from epo_lightning.drive.ride import Moment
from epo_lightning.drive.road_game import keep_going
from epo_lightning.drive.traffic import TrafficWorld
from epo_lightning.drive.world import EGO
from epo_lightning.drive.worlds import world_entry
from epo_lightning.forecast import GameParameters
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.registry import ConfigError
from epo_lightning.scene import ACCELERATION, HEADING, SPEED, Scene

AHEAD = (2, 4)
"""Times [s] after which forecasts are compared with what happened."""
KEEPING = "keeping their speed"
SAME = 0.01
"""Largest distance [m] at which a vehicle of a scene is one of the simulator."""


class Accelerated(ResponsePlanner):
    """A response to a forecast in which all others accelerate more, or less, by a constant; they never drive backwards.

    Args:
        change: the acceleration [m/s^2] that is added.
        response: arguments of :class:`~epo_lightning.drive.planners.ResponsePlanner`.
    """

    def __init__(self, change: float, *response: Any) -> None:
        super().__init__(*response)
        self.change = change

    def expected(self, scene: Scene, game: GameParameters) -> Float[Tensor, "B 1 N K 2"]:
        """Controls that the others are expected to take, changed."""
        controls = super().expected(scene, game)
        rate = controls[..., ACCELERATION]
        now = scene.current[:, None, :, SPEED, None].clamp_min(0.0).to(rate)
        speed = (now + scene.dt * (rate + self.change).cumsum(-1)).clamp_min(0.0)
        controls[..., ACCELERATION] = torch.cat((now, speed), -1).diff(dim=-1) / scene.dt
        return controls


Forecasts = Mapping[str, Float[np.ndarray, "N K 2"]]
"""Forecast positions [m] in one episode, by forecast."""


def watch(
    world: TrafficWorld, forecasters: Mapping[str, ForecastPlanner], episodes: int
) -> Mapping[str, Mapping[int, Float[np.ndarray, "n 2"]]]:
    """Parts of the errors along the neighbours' headings, and their lengths [m], by forecast and by the time ahead [s]."""
    world.reset(range(episodes))
    every = round(1 / world.dt)
    moments: list[list[Moment]] = [[] for _ in range(episodes)]
    told: list[tuple[int, int, Sequence[str], Forecasts]] = []
    step = 0
    while len(going := world.going):
        for episode in going.tolist():
            moments[episode].append(world.rides[episode].now)
        if step % every == 0:
            scene = world.observe()
            forecasts = _positions(world, scene, forecasters)
            here = outside(scene.current[:, : world.agents, None, :2], scene)[:, :, 0].numpy()
            for row, episode in enumerate(going.tolist()):
                names = _names(moments[episode][-1], here[row], scene.agent_mask[row])
                told.append((episode, step, names, {name: value[row] for name, value in forecasts.items()}))
        world.advance(None)
        step += 1
    errors: dict[str, dict[int, list[np.ndarray]]] = {
        name: {ahead: [] for ahead in AHEAD} for name in (*forecasters, KEEPING)
    }
    for episode, begun, vehicles, by_forecast in told:
        for agent, vehicle in enumerate(vehicles):
            now = moments[episode][begun]
            if agent == EGO or not vehicle:
                continue
            heading = now.states[now.rows[vehicle], HEADING]
            along = np.array([np.cos(heading), np.sin(heading)])
            for ahead in AHEAD:
                steps = ahead * every
                later = moments[episode][begun + steps : begun + steps + 1]
                if not later or vehicle not in later[0].rows:
                    continue
                happened = later[0].states[later[0].rows[vehicle], :2]
                for name, positions in by_forecast.items():
                    error = positions[agent, steps - 1] - happened
                    errors[name][ahead].append(np.array([error @ along, np.linalg.norm(error)]))
    return {name: {ahead: np.array(values) for ahead, values in found.items()} for name, found in errors.items()}


def _positions(
    world: TrafficWorld, scene: Scene, forecasters: Mapping[str, ForecastPlanner]
) -> Mapping[str, Float[np.ndarray, "B N K 2"]]:
    """Forecast positions [m] in the world's frame, by forecast."""
    steps = max(AHEAD) * round(1 / world.dt)
    controls = {name: forecaster.controls_of_all(scene).double() for name, forecaster in forecasters.items()}
    controls[KEEPING] = keep_going(scene, steps)[:, : world.agents]
    start = scene.current[:, : world.agents].double()
    return {
        name: outside(Unicycle().rollout(start, value, world.dt)[..., :2], scene).numpy()
        for name, value in controls.items()
    }


def _names(now: Moment, positions: Float[np.ndarray, "N 2"], mask: Tensor) -> list[str]:
    """Names of the vehicles at some positions; empty for agents that are not there."""
    distance = np.linalg.norm(now.states[None, :, :2] - positions[:, None], axis=-1)
    return [
        now.names[near.argmin()] if there and near.min() < SAME else ""
        for near, there in zip(distance, mask.tolist(), strict=False)
    ]


def drive(world: TrafficWorld, planners: Mapping[str, ResponsePlanner]) -> Mapping[str, Mapping[str, Tensor]]:
    """Measures of all episodes by planner."""
    found: dict[str, dict[str, list[Tensor]]] = {}
    for chunk in chunks(world):
        for name, planner in planners.items():
            for key, values in measure(play(world, planner, chunk), world).items():
                found.setdefault(name, {}).setdefault(key, []).append(values)
        print(f"{chunk.stop} of {len(world)} episodes", flush=True)
    return {name: {key: torch.cat(values) for key, values in measures.items()} for name, measures in found.items()}


def report(runs: Sequence[str], traffic: str, episodes: int, watched: int, seed: int, change: float) -> None:
    """Print both tables.

    Raises:
        ConfigError: a run or a kind of traffic that does not exist, a run that is not finished or of other data, or SUMO is
            not installed.
    """
    where = world_entry("sumo")
    where.check_kinds("sumo", (traffic,))
    forecasters: dict[str, Forecaster | None] = {KEEPING: None}
    for path in runs:
        run = opened(path)
        if reason := where.refuse(run.settings.data):
            raise ConfigError(f"{path} was trained on data={run.settings.data['name']}, and world=sumo {reason}")
        forecasters[run.settings.title] = run.forecaster
    with closing(where.make(episodes, seed, traffic)) as world:
        assert isinstance(world, TrafficWorld)
        trained = {
            name: ForecastPlanner(forecaster, world.agents)
            for name, forecaster in forecasters.items()
            if forecaster is not None
        }
        print(f"{'forecast':<28}{'after [s]':>10}{'vehicles':>10}{'error [m]':>11}{'along [m]':>11}")
        for name, by_time in watch(world, trained, min(watched, episodes, world.together)).items():
            for ahead, values in by_time.items():
                along, error = values.mean(0)
                print(f"{name:<28}{ahead:>10}{len(values):>10}{error:>11.2f}{along:>+11.2f}", flush=True)
        planners: dict[str, ResponsePlanner] = {}
        pairs: list[tuple[str, str]] = []
        for name, forecaster in forecasters.items():
            planner = world.energy, world.game, forecaster, world.search, world.agents
            added = change if forecaster is None else -change
            pairs.append((f"{name}, {added:+.2f} m/s²", name))
            planners[name] = ResponsePlanner(*planner)
            planners[pairs[-1][0]] = Accelerated(added, *planner)
        measured = drive(world, planners)
    print(f"{'response to':<40}{'collisions [%]':>26}{'progress [m]':>14}")
    for name, measures in measured.items():
        rate = estimate(measures["collision"], rate=True)
        share = f"{100 * rate.mean:.1f} ({100 * rate.low:.1f} to {100 * rate.high:.1f})"
        print(f"{name:<40}{share:>26}{float(measures['progress'].mean()):>14.1f}")
    for one, other in pairs:
        gap = differences(measured[one], measured[other])["collision"]
        print(f"{one} minus {other}: {100 * gap.mean:+.1f} ({100 * gap.low:+.1f} to {100 * gap.high:+.1f}) points")


def main(given: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = parser_of("forecast_speed", __doc__)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="folders of finished runs")
    parser.add_argument("--traffic", default="dense", help="kind of SUMO's traffic")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--watched", type=int, default=10, help="episodes of the first part")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--change", type=float, default=0.85, help="acceleration [m/s^2]")
    chosen = parser.parse_args(given)
    with measuring(parser):
        report(**vars(chosen))


if __name__ == "__main__":
    main()
