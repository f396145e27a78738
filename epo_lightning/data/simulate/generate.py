"""Generation of a folder of simulated recordings: one process per recording.

Every recording draws from its own random numbers, so the bytes do not depend on the number of workers. The recordings are
written to a hidden folder beside the final one, which is renamed when it is complete; a run that was killed continues there
with the recordings that are not finished.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from epo_lightning.checks import check_choice
from epo_lightning.data import cache
from epo_lightning.data.simulate import recording
from epo_lightning.data.simulate.demand import STYLES, Style
from epo_lightning.data.simulate.lanelets import write_map
from epo_lightning.data.simulate.layout import LAYOUTS, Layout
from epo_lightning.data.simulate.motion import move
from epo_lightning.data.simulate.traffic import RATE, WARM_UP, simulate, simulator
from epo_lightning.data.workers import Report, finished
from epo_lightning.registry import ConfigError

RECIPE = 2
"""Version of the simulation: raised whenever the same configuration would give other recordings."""
MOST_DROPPED = 0.05
"""Largest share of vehicles with implausible motion; a simulation with more is refused."""


def config(
    seed: int = 0,
    recordings: int = 3,
    minutes: float = 9.0,
    layouts: Sequence[int] | None = None,
    traffic: str = "free",
) -> dict[str, Any]:
    """Configuration of simulated recordings: all values that they depend on.

    Args:
        seed: seed of the traffic.
        recordings: number per layout.
        minutes: duration of each recording.
        layouts: ids of the layouts; None for all.
        traffic: style of the traffic, ``free`` or ``dense``
            (:data:`~epo_lightning.data.simulate.demand.STYLES`). Free traffic is not named in the configuration, as it was
            the only one once: recordings of older versions stay valid.

    Raises:
        ConfigError: a value is out of range.
    """
    check_choice("data.traffic", traffic, STYLES)
    known = [layout.id for layout in LAYOUTS]
    chosen = known if layouts is None else sorted(set(layouts))
    for layout in chosen:
        if layout not in known:
            raise ConfigError(
                f"data.layouts names the unknown layout {layout!r}: known are {', '.join(map(str, known))}"
            )
    if not chosen:
        raise ConfigError(f"data.layouts is empty: choose from {', '.join(map(str, known))}")
    if not 1 <= recordings * len(chosen) <= 1000:
        raise ConfigError(
            f"data.recordings is {recordings} for each of {len(chosen)} layouts: 1 to 1000 in all are possible"
        )
    if not 0.1 <= minutes <= 60.0:
        raise ConfigError(f"data.minutes is {minutes}: expected 0.1 to 60 minutes per recording")
    return {
        "recipe": RECIPE,
        "seed": seed,
        "recordings": recordings,
        "minutes": float(minutes),
        "layouts": chosen,
        "rate": RATE,
        "warm_up": WARM_UP,
        **({"traffic": {"name": traffic, **_plain(STYLES[traffic])}} if traffic != "free" else {}),
    }


def _plain(style: Style) -> dict[str, Any]:
    """A style as JSON stores it."""
    values = dataclasses.asdict(style).items()
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values}


def map_path(layout: Layout) -> str:
    """Path of a location's Lanelet2 map in exiD v2.1."""
    return f"maps/lanelet2/{layout.id}_{layout.name}/location{layout.id}.osm"


def record(work: Path, name: str, number: int, place: Layout, seed: int, seconds: float, style: str = "free") -> int:
    """Simulate and write recording ``number`` of the configuration with the digest ``name``; its ``.done`` file comes last.

    Raises:
        ConfigError: SUMO is missing or fails, too many vehicles have accidents, or there is no lane change.
    """
    with tempfile.TemporaryDirectory() as folder:
        traffic = simulate(place, [seed, number], seconds, Path(folder), style=STYLES[style])
    motion = move(traffic, place, seconds)
    dropped = sum(motion.dropped.values())
    if dropped > MOST_DROPPED * len(traffic.size):
        raise ConfigError(
            f"recording {number} on layout {place.name}: {dropped} of {len(traffic.size)} vehicles move implausibly "
            f"({motion.dropped}): use another seed"
        )
    changes = int(recording.lane_changes(motion).sum())
    if not changes:
        raise ConfigError(
            f"recording {number} on layout {place.name}: no vehicle changes lane in {seconds:g} s: use more minutes"
        )
    paths = recording.write(motion, place, number, work / "data")
    done = {
        "config": name,
        "layout": place.name,
        "vehicles": len(motion.size),
        "lane_changes": changes,
        "frames": len(motion.frame),
        "dropped": motion.dropped,
        "files": {
            f"data/{path.name}": {"bytes": path.stat().st_size, "sha256": cache.file_digest(path)} for path in paths
        },
    }
    _write_json(_done_path(work, number), done)
    return number


def _done_path(work: Path, number: int) -> Path:
    return work / f".{number:02d}.done"


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    cache.write_file(path, (json.dumps(content, indent=2, sort_keys=True) + "\n").encode())


def _finished(work: Path, number: int, name: str) -> dict[str, Any] | None:
    """The record of a finished recording; None if it is not finished, damaged or of another configuration."""
    try:
        done = json.loads(_done_path(work, number).read_text(encoding="utf-8"))
        if done["config"] != name:
            return None
        for file, expected in done["files"].items():
            if cache.file_digest(work / file) != expected["sha256"]:
                return None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return dict(done)


def verify(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of a folder of simulated recordings, after a check of its configuration and the sizes of its files.

    Raises:
        cache.CacheError: the manifest is missing or of another configuration, or a file is missing or truncated.
    """
    remedy = f"delete the folder {folder} and make it again"
    try:
        manifest = json.loads((folder / cache.MANIFEST).read_text(encoding="utf-8"))
        found, files = manifest["hash"], manifest["files"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise cache.CacheError(
            f"{folder / cache.MANIFEST} is not a readable manifest ({type(error).__name__}: {error}); {remedy}"
        ) from None
    if found != cache.digest(config):
        raise cache.CacheError(f"{folder} holds recordings of another configuration; {remedy}, or use another folder")
    for file, expected in files.items():
        path = folder / file
        if not path.is_file() or path.stat().st_size != expected["bytes"]:
            raise cache.CacheError(f"{path} is missing or truncated; {remedy}")
    return dict(manifest)


def make_recordings(folder: Path, config: Mapping[str, Any], workers: int | None = None, progress: bool = True) -> Path:
    """The folder of simulated recordings of a configuration, made now unless it exists already.

    It has exiD's layout, ``data/XX_*.csv`` and ``maps/lanelet2/``, and a ``manifest.json`` with the configuration, every
    file's size and SHA-256, and a summary of each recording.

    Args:
        folder: final path of the folder.
        config: configuration of the recordings, from :func:`config`.
        workers: processes; None for one per core.
        progress: whether to report progress on standard error.

    Raises:
        ConfigError: SUMO is missing or fails, or a recording has no lane changes or too many accidents.
        cache.CacheError: the folder exists but is broken or of another configuration, or a worker was killed.
        OSError: the disk is full or read-only.
    """
    if not cache.make_once(folder, lambda: _make(folder, config, workers, progress)):
        verify(folder, config)
    return folder


def _make(folder: Path, config: Mapping[str, Any], workers: int | None, progress: bool) -> None:
    simulator()
    name = cache.digest(config)
    work = folder.with_name(f".{folder.name}-{name[:12]}")
    with cache.writing(work):
        (work / "data").mkdir(parents=True, exist_ok=True)
    numbers = dict(enumerate(layout for layout in config["layouts"] for _ in range(config["recordings"])))
    missing = [number for number in numbers if _finished(work, number, name) is None]
    seconds = config["minutes"] * 60.0
    style = config.get("traffic", {"name": "free"})["name"]
    tasks = [(work, name, number, LAYOUTS[numbers[number]], config["seed"], seconds, style) for number in missing]
    report = Report(
        tasks, lambda task: task[2], "recording", "simulating", "simulated", len(numbers) - len(missing), progress
    )
    # A process per recording: SUMO keeps its state in global variables.
    for _ in finished(record, tasks, workers, report, f"finished recordings are kept in {work}", fresh=True):
        pass
    _finish(folder, work, config, numbers)


def _finish(folder: Path, work: Path, config: Mapping[str, Any], numbers: Mapping[int, int]) -> None:
    """Add maps and manifest, and rename the folder to its final name."""
    name = cache.digest(config)
    files: dict[str, Any] = {}
    report: dict[str, Any] = {}
    for layout in sorted(set(numbers.values())):
        path = work / map_path(LAYOUTS[layout])
        with cache.writing(path):
            write_map(LAYOUTS[layout], path)
        files[map_path(LAYOUTS[layout])] = {"bytes": path.stat().st_size, "sha256": cache.file_digest(path)}
    for number in numbers:
        done = _finished(work, number, name)
        if done is None:
            raise cache.CacheError(f"recording {number} in {work} cannot be read back: is the disk full?")
        files.update(done.pop("files"))
        del done["config"]
        report[f"{number:02d}"] = done
    for number in numbers:
        _done_path(work, number).unlink()
    for leftover in (work / "data").glob(".*"):  # of a recording that was killed while it was written
        leftover.unlink()
    _write_json(
        work / cache.MANIFEST,
        {"hash": name, "config": dict(config), "files": files, "recordings": report},
    )
    work.replace(folder)
