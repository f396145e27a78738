"""The data module ``recordings``: scenes are extracted from recordings once, kept in the cache and read in whole batches."""

from __future__ import annotations

import shutil
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from epo_lightning.checks import check_choice
from epo_lightning.data import cache
from epo_lightning.data.datamodule import SceneDataModule, SceneDataset
from epo_lightning.data.errors import RecordingError
from epo_lightning.data.recorded import summary
from epo_lightning.data.recorded.duplicates import used_once
from epo_lightning.data.recorded.extraction import Extracted
from epo_lightning.data.recorded.gathering import gathered
from epo_lightning.data.recorded.parts import Launch, Lazy, Parts
from epo_lightning.data.recorded.routes import LINES, PER_LINE
from epo_lightning.data.recorded.scenes import FRAMES, RecordedScenes
from epo_lightning.data.recorded.sources import (
    absent,
    altered,
    code_of,
    fingerprints,
    listed,
    warn_of_copies,
    with_options,
)
from epo_lightning.data.recorded.splits import ALL, UNITS, SplitRule
from epo_lightning.data.recorded.tables import selected
from epo_lightning.data.recorded.tracks import RecordingSource
from epo_lightning.data.recorded.versions import DUPLICATES, identifying_settings, of_older_versions
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.metrics.functional.interaction import SUBSETS
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import SHAPES
from epo_lightning.schema import read
from epo_lightning.task import Task


@register("data", "recordings")
class RecordedData(SceneDataModule):
    """Scenes extracted from a folder of recordings in any registered format.

    Args:
        dataset: name of the data in tables and in the cache.
        format: name of a registered recording format.
        options: options of the format, such as the frame rate of its files; null for none.
        folder: folder of the recordings, or of a data set that was extracted from them. If it does not exist, the cache is
            searched for a data set that was extracted with these settings.
        windows: selection of the windows that become scenes, fields of
            :class:`~epo_lightning.data.recorded.windows.WindowConfig`.
        map: whether to use lanes, and thus goal candidates.
        test: groups (maps, scenes, layouts) of the test split; null to draw ``test_share`` of them.
        test_share: share of the groups that is drawn for the test split.
        val_share: share of the remaining recordings or groups that is drawn for the validation split.
        val_by: ``recording`` or ``group``. Windows of one recording are never in two splits.
        frame: ``aligned`` (x along the agents' mean heading) or ``fixed`` (axes of the recording, the paper's).
        shape: agents' outline in the overlap rates, ``box`` or ``disc``.
        scale: length [m] that corresponds to 1 in the inputs of a network.
        root: folder of the cache; None for $EPO_CACHE or ``cache``.
        seed: seed of the random splits, and of the order of batches unless a run sets its own.
        batch_size: scenes per batch.
        share: share of the scenes of every split that is used, drawn once.
        duplicates: ``once`` to use the same vehicles at the same moments once where recordings overlap, within a split and
            across splits (:mod:`~epo_lightning.data.recorded.duplicates`); ``keep`` to use every recording as it is.

    Attributes:
        whole: whether all recordings form a single split ``all``, for tests of forecasters that learned on other data. It is
            set before anything is read.
    """

    whole = False

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
        options: Mapping[str, Any] | None = None,
        duplicates: str = "keep",
    ) -> None:
        super().__init__(batch_size, seed, share)
        self.dataset_name, self.format, self.folder_of_recordings = dataset, format, Path(folder).expanduser()
        if not str(dataset) or str(dataset).startswith(".") or "/" in str(dataset):
            raise ConfigError(
                f"data.dataset must be a name without slashes and without a point at its beginning, not {dataset!r}: "
                "folders in the cache are named after it"
            )
        self.options = dict(options or {})
        self.list_sources, self.reader = with_options(format, self.options), code_of(format)
        self.windows = read(WindowConfig, windows, "data.windows")
        self.num_agents, self.history = self.windows.agents, self.windows.history
        if self.windows.lane_change and not map:
            raise ConfigError("data.windows.lane_change asks for lanes, but data.map is false: set it to false as well")
        for name, value in (("test_share", test_share), ("val_share", val_share)):
            if not 0 < value < 1:
                raise ConfigError(f"data.{name} must be a share between 0 and 1, not {value}")
        check_choice("data.frame", frame, FRAMES)
        check_choice("data.val_by", val_by, UNITS)
        check_choice("data.shape", shape, SHAPES)
        check_choice("data.duplicates", duplicates, DUPLICATES)
        groups = None if test is None else tuple(str(group) for group in test)
        self.rule = SplitRule(groups, test_share, val_share, val_by, seed)
        self.duplicates = duplicates
        if not 0 < scale < np.inf:
            raise ConfigError(
                f"data.scale must be positive, not {scale}: the length [m] that corresponds to 1 in the inputs of a network"
            )
        self.frame = frame
        candidates = (self.windows.lines or LINES) * PER_LINE if map else 0
        self.task = Task(
            horizon=self.windows.horizon,
            dt=float(self.windows.dt),
            subsets=SUBSETS,
            shape=shape,
            candidates=candidates,
            map=map,
            scale=float(scale),
            history=self.history,
        )
        self.root = Path(root).expanduser() if root else cache.default_root()

    def sources(self) -> list[RecordingSource]:
        """The recordings, sorted by name.

        Raises:
            ConfigError: the folder is missing or holds no recording.
        """
        return listed(
            self.list_sources, self.folder_of_recordings, dataset=self.dataset_name, format=self.format, root=self.root
        )

    def splits(self, sources: Sequence[RecordingSource]) -> dict[str, list[RecordingSource]]:
        """The recordings of each split.

        Raises:
            ConfigError: ``test`` names a group that does not exist, or there are too few recordings for three splits.
        """
        if self.whole:
            return {ALL: list(sources)}
        return self.rule.checked(sources)

    def identity(self, sources: Sequence[RecordingSource]) -> Any:
        """Plain values that identify the recordings: names, groups, and names, sizes and checksums of all files."""
        # Files may be common to recordings: maps, and shards with hundreds of scenarios.
        known = fingerprints(list(dict.fromkeys(file for source in sources for file in source.files)), self.root)
        return [[source.name, source.group, [known[file] for file in source.files]] for source in sources]

    @cached_property
    def config(self) -> dict[str, Any]:
        """Configuration of the data set: all values that its files depend on.

        If the recordings are absent, it is read from the data set in the cache that was extracted with these settings.

        Raises:
            ConfigError: neither recordings nor an extracted data set exists, or several data sets fit the settings.
        """
        home = self.folder_of_recordings
        if cache.is_set(home):
            config: dict[str, Any] = cache.manifest(home)["config"]
            if not self._gives(config):
                known = {key: config.get(key) for key in self._settings()}
                keys = ", ".join(cache.differing(self._settings(), known)[:3]) or "the splits"
                raise ConfigError(
                    f"data.folder={home} is a data set that was extracted with other settings: it differs in {keys}"
                )
            return config
        extracted = [] if home.exists() else self._extracted()
        if len(extracted) > 1:
            names = ", ".join(
                f"data.folder={folder} ({len(config['recordings'])} recordings)" for folder, config in extracted
            )
            raise ConfigError(
                f"there is no folder {home} of {self.dataset_name} recordings, and several data sets were extracted with "
                f"these settings; correct data.folder, or choose one of {names}"
            )
        if extracted:
            made, config = extracted[0]
            warnings.warn(
                f"there is no folder {home}: the data set {made} is used, which was extracted with these settings from "
                f"{len(config['recordings'])} recordings; correct data.folder if you have recordings",
                stacklevel=2,
            )
            return config
        sources = self.sources()
        whole = self._config_of(sources, self.identity(sources))
        made = self.root / self._name(whole)
        without = None if made.exists() else self._without_broken(whole["recordings"])
        if without is None:
            return whole
        warnings.warn(
            f"{len(without['skipped'])} of {len(sources)} recordings in {home} could not be read when the data set was "
            f"extracted, and are left out: {', '.join(name for name, *_ in without['skipped'])}; mend or remove them",
            stacklevel=2,
        )
        return without

    def _settings(self) -> dict[str, Any]:
        """The part of the data set's configuration that does not depend on the recordings."""
        return identifying_settings(
            self.dataset_name, self.format, self.windows, self.task.map, self.options, self.reader, self.duplicates
        )

    def _config_of(self, sources: Sequence[RecordingSource], identity: Any, skipped: Any = ()) -> dict[str, Any]:
        """The configuration of a data set from ``sources``; ``skipped`` identifies recordings that could not be read."""
        splits = {split: [source.name for source in held] for split, held in self.splits(sources).items()}
        config = {**self._settings(), "recordings": identity, "splits": splits}
        return {**config, "skipped": list(skipped)} if skipped else config

    def _without_broken(self, identity: Any) -> dict[str, Any] | None:
        """The configuration of a data set that was extracted from exactly these files, some of which could not be read."""
        for _, config in self._extracted():
            if config.get("skipped") and sorted([*config["recordings"], *config["skipped"]]) == sorted(identity):
                return config
        return None

    def _extracted(self) -> list[tuple[Path, dict[str, Any]]]:
        """Data sets in the cache that were extracted with these settings, and their configurations."""
        return [found for found in cache.configs(self.root, self.dataset_name) if self._gives(found[1])]

    def _gives(self, config: Mapping[str, Any]) -> bool:
        """Whether these settings, applied to the recordings that ``config`` names, give exactly ``config``."""
        try:
            sources = [RecordingSource(name, group, (), absent) for name, group, _ in config["recordings"]]
            return self._config_of(sources, config["recordings"], config.get("skipped", ())) == config
        except (ConfigError, KeyError, TypeError, ValueError):
            return False

    @property
    def folder(self) -> Path:
        """Folder of the data set, whether or not it exists."""
        if cache.is_set(self.folder_of_recordings):
            return self.folder_of_recordings
        return self.root / self._name(self.config)

    def _name(self, config: Mapping[str, Any]) -> str:
        return f"{self.dataset_name}-{cache.digest(config)[:12]}"

    @property
    def digest(self) -> str:
        """Hash of everything that a run's data depends on."""
        return self._digest(self.config)

    def _digest(self, config: Mapping[str, Any]) -> str:
        return cache.digest({"set": config, "frame": self.frame})[:16]

    def is_older(self, digest: str) -> bool:
        """Whether a digest is that of the same recordings, splits and settings, extracted by an older version."""
        return any(self._digest(config) == digest for config in of_older_versions(self.config))

    @property
    def own_words(self) -> list[str]:
        """Overrides that choose this data set."""
        words = [f"data={self.dataset_name}", f"data.folder={self.folder_of_recordings}"]
        if self.root != cache.default_root():
            words.append(f"data.root={self.root}")
        return words

    def generate(
        self, workers: int | None = None, progress: bool = True, strict: bool = False, launch: Launch | None = None
    ) -> Path:
        """Extract the scenes unless that was done before, and return the folder of the data set.

        Args:
            workers: processes; None for one per core. The bytes do not depend on it.
            progress: whether to report progress.
            strict: whether a recording that cannot be read is an error. Otherwise it is left out and reported, and the data
                set is not that of the whole folder: its configuration names the recordings that were left out.
            launch: function that has parts of the data set extracted by jobs elsewhere; None for processes of this machine.

        Raises:
            ConfigError: a recording that cannot be read if ``strict``, no recording that can be read, a split without
                scenes, or a killed worker.
            OSError: the disk is full or read-only.
        """

        def make() -> None:
            # Another process may have extracted the readable ones of these recordings in the meantime.
            self.__dict__.pop("config", None)
            if strict or not self.folder.exists():
                self._make(workers, progress, strict, launch)

        if strict and self.config.get("skipped"):
            make()  # a recording that still cannot be read is an error
        elif not cache.make_once(self.folder, make):
            cache.verify(self.folder, self.command, self.config)
        return self.folder

    def recordings(self) -> list[RecordingSource]:
        """The recordings that scenes are extracted from."""
        return self.sources()

    def _make(self, workers: int | None, progress: bool, strict: bool, launch: Launch | None) -> None:
        """Extract the recordings into parts, then gather the scenes of each split from them."""
        recordings = self.recordings()
        identity = self.identity(recordings)
        config = self._config_of(recordings, identity)
        work = self.root / f".{self._name(config)}-parts"
        with cache.writing(work):
            work.mkdir(parents=True, exist_ok=True)
        parts = Parts(work, recordings)
        tasks = parts.tasks(self.windows, self.task.map, strict, self.duplicates == "once")
        parts.extract(tasks, workers, progress, launch)
        if names := altered(identity, self.identity(recordings)):
            shutil.rmtree(work, ignore_errors=True)
            raise ConfigError(f"files of {names[0]} have changed while they were read: give the command again")
        if isinstance(identity, list):  # simulated recordings are identified by their settings instead
            warn_of_copies(recordings, identity)
        extracted = parts.extracted()
        problems = {name: one.problem for name, one in extracted.items() if one.problem is not None}
        used = [source for source in recordings if source.name not in problems]
        if not used:
            raise RecordingError(
                self.folder_of_recordings, f"no recording can be read; the first one: {next(iter(problems.values()))}"
            )
        if problems:
            known = {source.name: entry for source, entry in zip(recordings, identity, strict=True)}
            config = self._config_of(
                used, [known[source.name] for source in used], [known[name] for name in sorted(problems)]
            )
        self.__dict__["config"] = config
        self._write(recordings, used, parts, extracted)
        shutil.rmtree(work, ignore_errors=True)

    def _write(
        self,
        sources: Sequence[RecordingSource],
        used: Sequence[RecordingSource],
        parts: Parts,
        extracted: Mapping[str, Extracted],
    ) -> None:
        """Gather the scenes of every split and write the data set."""
        splits = self.splits(used)
        names = {split: [source.name for source in held] for split, held in splits.items()}
        tables = Lazy([source.name for source in used], parts.tables)
        counts = {source.name: Counter(extracted[source.name].counts) for source in used}
        if self.duplicates == "once":
            kept, less = used_once(names, tables, Lazy(tables.names, parts.drives), self.windows)
            for name, mask in kept.items():
                counts[name] += less[name]
                counts[name]["scenes"] = int(mask.sum())
            tables = Lazy(tables.names, lambda name: selected(parts.tables(name), kept.get(name)))
        warned = {source.name: extracted[source.name].about.get("warnings", ()) for source in used}
        self.rule.refuse_empty(self.dataset_name, used, splits, counts, warned)
        with gathered(names, tables, counts, extracted, parts) as (tensors, about):
            rows = summary.rows_of(sources, splits, extracted, counts)
            problems = {name: one.problem for name, one in extracted.items() if one.problem is not None}
            report = {**about, "recordings": names, **({"skipped": problems} if problems else {})}
            cache.write(self.folder, tensors, self.config, report, {summary.FILE: summary.to_csv(rows)})

    def report(self) -> dict[str, Any]:
        """The report that was written with the data set.

        Raises:
            cache.CacheError: the data set is missing, broken or of another configuration.
        """
        return cache.manifest(self.folder, self.command, self.config)["report"]

    def summary(self) -> list[str]:
        """Lines on what was extracted, for the terminal: by split, by recording, and recordings that were left out.

        Raises:
            cache.CacheError: as :meth:`report`.
        """
        report, recordings = self.report(), summary.per_recording(self.folder)
        skipped = [f"left out: {name}: {problem}" for name, problem in report.get("skipped", {}).items()]
        return [*summary.by_split(report), *(["", *recordings] if recordings else []), *skipped]

    def open(self, split: str) -> SceneDataset:
        """The scenes of a split; those of validation and test splits have a subset, calm or interactive.

        Raises:
            cache.CacheError: the data set is missing, broken, of another configuration, or holds numbers that are not
                finite.
        """
        tables = cache.load(self.folder, split, command=self.command, config=self.config)
        shape = None if split == "train" else self.task.shape
        return RecordedScenes(tables, self.task.dt, self.frame, self.report()["recordings"][split], shape)
