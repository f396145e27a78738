"""Making the set: solve every main game at every placement, then cut the pool of records into splits.

The pool, one file per main game, depends on the games alone; sets with other splits or sizes share it. Every placement
draws from its own random numbers, so the bytes do not depend on the number of workers, and a run that was killed goes on
with the first main game that is not finished. The pool may be deleted once the sets are made.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from epo_lightning.data import cache
from epo_lightning.data.rpi.game import GameConstants, main_game
from epo_lightning.data.rpi.solve import FeedbackSettings, PotentialSettings
from epo_lightning.data.rpi.splits import assign
from epo_lightning.data.rpi.subgames import FUTURE, HISTORY, MAIN_STARTS, RANDOM_STARTS, Records, play
from epo_lightning.data.workers import finished

RECIPE = 1
"""Version of the numerical recipe: raised whenever the same configuration would give other records."""
WHOLE = ("modes", "converged", "game", "placement", "executed", "step")
"""Fields that are whole numbers; ``cost``, ``agent_cost``, ``weight`` and ``phi`` stay in double precision."""
DOUBLE = ("cost", "agent_cost", "weight", "phi")


def pool_config(seed: int, games: int, placements: int, solver: str) -> dict[str, Any]:
    """Everything that the pool depends on."""
    settings = FeedbackSettings() if solver == "feedback" else PotentialSettings()
    return {
        "recipe": RECIPE,
        "seed": seed,
        "games": games,
        "placements": placements,
        "solver": solver,
        "settings": dataclasses.asdict(settings),
        "constants": dataclasses.asdict(GameConstants()),
        "history": HISTORY,
        "future": FUTURE,
        "starts": [MAIN_STARTS, RANDOM_STARTS],
    }


def set_config(pool: Mapping[str, Any], split: str, sizes: Sequence[int] | None) -> dict[str, Any]:
    """Everything that a set depends on."""
    return {"pool": dict(pool), "split": split, "sizes": None if sizes is None else list(sizes)}


def set_folder(root: Path, config: Mapping[str, Any]) -> Path:
    """Where the set of a configuration is kept."""
    return root / f"rpi-{cache.digest(config)[:12]}"


def _play(seed: int, game: int, placement: int, placements: int, solver: str) -> tuple[Records, dict[str, int]]:
    """Solve one placement of one main game."""
    constants = GameConstants()
    records, counts = play(seed, main_game(seed, game, placement, placements, constants), constants, solver)
    return {name: values.astype(_dtype(name)) for name, values in records.items()}, counts


def _dtype(name: str) -> type:
    return np.int64 if name in WHOLE else np.float64 if name in DOUBLE else np.float32


def _checksum(records: Records) -> str:
    total = hashlib.sha256()
    for name in sorted(records):
        total.update(name.encode() + np.ascontiguousarray(records[name]).tobytes())
    return total.hexdigest()


def _write_part(path: Path, pool: str, results: Sequence[tuple[Records, dict[str, int]]]) -> None:
    """Write the records of one main game, in the order of its placements, atomically."""
    full = [records for records, _ in results if records]
    names = full[0] if full else {}
    # safetensors writes memory as it lies, so it must lie in the order of its indices.
    records = {name: np.ascontiguousarray(np.concatenate([part[name] for part in full])) for name in names}
    counts = {name: sum(counts[name] for _, counts in results) for name in results[0][1]}
    about = {"pool": pool, "counts": counts, "sha256": _checksum(records)}
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_bytes(save(records, {"about": json.dumps(about, sort_keys=True)}))
    temporary.replace(path)


def _read_part(path: Path, pool: str) -> tuple[Records, dict[str, int]] | None:
    """The records and counts of one main game, or None where the file is missing, broken or of another pool."""
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
    """All records of all main games, solving those that are not on disk yet.

    Raises:
        cache.CacheError: a worker was killed, for instance for lack of memory.
    """
    name = cache.digest(config)
    folder = root / f"rpi-pool-{name[:12]}"
    folder.mkdir(parents=True, exist_ok=True)
    games, placements = config["games"], config["placements"]
    paths = [folder / f"game-{game:04d}.safetensors" for game in range(games)]
    missing = [game for game in range(games) if _read_part(paths[game], name) is None]
    done: dict[int, dict[int, tuple[Records, dict[str, int]]]] = {game: {} for game in missing}

    def finish(task: tuple[Any, ...], result: tuple[Records, dict[str, int]]) -> None:
        _, game, placement, _, _ = task
        done[game][placement] = result
        if len(done[game]) == placements:
            _write_part(paths[game], name, [done[game][p] for p in range(placements)])
            del done[game]

    tasks = [(config["seed"], game, p, placements, config["solver"]) for game in missing for p in range(placements)]
    before, kept = games * placements - len(tasks), f"finished main games are kept in {folder}"
    if tasks:
        # The first placement is solved here: it compiles the kernels, which the workers then find on disk.
        finish(tasks[0], _play(*tasks[0]))
    for task, result in finished(
        _play, tasks[1:], workers, progress, "solving games", "placements", before + bool(tasks), kept
    ):
        finish(task, result)
    parts = [_read_part(path, name) for path in paths]
    broken = [path for path, part in zip(paths, parts, strict=True) if part is None]
    if broken:
        raise cache.CacheError(
            f"{broken[0]} cannot be read back: is the disk full? Delete it and run the command again"
        )
    full = [part[0] for part in parts if part is not None and part[0]]
    if not full:
        raise cache.CacheError("no placement of any main game gave a record: use more placements or another seed")
    records = {key: np.concatenate([part[key] for part in full]) for key in full[0]}
    counts = [part[1] for part in parts if part is not None]
    return records, {key: sum(count[key] for count in counts) for key in counts[0]}


def make_set(
    root: Path, pool: Mapping[str, Any], split: str, sizes: Sequence[int] | None, workers: int | None, progress: bool
) -> Path:
    """The folder of a set, made now unless it is there already.

    Raises:
        cache.CacheError: the folder is there but broken, a split would be empty, or a worker was killed.
    """
    from epo_lightning.data.rpi.report import describe

    config = set_config(pool, split, sizes)
    folder = set_folder(root, config)
    if folder.exists():
        cache.verify(folder)
        return folder
    records, counts = make_pool(root, pool, workers, progress)
    constants = GameConstants()
    weights = np.array([main_game(pool["seed"], game, 0, 1, constants).weight for game in range(pool["games"])])
    parts = {
        part: {name: values[index] for name, values in records.items()}
        for part, index in assign(split, pool["seed"], weights, records["game"], records["phi"], sizes).items()
    }
    empty = [part for part, values in parts.items() if not len(values["step"])]
    if empty:
        raise cache.CacheError(
            f"split {split!r} leaves no records for {', '.join(empty)}: use more games or placements"
        )
    report = describe(parts, counts, weights, pool)
    tensors = {part: {name: torch.from_numpy(values) for name, values in rows.items()} for part, rows in parts.items()}
    return cache.write(folder, tensors, config, rounded(report))


def rounded(value: Any) -> Any:
    """Plain numbers with six significant digits: a report is for reading."""
    if isinstance(value, Mapping):
        return {str(key): rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.6g}") if math.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value
