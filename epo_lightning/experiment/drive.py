"""Closed-loop driving with trained runs and with planners that know the costs: tables, differences and films."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from epo_lightning.drive.episodes import Episodes, play, times
from epo_lightning.drive.film import film
from epo_lightning.drive.measures import RATES, UNITS, Estimate, differences, estimate, estimates, measure
from epo_lightning.drive.planners import ForecastPlanner, GamePlanner, Planner, ResponsePlanner
from epo_lightning.drive.world import World
from epo_lightning.drive.worlds import BEST_RESPONSE, CONSTANT_VELOCITY, DRIVER, Place, place
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import DriveSettings, Settings
from epo_lightning.experiment.opening import open_checkpoint
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.run_folder import RunFolder, write_file, write_json
from epo_lightning.schema import read

ROUNDS = 3
"""Best responses of every agent in turn."""
OWN, WARM, ALONE, RESPOND = "own", "warm", "alone", "respond"
WAYS = {OWN: "{}", WARM: "{}, warm start", ALONE: "{}, without pair term", RESPOND: "response to {}"}
EVERY = 10
"""Number of chunks of episodes between two lines about progress."""
Make = Callable[[World], Planner | None]
Measured = dict[str, dict[str, list[float]]]


def drive(settings: DriveSettings, tell: Callable[[str], None]) -> list[Path]:
    """Drive the same episodes with every planner, and write ``results.json``, ``table.md`` and films.

    What was driven is kept in ``episodes.jsonl``; the same command continues there after it was killed.

    Args:
        settings: runs, world and planners.
        tell: called with a line from time to time, and per planner.

    Returns:
        the files that were written.

    Raises:
        ConfigError: a run, checkpoint, world or kind of others that does not exist, a run that is named twice or cannot
            drive in this world, a world whose extra is not installed, or results in ``out`` that would be overwritten.
    """
    assembly.quiet()
    torch.set_num_threads(1)
    out = Path(settings.out).expanduser()
    if (out / "results.json").exists():
        raise ConfigError(f"{out} holds results already: nothing is overwritten; choose another out=<folder>")
    where = place(settings.world)
    kinds = where.kinds if settings.others is None else tuple(settings.others)
    where.check_kinds(settings.world, kinds)
    planners: dict[str, Make] = {}
    for name, make in _planners(settings, where):
        if name in planners:
            raise ConfigError(f"two planners are called {name!r}: name each way and baseline once, and rename runs")
        planners[name] = make
    done = _Done(out / "episodes.jsonl", json.loads(json.dumps(dataclasses.asdict(settings))))
    results: dict[str, Any] = {"settings": done.settings, "worlds": {}, "milliseconds": {}}
    tables, films = [], []
    for kind in kinds:
        with closing(where.make(settings.episodes, settings.seed, kind)) as world:
            made = {name: make(world) for name, make in planners.items()}
            _drive(world, kind, made, done, tell)
            measured, rates = done.measured(kind, planners), done.rates(kind)
            results["worlds"][kind] = _results(measured, rates)
            tables.append(_table(kind, measured, rates))
            if settings.timed and (milliseconds := _milliseconds(world, made, settings.timed)):
                results["milliseconds"][kind] = milliseconds
                tables.append(_times_table(milliseconds))
            if settings.film is not None:
                played = {
                    name: play(world, planner, [settings.film], keep_plans=True) for name, planner in made.items()
                }
                films.append(film(played, world.shape, out / f"film-{kind}.gif"))
    write_file(out / "table.md", "\n".join(tables))
    write_json(out / "results.json", results)
    return [out / "results.json", out / "table.md", *films]


def _drive(
    world: World, kind: str, planners: Mapping[str, Planner | None], done: _Done, tell: Callable[[str], None]
) -> None:
    """Drive all episodes of a world with all planners."""
    seconds = dict.fromkeys(planners, 0.0)
    chunks = [range(first, min(first + world.together, len(world))) for first in range(0, len(world), world.together)]
    for count, chunk in enumerate(chunks, 1):
        for name, planner in planners.items():
            if done.has(kind, name, chunk):
                continue
            began = time.perf_counter()
            episodes = play(world, planner, chunk)
            done.add(kind, name, chunk, measure(episodes, world), episodes)
            seconds[name] += time.perf_counter() - began
        if count % EVERY == 0:
            tell(f"{kind:8} {chunk.stop} of {len(world)} episodes, {sum(seconds.values()):.0f} s")
    for name, values in done.measured(kind, planners).items():
        collisions = float(values["collision"].mean())
        tell(f"{kind:8} {name}: {100 * collisions:.1f} % collisions, {seconds[name]:.0f} s")


class _Done:
    """The file of what was driven: a line of settings, then a line per planner and chunk of episodes.

    A last line without its line break was cut off by a kill, and is dropped.

    Args:
        path: the file, which is continued.
        settings: the settings that it belongs to.

    Raises:
        ConfigError: the file belongs to other settings.
    """

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path, self.settings = path, settings
        self._rows: dict[str, dict[str, dict[int, dict[str, Any]]]] = {}
        text = path.read_text() if path.exists() else ""
        whole = text[: text.rfind("\n") + 1]
        lines = whole.splitlines()
        if lines and _parsed(lines[0]) != settings:
            raise ConfigError(
                f"{path} was begun with other settings: nothing is mixed; choose another out=<folder>, or delete it"
            )
        if whole != text:
            write_file(path, whole)
        for row in filter(None, map(_parsed, lines[1:])):
            self._take(row)

    def _take(self, row: dict[str, Any]) -> None:
        self._rows.setdefault(row["kind"], {}).setdefault(row["planner"], {})[row["episodes"][0]] = row

    def has(self, kind: str, planner: str, chunk: Sequence[int]) -> bool:
        """Whether a planner has driven some episodes.

        Raises:
            ConfigError: the file holds other episodes together.
        """
        row = self._rows.get(kind, {}).get(planner, {}).get(chunk[0])
        if row is not None and row["episodes"] != list(chunk):
            raise ConfigError(
                f"{self.path} was begun by a version that drove other episodes together: choose another out=<folder>, or "
                "delete it"
            )
        return row is not None

    def add(
        self,
        kind: str,
        planner: str,
        chunk: Sequence[int],
        measures: Mapping[str, Tensor],
        played: Episodes,
    ) -> None:
        """Append what a planner has driven."""
        row = {
            "kind": kind,
            "planner": planner,
            "episodes": list(chunk),
            "measures": {name: values.tolist() for name, values in measures.items()},
            "rates": sorted(played.outcome.rates),
        }
        self._take(row)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            if not file.tell():
                file.write(json.dumps(self.settings) + "\n")
            file.write(json.dumps(row) + "\n")

    def rates(self, kind: str) -> set[str]:
        """Names of the measures that are 0 or 1."""
        rows = (row for rows in self._rows[kind].values() for row in rows.values())
        return set(RATES).union(*(row.get("rates", ()) for row in rows))

    def measured(self, kind: str, planners: Iterable[str]) -> dict[str, dict[str, Tensor]]:
        """Measures of all episodes, by planner in the given order."""
        found = {planner: self._rows[kind][planner] for planner in planners}
        return {
            planner: {
                name: torch.tensor(
                    [value for _, row in sorted(rows.items()) for value in row["measures"][name]], dtype=torch.double
                )
                for name in next(iter(rows.values()))["measures"]
            }
            for planner, rows in found.items()
        }


def _parsed(line: str) -> Any:
    """The contents of a line of JSON; None for a broken one."""
    try:
        return json.loads(line)
    except json.JSONDecodeError:
        return None


def _planners(settings: DriveSettings, where: Place) -> Iterator[tuple[str, Make]]:
    """Planners by name, made for a world."""
    paths = settings.runs if settings.ways else []
    runs = [RunFolder.open(path) for path in paths]
    configs = [read(Settings, run.config()) for run in runs]
    titles = _titles(paths, [run.path.resolve() for run in runs], [of_run.title for of_run in configs])
    for path, run, of_run, title in zip(paths, runs, configs, titles, strict=True):
        forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
        if reason := where.refuse(of_run.data):
            raise ConfigError(f"{path} was trained on data={of_run.data['name']}, and world={settings.world} {reason}")
        for way in settings.ways:
            try:
                make = _of_run(forecaster, way, settings.mode == "nearest")
            except ConfigError:
                continue  # a forecaster without a game has no warm start and no pair terms
            yield WAYS[way].format(title), make
    for name in where.baselines if settings.baselines is None else settings.baselines:
        if name not in where.baselines:
            known = tuple(where.baselines)
            raise ConfigError(f"unknown baseline {name!r} of world={settings.world}: {nearest(name, known)}")
        yield where.baselines[name], _baseline(name)


def _titles(paths: Sequence[str], folders: Sequence[Path], titles: Sequence[str]) -> Sequence[str]:
    """Distinct titles of runs: where several runs share one, with the name of the run's folder, or else with its path."""
    for number, folder in enumerate(folders):
        if folder in folders[:number]:
            raise ConfigError(f"the run {paths[number]} is named twice: name it once")
    named = titles
    for labels in ([folder.name for folder in folders], paths):
        if len(set(named)) < len(named):
            named = [
                f"{title} ({label})" if titles.count(title) > 1 else title
                for title, label in zip(titles, labels, strict=True)
            ]
    return named


def _of_run(forecaster: Forecaster, way: str, keep: bool) -> Make:
    if way == RESPOND:
        return lambda world: ResponsePlanner(world.energy, world.game, forecaster, world.search, world.agents)
    options = {"pair_terms": way != ALONE, "warm": way == WARM, "keep": keep}
    ForecastPlanner(forecaster, **options)  # refused before any world is made
    return lambda world: ForecastPlanner(forecaster, world.agents, **options)


def _baseline(name: str) -> Make:
    if name == DRIVER:
        return lambda world: None
    if name == CONSTANT_VELOCITY:
        return lambda world: ResponsePlanner(world.energy, world.game, None, world.search)
    rounds = ROUNDS if name == BEST_RESPONSE else None
    return lambda world: GamePlanner(world.energy, world.game, rounds, world.search)


def _results(measured: Mapping[str, Mapping[str, Tensor]], rates: Collection[str]) -> dict[str, Any]:
    """Estimates of all planners, and paired differences of the first from the others."""
    first, *others = measured
    return {
        "planners": {name: _plain(estimates(values, rates)) for name, values in measured.items()},
        "differences": {f"{first} - {name}": _plain(differences(measured[first], measured[name])) for name in others},
    }


def _plain(values: Mapping[str, Estimate]) -> dict[str, dict[str, float]]:
    return {name: dataclasses.asdict(value) for name, value in values.items()}


def _table(kind: str, measured: Mapping[str, Mapping[str, Tensor]], rates: Collection[str]) -> str:
    names = list(next(iter(measured.values())))
    units = {**dict.fromkeys(rates, "%"), **UNITS}
    heads = [f"{name.replace('_', ' ')}{f' [{units[name]}]' if name in units else ''}" for name in names]
    lines = [f"### others: {kind}", "", "| planner | " + " | ".join(heads) + " |", "|:--|" + "--:|" * len(names)]
    for planner, values in measured.items():
        cells = [_cell(estimate(values[name], name in rates), name in rates) for name in names]
        lines.append(f"| {planner} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _cell(value: Estimate, rate: bool) -> str:
    if rate:
        return f"{100 * value.mean:.1f} ({100 * value.low:.1f} to {100 * value.high:.1f})"
    digits = 0 if abs(value.mean) >= 100 else 2 if abs(value.mean) >= 0.2 else 3
    return f"{value.mean:.{digits}f} ({value.low:.{digits}f} to {value.high:.{digits}f})"


def _milliseconds(world: World, planners: Mapping[str, Planner | None], timed: int) -> dict[str, dict[str, float]]:
    """Milliseconds of a plan of one scene: median and 99th percentile, by the clock and of processor time.

    Some episodes are driven once more, alone.
    """
    found = {}
    for name, planner in planners.items():
        if planner is None:
            continue
        wall, processor = times(world, planner, range(min(timed, len(world))))
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
