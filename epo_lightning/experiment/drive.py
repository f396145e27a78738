"""Closed-loop driving with trained runs and with planners that know the costs: tables, differences and films."""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from epo_lightning.drive.episodes import Episodes, play, times
from epo_lightning.drive.film import film
from epo_lightning.drive.measures import RATES, UNITS, Estimate, differences, estimate, estimates, measure
from epo_lightning.drive.planners import ForecastPlanner, GamePlanner, Planner, ResponsePlanner
from epo_lightning.drive.rpi import PEDESTRIANS, RPIWorld
from epo_lightning.drive.world import World
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import DriveSettings, Settings
from epo_lightning.experiment.opening import open_checkpoint
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.run_folder import RunFolder, write_file, write_json
from epo_lightning.schema import read

ROUNDS = 3
"""Best responses of every agent in turn."""
TIMED_SEED = 500_000
"""Added to the seed for the episodes whose plans are timed."""
OWN, WARM, ALONE, RESPOND = "own", "warm", "alone", "respond"
WAYS = {OWN: "{}", WARM: "{}, warm start", ALONE: "{}, without pair term", RESPOND: "response to {}"}
BASELINES = {
    "constant_velocity": "response to constant velocity",
    "best_response": "iterated best response, true game",
    "joint": "true game",
}
Make = Callable[[World], Planner]


def drive(settings: DriveSettings, tell: Callable[[str], None]) -> list[Path]:
    """Drive the same episodes with every planner, and write ``results.json``, ``table.md`` and films.

    Args:
        settings: runs, world and planners.
        tell: called with a line per planner as soon as it has driven.

    Returns:
        the files that were written.

    Raises:
        ConfigError: a run, checkpoint or kind of others that does not exist, a run that cannot drive in this world, or
            results in ``out`` that would be overwritten.
    """
    assembly.quiet()
    torch.set_num_threads(1)
    out = Path(settings.out).expanduser()
    if (out / "results.json").exists():
        raise ConfigError(f"{out} holds results already: nothing is overwritten; choose another out=<folder>")
    kinds = PEDESTRIANS if settings.others is None else tuple(settings.others)
    for kind in kinds:
        if kind not in PEDESTRIANS:
            raise ConfigError(f"unknown others {kind!r} of world={settings.world}: {nearest(kind, PEDESTRIANS)}")
    planners = dict(_planners(settings))
    results: dict[str, Any] = {"settings": dataclasses.asdict(settings), "worlds": {}}
    tables, films = [], []
    out.mkdir(parents=True, exist_ok=True)
    for kind in kinds:
        world = RPIWorld(settings.episodes, settings.seed, kind)
        played: dict[str, Episodes] = {}
        measured: dict[str, dict[str, Tensor]] = {}
        for name, make in planners.items():
            began, own = time.perf_counter(), copy.deepcopy(world)
            episodes = play(own, make(own), keep_plans=settings.film is not None)
            measured[name] = measure(episodes, own.shape, own.arrived, own.measures())
            if settings.film is not None:
                played[name] = _only(episodes, settings.film)
            collisions = float(measured[name]["collision"].mean())
            tell(f"{kind:8} {name}: {100 * collisions:.1f} % collisions, {time.perf_counter() - began:.0f} s")
        results["worlds"][kind] = _results(measured)
        tables.append(_table(kind, measured))
        if settings.film is not None:
            films.append(film(played, 0, world.shape, out / f"film-{kind}.gif"))
    if settings.timed:
        results["milliseconds"] = _timed(settings, planners, kinds[0])
        tables.append(_times_table(results["milliseconds"]))
    write_file(out / "table.md", "\n".join(tables))
    write_json(out / "results.json", results)
    return [out / "results.json", out / "table.md", *films]


def _planners(settings: DriveSettings) -> Iterator[tuple[str, Make]]:
    """Planners by name, made for a world."""
    for path in settings.runs if settings.ways else ():
        run = RunFolder.open(path)
        of_run = read(Settings, run.config())
        forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
        _check(of_run, path)
        for way in settings.ways:
            try:
                make = _of_run(forecaster, way, settings.mode == "nearest")
            except ConfigError:
                continue  # a forecaster without a game has no warm start and no pair terms
            yield WAYS[way].format(of_run.title), make
    for name in settings.baselines:
        yield BASELINES[name], _baseline(name)


def _of_run(forecaster: Forecaster, way: str, keep: bool) -> Make:
    if way == RESPOND:
        return lambda world: ResponsePlanner(world.energy, world.game, forecaster)
    planner = ForecastPlanner(forecaster, pair_terms=way != ALONE, warm=way == WARM, keep=keep)
    return lambda world: planner


def _baseline(name: str) -> Make:
    if name == "constant_velocity":
        return lambda world: ResponsePlanner(world.energy, world.game)
    return lambda world: GamePlanner(world.energy, world.game, ROUNDS if name == "best_response" else None)


def _check(of_run: Settings, path: str) -> None:
    """Refuse a run that was not trained on RPI.

    Raises:
        ConfigError: another data set.
    """
    if of_run.data["name"] != "rpi":
        raise ConfigError(
            f"{path} was trained on data={of_run.data['name']}, and world=rpi takes runs of data=rpi, such as rpi/v_lstm_epo"
        )


def _only(episodes: Episodes, index: int) -> Episodes:
    """One episode with its plans."""
    one = slice(index, index + 1)
    return dataclasses.replace(
        episodes,
        **{
            name: getattr(episodes, name)[one]
            for name in ("states", "controls", "agent_mask", "size", "found", "progress")
        },
        plans=[plan[one] for plan in episodes.plans],
    )


def _results(measured: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Any]:
    """Estimates of all planners, and paired differences of the first from the others."""
    first, *others = measured
    return {
        "planners": {name: _plain(estimates(values)) for name, values in measured.items()},
        "differences": {f"{first} - {name}": _plain(differences(measured[first], measured[name])) for name in others},
    }


def _plain(values: Mapping[str, Estimate]) -> dict[str, dict[str, float]]:
    return {name: dataclasses.asdict(value) for name, value in values.items()}


def _table(kind: str, measured: Mapping[str, Mapping[str, Tensor]]) -> str:
    names = list(next(iter(measured.values())))
    heads = [f"{name.replace('_', ' ')}{f' [{UNITS[name]}]' if name in UNITS else ''}" for name in names]
    lines = [f"### others: {kind}", "", "| planner | " + " | ".join(heads) + " |", "|:--|" + "--:|" * len(names)]
    for planner, values in measured.items():
        cells = [_cell(estimate(values[name], name in RATES), name in RATES) for name in names]
        lines.append(f"| {planner} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _cell(value: Estimate, rate: bool) -> str:
    if rate:
        return f"{100 * value.mean:.1f} ({100 * value.low:.1f} to {100 * value.high:.1f})"
    digits = 0 if abs(value.mean) >= 100 else 2 if abs(value.mean) >= 0.2 else 3
    return f"{value.mean:.{digits}f} ({value.low:.{digits}f} to {value.high:.{digits}f})"


def _timed(settings: DriveSettings, planners: Mapping[str, Make], kind: str) -> dict[str, dict[str, float]]:
    """Milliseconds of a plan of one scene: median and 99th percentile, by the clock and of processor time."""
    worlds = [RPIWorld(1, TIMED_SEED + settings.seed + index, kind) for index in range(settings.timed)]
    found = {}
    for name, make in planners.items():
        wall: list[float] = []
        processor: list[float] = []
        for world in copy.deepcopy(worlds):
            by_clock, worked = times([world], make(world))
            wall += by_clock
            processor += worked
        found[name] = {
            f"{title} {label}": 1e3 * float(torch.tensor(values).quantile(share))
            for title, values in (("clock", wall), ("processor", processor))
            for label, share in (("median", 0.5), ("99 %", 0.99))
        } | {"plans": len(wall)}
    return found


def _times_table(times: Mapping[str, Mapping[str, float]]) -> str:
    names = list(next(iter(times.values())))
    lines = ["### milliseconds of a plan, one scene and one thread", ""]
    lines += ["| planner | " + " | ".join(names) + " |", "|:--|" + "--:|" * len(names)]
    for planner, values in times.items():
        cells = [f"{value:.1f}" if name != "plans" else str(value) for name, value in values.items()]
        lines.append(f"| {planner} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])
