"""Generation of RPI data sets: every main game is solved at every placement, and the pool of records is cut into splits.

The pool has one file per main game and depends on the games alone; data sets with other splits or sizes share it. Every
placement has its own random generator, so the files do not depend on the number of workers. If the command was killed, the
next one continues with the first main game that is not finished. The pool may be deleted when the data sets have been made.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from epo_lightning.data import cache
from epo_lightning.data.rpi.game import GameConstants, main_game
from epo_lightning.data.rpi.solve import SETTINGS
from epo_lightning.data.rpi.splits import assign
from epo_lightning.data.rpi.subgames import FUTURE, HISTORY, MAIN_STARTS, RANDOM_STARTS, Records, play
from epo_lightning.data.workers import Report, finished

WHOLE = ("modes", "converged", "game", "placement", "executed", "step")
"""Integer fields of a record."""
DOUBLE = ("cost", "agent_cost", "weight", "phi")
"""Fields in double precision; all others are in single precision."""


def pool_config(seed: int, games: int, placements: int, solver: str, recipe: int) -> dict[str, Any]:
    """Configuration of a pool: all values that its records depend on."""
    return {
        "recipe": recipe,
        "seed": seed,
        "games": games,
        "placements": placements,
        "solver": solver,
        "settings": SETTINGS[solver]._asdict(),
        "constants": dataclasses.asdict(GameConstants()),
        "history": HISTORY,
        "future": FUTURE,
        "starts": [MAIN_STARTS, RANDOM_STARTS],
    }


def _play(
    seed: int, game: int, placement: int, placements: int, solver: str, recipe: int
) -> tuple[Records, dict[str, int]]:
    """Records of one placement of one main game, and the solver's counts."""
    constants = GameConstants()
    records, counts = play(seed, main_game(seed, game, placement, placements, constants, recipe), constants, solver)
    return {name: values.astype(_dtype(name)) for name, values in records.items()}, counts


def _dtype(name: str) -> type:
    return np.int64 if name in WHOLE else np.float64 if name in DOUBLE else np.float32


def _checksum(records: Records) -> str:
    total = hashlib.sha256()
    for name in sorted(records):
        total.update(name.encode() + np.ascontiguousarray(records[name]).tobytes())
    return total.hexdigest()


def _write_game(path: Path, pool: str, results: Sequence[tuple[Records, dict[str, int]]]) -> None:
    """Write the records of one main game, in the order of its placements."""
    full = [records for records, _ in results if records]
    names = full[0] if full else {}
    # safetensors writes the memory as it is, whatever the strides.
    records = {name: np.ascontiguousarray(np.concatenate([part[name] for part in full])) for name in names}
    counts = {name: sum(counts[name] for _, counts in results) for name in results[0][1]}
    about = {"pool": pool, "counts": counts, "sha256": _checksum(records)}
    cache.write_file(path, save(records, {"about": json.dumps(about, sort_keys=True)}))


def _read_game(path: Path, pool: str) -> tuple[Records, dict[str, int]] | None:
    """The records and counts of one main game; None if the file is missing, broken or of another pool."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="np") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
            records = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, ValueError, OSError):
        return None
    if about.get("pool") != pool or about.get("sha256") != _checksum(records):
        return None
    return records, about["counts"]


def make_pool(
    root: Path, config: Mapping[str, Any], workers: int | None, progress: bool
) -> tuple[Records, dict[str, int]]:
    """Records of all main games of a pool, after solving the games that are not on disk yet.

    Raises:
        cache.CacheError: a worker was killed, for instance for lack of memory.
        OSError: the disk is full or read-only.
    """
    name = cache.digest(config)
    folder = root / f"rpi-pool-{name[:12]}"
    paths = [folder / f"game-{game:04d}.safetensors" for game in range(config["games"])]
    with cache.locked(folder):
        with cache.writing(folder):
            folder.mkdir(exist_ok=True)
            for rest in folder.glob(".game-*"):  # incomplete files of a killed process
                rest.unlink()
        _solve_missing(paths, config, workers, progress)
    games = [_read_game(path, name) for path in paths]
    broken = [path for path, game in zip(paths, games, strict=True) if game is None]
    if broken:
        raise cache.CacheError(
            f"{broken[0]} cannot be read back: is the disk full? Delete it and run the command again"
        )
    full = [game[0] for game in games if game is not None and game[0]]
    if not full:
        raise cache.CacheError("no placement of any main game gave a record: use more placements or another seed")
    records = {key: np.concatenate([game[key] for game in full]) for key in full[0]}
    counts = [game[1] for game in games if game is not None]
    return records, {key: sum(count[key] for count in counts) for key in counts[0]}


def _solve_missing(paths: Sequence[Path], config: Mapping[str, Any], workers: int | None, progress: bool) -> None:
    """Solve the main games whose files are missing or broken, and write each when its last placement is solved."""
    name, placements = cache.digest(config), config["placements"]
    missing = [game for game, path in enumerate(paths) if _read_game(path, name) is None]
    of_all = (placements, config["solver"], config["recipe"])
    tasks = [(config["seed"], game, placement, *of_all) for game in missing for placement in range(placements)]
    report = Report(tasks, lambda task: task[1], "game", "solving", "solved", len(paths) - len(missing), progress)
    solved: dict[int, dict[int, tuple[Records, dict[str, int]]]] = {game: {} for game in missing}
    kept = f"finished main games are kept in {paths[0].parent}"
    # The first placement is solved by this process: it compiles the kernels, which the workers then find on disk.
    for task, result in finished(_play, tasks, workers, report, kept, first_here=True):
        game, placement = task[1:3]
        solved[game][placement] = result
        if len(solved[game]) == placements:
            _write_game(paths[game], name, [solved[game][p] for p in range(placements)])
            del solved[game]


def make_set(folder: Path, config: Mapping[str, Any], workers: int | None, progress: bool, command: str = "") -> Path:
    """The folder of a data set, made now unless it exists already.

    Args:
        folder: where it lies, or will lie, in the cache.
        config: its configuration: ``pool`` (see :func:`pool_config`), ``split`` (the rule by which records are assigned to
            splits) and ``sizes`` (most records of training, validation and test; None for all).
        workers: processes; None for one per core.
        progress: whether to report progress.
        command: makes this set; for error messages.

    Raises:
        cache.CacheError: the folder exists but is broken or of another configuration, a split would be empty, or a worker
            was killed.
        OSError: the disk is full or read-only.
    """
    if not cache.make_once(folder, lambda: _make_set(folder, config, workers, progress)):
        cache.verify(folder, command, config)
    return folder


def _make_set(folder: Path, config: Mapping[str, Any], workers: int | None, progress: bool) -> None:
    from epo_lightning.data.rpi.report import describe

    pool, split = config["pool"], config["split"]
    records, counts = make_pool(folder.parent, pool, workers, progress)
    constants = GameConstants()
    weights = np.array([main_game(pool["seed"], game, 0, 1, constants).weight for game in range(pool["games"])])
    indices = assign(split, pool["seed"], weights, records["game"], records["phi"], config["sizes"])
    splits = {name: {key: values[index] for key, values in records.items()} for name, index in indices.items()}
    empty = [name for name, values in splits.items() if not len(values["step"])]
    if empty:
        raise cache.CacheError(
            f"split {split!r} leaves no records for {', '.join(empty)}: use more games or placements"
        )
    report = describe(splits, counts, weights, pool)
    tensors = {name: {key: torch.from_numpy(values) for key, values in rows.items()} for name, rows in splits.items()}
    cache.write(folder, tensors, config, rounded(report))


def rounded(value: Any) -> Any:
    """A report's values as plain numbers with six significant digits; None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.6g}") if math.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value
