"""Closed-loop driving with trained runs and with planners that know the costs: tables, differences and films."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from epo_lightning.checks import check_choice
from epo_lightning.data.cache import digest, file_digest
from epo_lightning.data.rpi.game import RECIPE
from epo_lightning.drive.driven import Driven
from epo_lightning.drive.episodes import chunks, play, times
from epo_lightning.drive.film import film
from epo_lightning.drive.measures import UNITS, Estimate, differences, estimates, measure
from epo_lightning.drive.planners import ForecastPlanner, GamePlanner, Planner, ResponsePlanner
from epo_lightning.drive.progress import Progress
from epo_lightning.drive.world import World
from epo_lightning.drive.worlds import BEST_RESPONSE, CONSTANT_VELOCITY, DRIVER, WorldEntry, world_entry
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import DriveSettings
from epo_lightning.experiment.opening import open_checkpoint, settings_of
from epo_lightning.experiment.provenance import commit
from epo_lightning.files import write_file, write_json
from epo_lightning.forecasters.base import Forecaster
from epo_lightning.registry import ConfigError
from epo_lightning.report.closed_loop import SHARE, measures_table, times_table
from epo_lightning.run_folder import RunFolder

ROUNDS = 3
"""Best responses of every agent in turn."""
OWN, WARM, ALONE, RESPOND = "own", "warm", "alone", "respond"
WAYS = {OWN: "{}", WARM: "{}, warm start", ALONE: "{}, without pair term", RESPOND: "response to {}"}
Make = Callable[[World], Planner | None]


def drive(settings: DriveSettings, tell: Callable[[str], None]) -> list[Path]:
    """Drive the same episodes with every planner, and write ``results.json``, ``table.md`` and films.

    What was driven is kept in ``episodes.jsonl`` (:class:`~epo_lightning.drive.driven.Driven`); the same command continues
    there after it was killed. The folder is locked meanwhile.

    Args:
        settings: runs, world and planners.
        tell: called with a line at first, from time to time, and per planner.

    Returns:
        the files that were written.

    Raises:
        ConfigError: a run, checkpoint, world or kind of others that does not exist, a run or kind that is named twice, a
            run that cannot drive in this world, a world whose extra is not installed, an ``out`` that is no folder, holds
            results or is worked on by another process, or what was driven there with other settings or weights.
    """
    assembly.quiet()
    torch.set_num_threads(1)
    out = folder_of(settings)
    _check_free(out)
    where = world_entry(settings.world)
    kinds = where.kinds if settings.others is None else tuple(settings.others)
    where.check_kinds(settings.world, kinds)
    planners: dict[str, Make] = {}
    for name, make in _planners(settings, where, tell):
        if name in planners:
            raise ConfigError(f"two planners are called {name!r}: name each way and baseline once, and rename runs")
        planners[name] = make
    with _alone(out):
        return _compare(settings, where, kinds, planners, out, tell)


def folder_of(settings: DriveSettings) -> Path:
    """Folder of the results: ``out``, or one of its own for all settings that decide on the episodes."""
    if settings.out:
        return Path(settings.out).expanduser()
    return Path("drive") / f"{settings.world}-{digest(_deciding(settings))[:6]}"


def _deciding(settings: DriveSettings) -> dict[str, Any]:
    """The settings that decide on the episodes, as plain values; for RPI also the version by which its games are drawn."""
    plain = json.loads(json.dumps(dataclasses.asdict(settings)))
    drawn = {"recipe": RECIPE} if settings.world == "rpi" else {}
    return {name: value for name, value in plain.items() if name not in ("out", "timed", "film")} | drawn


def _compare(
    settings: DriveSettings,
    where: WorldEntry,
    kinds: Sequence[str],
    planners: Mapping[str, Make],
    out: Path,
    tell: Callable[[str], None],
) -> list[Path]:
    """Drive with all planners and write the files."""
    plain = json.loads(json.dumps(dataclasses.asdict(settings)))
    driven = Driven(out / "episodes.jsonl", _deciding(settings), _digests(settings), tell)
    tell(
        f"drives {settings.episodes} episodes with each of {len(planners)} planners, others: {', '.join(kinds)}; "
        "the same command continues if it is stopped"
    )
    results: dict[str, Any] = {"settings": plain, "commit": commit(), "worlds": {}, "milliseconds": {}}
    tables, films = [_heading(settings, results["commit"])], []
    for kind in kinds:
        with closing(where.make(settings.episodes, settings.seed, kind)) as world:
            made = {name: make(world) for name, make in planners.items()}
            _drive(world, kind, made, driven, tell)
            measured, rates = driven.measured(kind, planners), driven.rates(kind)
            results["worlds"][kind] = world_results = _results(measured, rates)
            tables.append(f"### others: {kind}\n\n{_table(world_results)}\n")
            if settings.timed and (milliseconds := _milliseconds(world, kind, made, settings.timed, tell)):
                results["milliseconds"][kind] = milliseconds
                tables.append(f"### milliseconds of a plan, one scene and one thread\n\n{times_table(milliseconds)}\n")
            if settings.film is not None:
                tell(f"{kind:8} draws a film of episode {settings.film}")
                played = {
                    name: play(world, planner, [settings.film], keep_plans=True) for name, planner in made.items()
                }
                films.append(film(played, world.shape, out / f"film-{kind}.gif"))
    _check_free(out)
    write_file(out / "table.md", "\n".join(tables))
    write_json(out / "results.json", results)
    return [out / "results.json", out / "table.md", *films]


def _drive(
    world: World, kind: str, planners: Mapping[str, Planner | None], driven: Driven, tell: Callable[[str], None]
) -> None:
    """Drive all episodes of a world with all planners."""
    progress = Progress(kind, len(world), planners, tell)
    for chunk in chunks(world):
        for name, planner in planners.items():
            if driven.has(kind, name, chunk):
                progress.skip(name, len(chunk))
                continue
            began = time.perf_counter()
            episodes = play(world, planner, chunk)
            driven.add(kind, name, chunk, measure(episodes, world), episodes.outcome.rates)
            progress.drove(name, len(chunk), time.perf_counter() - began)
    for name, values in driven.measured(kind, planners).items():
        collisions = float(values["collision"].mean())
        tell(f"{kind:8} {name}: {100 * collisions:.1f} % collisions, {progress.seconds[name]:.0f} s")


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Context in which this process alone works on the results in ``out``; the folder is made.

    Raises:
        ConfigError: the folder cannot be made, another process works on it, or it holds results.
    """
    with ExitStack() as held:
        with _naming(out):
            held.enter_context(RunFolder(out).lock())
        _check_free(out)
        yield


def _check_free(out: Path) -> None:
    """Refuse a folder that holds results."""
    with _naming(out):
        if (out / "results.json").exists():
            raise ConfigError(f"{out} holds results already: nothing is overwritten; choose another out=<folder>")


@contextmanager
def _naming(out: Path) -> Iterator[None]:
    """Context in which an error of the operating system names the key ``out``."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"out={out} is no folder that can be made and written ({error.strerror or error}): choose another out=<folder>"
        ) from error


def _digests(settings: DriveSettings) -> dict[str, str]:
    """Digest of the checkpoint of every run that drives, by the run's name in the settings."""
    paths = settings.run if settings.ways else []
    return {path: file_digest(RunFolder.open(path).checkpoint(settings.checkpoint))[:16] for path in paths}


def _planners(settings: DriveSettings, where: WorldEntry, tell: Callable[[str], None]) -> Iterator[tuple[str, Make]]:
    """Planners by name, made for a world."""
    paths = settings.run if settings.ways else []
    runs = [RunFolder.open(path) for path in paths]
    configs = [settings_of(run) for run in runs]
    titles = _titles(paths, [run.path.resolve() for run in runs], [of_run.title for of_run in configs])
    baselines = where.baselines if settings.baselines is None else settings.baselines
    lacking: list[str] = []
    for path, run, of_run, title in zip(paths, runs, configs, titles, strict=True):
        forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
        if reason := where.refuse(of_run.data):
            raise ConfigError(f"{path} was trained on data={of_run.data['name']}, and world={settings.world} {reason}")
        for way in settings.ways:
            try:
                make = _of_run(forecaster, way, settings.mode == "nearest")
            except ConfigError as error:  # a forecaster without a game has no warm start and no pair terms
                lacking.append(f"{path}, {way}: {error}")
                tell(f"left out: {lacking[-1]}")
                continue
            yield WAYS[way].format(title), make
    if len(lacking) == len(paths) * len(settings.ways) and not baselines:
        raise ConfigError(f"no planner is left to drive ({'; '.join(lacking)}): add to ways= or baselines=")
    for name in baselines:
        check_choice("baseline", name, where.baselines, f"world={settings.world}")
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
    """Estimates of all planners, paired differences of the first from the others, and units."""
    first, *others = measured
    units = {**dict.fromkeys(rates, SHARE), **UNITS}
    return {
        "planners": {name: _plain(estimates(values, rates)) for name, values in measured.items()},
        "differences": {f"{first} - {name}": _plain(differences(measured[first], measured[name])) for name in others},
        "units": {name: units[name] for name in measured[first] if name in units},
    }


def _table(results: Mapping[str, Any]) -> str:
    """Table of all planners and measures."""
    measures = list(next(iter(results["planners"].values())))
    return measures_table(results["planners"], results["units"], measures)


def _plain(values: Mapping[str, Estimate]) -> dict[str, dict[str, float]]:
    return {name: dataclasses.asdict(value) for name, value in values.items()}


def _heading(settings: DriveSettings, code: str | None) -> str:
    """Heading of the tables: the world, the runs, the number of episodes and their seed, and the code."""
    of = f"{settings.episodes} episodes of seed {settings.seed}, runs {', '.join(settings.run)}"
    return f"world={settings.world}, {of}, checkpoint {settings.checkpoint}, commit {code or 'unknown'}\n"


def _milliseconds(
    world: World, kind: str, planners: Mapping[str, Planner | None], timed: int, tell: Callable[[str], None]
) -> dict[str, dict[str, float]]:
    """Milliseconds of a plan of one scene: median and 99th percentile, by the clock and of processor time.

    Some episodes are driven once more, alone.
    """
    found, count = {}, min(timed, len(world))
    for name, planner in planners.items():
        if planner is None:
            continue
        tell(f"{kind:8} times every plan of {name}; episodes driven once more, one by one: {count}")
        wall, processor = times(world, planner, range(count))
        found[name] = {
            f"{title} {label}": 1e3 * float(torch.tensor(values).quantile(share))
            for title, values in (("clock", wall), ("processor", processor))
            for label, share in (("median", 0.5), ("99 %", 0.99))
        } | {"plans": len(wall)}
    return found
