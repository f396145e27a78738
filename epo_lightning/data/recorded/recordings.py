"""Recordings as data for training: scenes extracted once, kept in the cache, read by whole batches."""

from __future__ import annotations

import dataclasses
import json
import shutil
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch import Tensor

from epo_lightning.data import cache
from epo_lightning.data.datamodule import SceneDataModule, SceneDataset
from epo_lightning.data.recorded.routes import LINES, PER_LINE
from epo_lightning.data.recorded.scenes import FRAMES, RecordedScenes
from epo_lightning.data.recorded.tracks import Source
from epo_lightning.data.recorded.windows import Extract, Recipe, extract, joined
from epo_lightning.data.workers import finished
from epo_lightning.registry import ConfigError, lookup, nearest, register
from epo_lightning.task import Task

VERSION = 2
"""Of the extraction: raised whenever the same recordings would give other scenes."""
PARTS = ("train", "val", "test")
PIECE, PIECES = 1 << 14, 64
"""Bytes of a piece of a file, and how many of them its checksum is made of: all of it up to 1 MB."""
UNITS = ("recording", "group")


def _recipe(windows: Mapping[str, Any]) -> Recipe:
    """The recipe that a configuration spells out."""
    known = {field.name: getattr(Recipe, field.name) for field in dataclasses.fields(Recipe)}
    optional = {"radius": float, "smoothing": float}
    for key, value in windows.items():
        if key not in known:
            raise ConfigError(f"unknown key data.windows.{key}: {nearest(str(key), known)}")
        kind = optional.get(key, type(known[key]))
        if value is None and key in optional:
            continue
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number if kind is float else type(value) is kind):
            expected = {float: "a number", int: "a whole number", bool: "true or false"}[kind]
            raise ConfigError(f"data.windows.{key} must be {expected}, not {value!r}")
    return Recipe(**windows)


@register("data", "recordings")
class RecordedData(SceneDataModule):
    """Scenes extracted from a folder of recordings in any registered format.

    Args:
        dataset: how tables and the cache call the data.
        format: name of a registered recording format.
        folder: where the recordings are.
        windows: what becomes a scene: fields of :class:`~epo_lightning.data.recorded.windows.Recipe`.
        map: whether there are lanes, and thus goal candidates.
        test: groups (maps, scenes, layouts) that are the test split; null to draw ``test_share`` of them.
        test_share: of the groups.
        val_share: of what remains, drawn by ``val_by``.
        val_by: ``recording`` or ``group``. Windows of one recording are never in two splits.
        frame: ``aligned`` (x where the agents head on average) or ``fixed`` (axes of the recording, as in the paper).
        shape: agents' outline in the overlap rates, ``box`` or ``disc``.
        scale: metres that an input of one of a network stands for.
        root: folder of the cache; None for $EPO_CACHE or ``cache``.
        seed: of the draws, and of the batches' order where a run sets no other.
        batch_size: scenes per batch.
        share: of the scenes of every split that is used, drawn once.
    """

    def __init__(
        self,
        dataset: str,
        format: str,
        folder: str,
        windows: Mapping[str, Any],
        map: bool = True,
        test: Sequence[str] | None = None,
        test_share: float = 0.12,
        val_share: float = 0.18,
        val_by: str = "recording",
        frame: str = "aligned",
        shape: str = "box",
        scale: float = 20.0,
        root: str | None = None,
        seed: int = 0,
        batch_size: int = 32,
        share: float = 1.0,
    ) -> None:
        super().__init__(batch_size, seed, share)
        self.dataset_name, self.format, self.folder_of_recordings = dataset, format, Path(folder).expanduser()
        self.list_sources = lookup("format", format)
        self.recipe = _recipe(windows)
        self.num_agents = self.recipe.agents
        if self.recipe.lane_change and not map:
            raise ConfigError("data.windows.lane_change asks for lanes, but data.map is false: set it to false as well")
        self.test = None if test is None else [str(group) for group in test]
        for name, share in (("test_share", test_share), ("val_share", val_share)):
            if not 0 < share < 1:
                raise ConfigError(f"data.{name} must be a share between 0 and 1, not {share}")
        for name, value, known in (
            ("frame", frame, FRAMES),
            ("val_by", val_by, UNITS),
            ("shape", shape, ("box", "disc")),
        ):
            if value not in known:
                raise ConfigError(f"unknown data.{name} {value!r}: {nearest(str(value), known)}")
        self.test_share, self.val_share, self.val_by = test_share, val_share, val_by
        if not 0 < scale < np.inf:
            raise ConfigError(f"data.scale must be positive, not {scale}: the metres that an input of one stands for")
        self.frame = frame
        candidates = LINES * PER_LINE if map else 0
        self.task = Task(self.recipe.horizon, float(self.recipe.dt), (), shape, candidates, map=map, scale=float(scale))
        self.root = Path(root).expanduser() if root else cache.default_root()

    def sources(self) -> list[Source]:
        """The recordings, in the order of their names.

        Raises:
            ConfigError: no folder, or nothing in it.
        """
        folder = self.folder_of_recordings
        if folder.is_file():
            raise ConfigError(f"{folder} is a file: data.folder takes the folder that it lies in")
        if not folder.is_dir():
            raise ConfigError(
                f"no folder {folder} with {self.dataset_name} recordings: point data.folder at it, "
                "or unpack the recordings there"
            )
        found = sorted(self.list_sources(folder), key=lambda source: source.name)
        if not found:
            raise ConfigError(f"{folder} holds no recording in the format {self.format!r}: is it the right folder?")
        return found

    def splits(self, sources: Sequence[Source]) -> dict[str, list[Source]]:
        """Which recordings belong to which split.

        Raises:
            ConfigError: a group that does not exist, or too few recordings for three splits.
        """
        draw = np.random.default_rng([self.seed, 4])
        groups = sorted({source.group for source in sources})
        if self.test is None:
            chosen = set(draw.permutation(groups)[: max(1, round(self.test_share * len(groups)))].tolist())
        else:
            chosen = set(self.test)
            for group in sorted(chosen - set(groups)):
                raise ConfigError(
                    f"data.test names the group {group!r}, which no recording has: {nearest(group, groups)}"
                )
        rest = [source for source in sources if source.group not in chosen]
        unit = "name" if self.val_by == "recording" else "group"
        units = sorted({getattr(source, unit) for source in rest})
        held = set(draw.permutation(units)[: max(1, round(self.val_share * len(units)))].tolist())
        found = {
            "train": [source for source in rest if getattr(source, unit) not in held],
            "val": [source for source in rest if getattr(source, unit) in held],
            "test": [source for source in sources if source.group in chosen],
        }
        empty = [part for part in PARTS if not found[part]]
        if empty:
            raise ConfigError(
                f"{len(sources)} recording(s) in {len(groups)} group(s) leave none for {', '.join(empty)}: "
                "three splits need recordings of their own"
            )
        return found

    def identity(self, sources: Sequence[Source]) -> Any:
        """What tells these recordings from others: names, sizes and checksums of all files."""
        return [[source.name, source.group, [_fingerprint(file) for file in source.files]] for source in sources]

    @cached_property
    def config(self) -> dict[str, Any]:
        """Everything that the set on disk depends on."""
        sources = self.sources()
        return {
            "version": VERSION,
            "dataset": self.dataset_name,
            "format": self.format,
            "recordings": self.identity(sources),
            "windows": dataclasses.asdict(self.recipe),
            "map": self.task.map,
            "splits": {part: [source.name for source in held] for part, held in self.splits(sources).items()},
        }

    @property
    def folder(self) -> Path:
        """Where the set lies, or will lie."""
        return self.root / f"{self.dataset_name}-{cache.digest(self.config)[:12]}"

    @property
    def digest(self) -> str:
        """Hash of everything that a run's data depends on."""
        return cache.digest({"set": self.config, "frame": self.frame})[:16]

    @property
    def command(self) -> str:
        """The command that makes this set, for error messages."""
        return f"epo generate data={self.dataset_name}"

    def generate(self, workers: int | None = None, progress: bool = True) -> Path:
        """Extract the scenes unless they are there already, and return the set's folder.

        Args:
            workers: processes; None for one per core. The bytes do not depend on it.
            progress: whether to show a progress bar.

        Raises:
            ConfigError: a recording that cannot be read, a split without scenes, or a killed worker.
        """
        with cache.alone(self.folder):
            if not self.folder.exists():
                return self._make(self.folder, workers, progress)
        cache.verify(self.folder, self.command)
        return self.folder

    def recordings(self) -> list[Source]:
        """What scenes are extracted from."""
        return self.sources()

    def _make(self, folder: Path, workers: int | None, progress: bool) -> Path:
        parts = folder.with_name(f".{folder.name}-parts")
        parts.mkdir(parents=True, exist_ok=True)
        recordings = {source.name: source for source in self.recordings()}
        splits = self.splits(list(recordings.values()))
        files = {name: parts / f"{number:04d}.safetensors" for number, name in enumerate(recordings)}
        done = [name for name, file in files.items() if _complete(file)]
        tasks = [
            (source, self.recipe, self.task.map, files[name]) for name, source in recordings.items() if name not in done
        ]
        kept = "finished recordings are kept"
        for _ in finished(
            _extract_to_file, tasks, workers, progress, "extracting scenes", "recordings", len(done), kept
        ):
            pass
        tensors, report = {}, {}
        for part in PARTS:
            tensors[part], report[part] = self._gather(part, [files[source.name] for source in splits[part]])
        names = {part: [source.name for source in splits[part]] for part in PARTS}
        made = cache.write(folder, tensors, self.config, {**report, "recordings": names})
        shutil.rmtree(parts)
        return made

    def _gather(self, part: str, files: Sequence[Path]) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The scenes of a split, and what there is to say about them."""
        counts: Counter[str] = Counter()
        extracts = []
        for file in files:
            columns, counted = _read(file)
            counts.update(counted)
            # A recording without scenes still has its place in the order of recordings.
            extracts.append(Extract(**columns) if columns else None)
        full = [found for found in extracts if found is not None]
        if not full:
            gone = ", ".join(f"{reason}: {count}" for reason, count in counts.items() if count) or "no window at all"
            raise ConfigError(
                f"the split {part!r} of {self.dataset_name} has not a single scene ({gone}): relax data.windows, or give it "
                "more recordings"
            )
        whole = joined(full)
        index = np.array([number for number, found in enumerate(extracts) if found is not None])
        columns = {field.name: getattr(whole, field.name) for field in dataclasses.fields(Extract)}
        origin = np.zeros((len(files), 2))
        origin[index] = whole.origin
        columns["recording"], columns["origin"] = index[whole.recording].astype(np.int32), origin
        tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in columns.items()}
        return tensors, {**dict(counts), **_describe(whole)}

    def report(self) -> dict[str, Any]:
        """The report that the set was made with.

        Raises:
            cache.CacheError: the set is missing or broken.
        """
        return cache.manifest(self.folder, self.command)["report"]

    def open(self, split: str) -> SceneDataset:
        """The scenes of a split.

        Raises:
            cache.CacheError: the set is missing, broken, of another format, or holds numbers that are not finite.
        """
        folder = self.folder
        tables = cache.load(folder, split, command=self.command)
        names = cache.manifest(folder, self.command)["report"]["recordings"][split]
        return RecordedScenes(tables, self.task.dt, self.frame, names)


def _fingerprint(file: Path) -> list[Any]:
    """Name, size and a checksum of a file, of large ones only pieces all over them: recordings have gigabytes."""
    size, checksum = file.stat().st_size, 0
    with file.open("rb") as content:
        for place in range(0, size, max(PIECE, (size - PIECE) // PIECES)):
            content.seek(place)
            checksum = zlib.crc32(content.read(PIECE), checksum)
    return [file.name, size, checksum]


def _extract_to_file(source: Source, recipe: Recipe, has_map: bool, file: Path) -> None:
    """Extract the scenes of one recording into a file, atomically."""
    recording = source.read()
    if has_map and recording.lanes is None:
        raise ConfigError(f"the recording {source.name} has no map: set data.map=false, or give it one")
    if not has_map:
        recording = dataclasses.replace(recording, lanes=None)
    found, counts = extract(recording, recipe)
    columns = {} if found is None else {field.name: getattr(found, field.name) for field in dataclasses.fields(Extract)}
    # safetensors writes memory as it lies, so it must lie in the order of its indices.
    ordered = {name: np.ascontiguousarray(values) for name, values in columns.items()}
    temporary = file.with_suffix(".tmp")
    temporary.write_bytes(save(ordered, {"counts": json.dumps(counts)}))
    temporary.replace(file)


def _read(file: Path) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    with safe_open(file, framework="np") as content:
        counts = json.loads(content.metadata()["counts"])
        return {name: content.get_tensor(name) for name in content.keys()}, counts  # noqa: SIM118 - not a mapping


def _complete(file: Path) -> bool:
    """Whether a part was written whole: it was renamed into place, so it is, unless somebody damaged it."""
    try:
        return file.is_file() and bool(_read(file)[1])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError):
        return False


def _describe(scenes: Extract) -> dict[str, Any]:
    """Numbers for people who want to know what they train on."""
    speed = scenes.history[:, -1, 3]
    found: dict[str, Any] = {
        "agents per scene": float((scenes.agents >= 0).sum(1).mean()),
        "speed [m/s], 5th and 95th percentile": [float(value) for value in np.percentile(speed, [5, 95])],
    }
    ends = scenes.future_mask[:, -1]
    if scenes.candidates.shape[1] and ends.any():
        way = scenes.candidates[ends] - scenes.future[ends, -1, None, :2]
        nearest_goal = np.linalg.norm(way, axis=-1).min(1)
        found["way to the nearest goal candidate [m], mean and 95th percentile"] = [
            float(nearest_goal.mean()),
            float(np.percentile(nearest_goal, 95)),
        ]
    return found
