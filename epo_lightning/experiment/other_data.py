"""Data on which a run was not trained, as the run's forecaster can read it: `epo evaluate run=... data=...`.

The windows of the other data follow the run: its time step, history, horizon and number of agents. Everything else, such as
the filters and the frame rate, belongs to the data. What cannot be followed is refused with a reason.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from torch.utils.data import DataLoader

from epo_lightning.data import open_space
from epo_lightning.data.cache import digest
from epo_lightning.data.datamodule import BatchSampler, SceneDataModule, SceneDataset, Share
from epo_lightning.data.open_space import OpenSpace
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.splits import ALL
from epo_lightning.data.recorded.windows import WindowConfig
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.forecasters import Forecaster
from epo_lightning.identity import data_recipe
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.scene import KINDS
from epo_lightning.task import Task

FIXED = ("dt", "horizon")
"""Settings of windows that a forecaster cannot change."""


@dataclass(frozen=True)
class OtherData:
    """One split of a data set, for a run that was trained on other data.

    Attributes:
        name: name of the data set.
        split: name of the split; ``all`` for all recordings.
        data: the data module.
        scenes: the scenes, as the run's forecaster reads them.
        section: the settings of the data, after they have followed the run.
        notes: statements about what was changed, and about recordings that the run was trained on.
    """

    name: str
    split: str
    data: Any
    scenes: SceneDataset
    section: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def task(self) -> Task:
        """Sizes and units of the data; its outline of agents is that of the overlap rates."""
        task: Task = self.data.task
        return task

    @property
    def digest(self) -> str:
        """Hash of the settings and files of the scenes."""
        return str(self.data.digest)

    @property
    def test(self) -> str:
        """Hash of everything but the run that a score depends on."""
        added = open_space.VERSION if isinstance(self.scenes, OpenSpace) else None
        share, shape = getattr(self.data, "share", 1.0), self.task.shape
        return digest({"data": self.digest, "split": self.split, "share": share, "shape": shape, "open": added})[:16]

    def loader(self, batch_size: int) -> DataLoader:
        """Batches of the scenes in their order."""
        sampler = BatchSampler(self.scenes, batch_size, shuffle=False, seed=0)
        return DataLoader(self.scenes, sampler=sampler, batch_size=None, num_workers=0)  # type: ignore[arg-type]

    def about(self) -> dict[str, Any]:
        """Numbers of scenes, recordings and agents by kind, where known, for the file of the scores."""
        found: dict[str, Any] = {"scenes": len(self.scenes)}
        if isinstance(self.data, RecordedData):
            found["recordings"] = len(self.data.report()["recordings"][self.split])
        whole: Any = self.scenes
        while hasattr(whole, "whole"):
            whole = whole.whole
        tables = getattr(whole, "tables", {})
        if "kind" in tables and "agents" in tables:
            members = tables["agents"][tables["agents"] >= 0].long()
            counts = Counter(tables["kind"][members].tolist())
            found["agents"] = {KINDS[kind]: count for kind, count in counts.most_common()}
        return found


def open_other(
    run: RunFolder,
    of_run: Settings,
    forecaster: Forecaster,
    section: Mapping[str, Any],
    split: str | None,
    given: Collection[str] = (),
    workers: int | None = None,
) -> OtherData:
    """The split of another data set for a run. Recordings whose scenes are not in the cache are extracted first.

    Args:
        run: the run.
        of_run: the run's settings.
        forecaster: the run's forecaster.
        section: settings of the other data.
        split: ``all``, ``test``, ``val`` or ``train``. None means all recordings; the test split if the data is that of the
            run, or no recordings.
        given: keys that the user has set, such as ``data.windows.history``: they are not replaced by those of the run.
        workers: processes that extract recordings; None for one per core.

    Raises:
        ConfigError: the run's forecaster cannot read the data, or the data cannot be read; or the split has recordings that
            the run was trained on, without being asked for.
    """
    section, notes = follow(section, of_run, forecaster.task, given)
    data, name = assembly.build_data(section), str(section.get("dataset") or section["name"])
    assembly.refuse_missing_folder(data, given)
    check_fits(forecaster, data, name)
    known, asked = _of_training(run, of_run), split is not None
    split = split or _usual_split(run, section)
    if split == ALL:
        if not isinstance(data, RecordedData):
            raise ConfigError(f"split=all needs recordings, and data={name} has none: choose split=test, val or train")
        data.whole = True
    if isinstance(data, RecordedData):
        if not data.folder_of_recordings.exists():
            notes += (f"no folder {data.folder_of_recordings}: the extracted data set {data.folder} is used",)
        notes += _seen(data, split, known, asked)
        data.generate(workers)
        if skipped := data.report().get("skipped"):
            notes += (f"{len(skipped)} recordings cannot be read and are left out: {', '.join(skipped)}",)
    scenes = _opened(data, split)
    if forecaster.task.map and not data.task.map:
        scenes = OpenSpace(scenes)
        notes += ("no map: lanes are absent, and goals are chosen among points ahead (docs/transfer.md)",)
    return OtherData(name, split, data, scenes, section, notes)


def follow(
    section: Mapping[str, Any], of_run: Settings, task: Task, given: Collection[str] = ()
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Settings of other data with the windows of a run, or RPI's recipe, and statements about what was changed.

    The time between two windows stays that of the data, and so the moments of its windows lie on its own clock where the
    run's time step divides it.

    Raises:
        ConfigError: a key that the user has set contradicts the run.
    """
    section = {**section}
    if section["name"] == of_run.data["name"] == "rpi" and "data.recipe" not in given:
        return _with_recipe(section, data_recipe(of_run.data))
    if "windows" not in section:
        return section, ()
    own = assembly.build_data(of_run.data)
    theirs = {**dataclasses.asdict(WindowConfig()), **section["windows"]}
    wanted = {
        "dt": task.dt,
        "history": getattr(own, "history", None),
        "horizon": task.horizon,
        "agents": getattr(own, "num_agents", None),
    }
    windows, notes = dict(section["windows"]), []
    for key, value in wanted.items():
        if value is None or theirs[key] == value:
            continue
        name = f"data.windows.{key}"
        if name not in given:
            windows[key] = value
            notes.append(f"{name}={value:g} instead of {theirs[key]:g}, as the run")
        elif key in FIXED:
            raise ConfigError(
                f"{name}={theirs[key]:g} does not fit the run, whose forecaster has {key} {value:g}: leave it out, and the "
                "recordings are read with the run's"
            )
        else:
            notes.append(f"{name}={theirs[key]:g}, unlike the run's {value:g}")
    if task.dt != theirs["dt"] and "data.windows.every" not in given:
        windows["every"] = max(1, round(theirs["every"] * theirs["dt"] / task.dt))
    if task.dt < theirs["dt"] and "data.windows.interpolate" not in given:
        windows["interpolate"] = True
    most = windows.get("agents", theirs["agents"])
    if theirs["least_agents"] > most:
        if "data.windows.least_agents" in given:
            raise ConfigError(
                f"data.windows.least_agents={theirs['least_agents']} is above the {most} agents of the run's scenes: give "
                f"{most} or less, or data.windows.agents as well"
            )
        windows["least_agents"] = most
    section["windows"] = windows
    if "frame" in section and "frame" in of_run.data and "data.frame" not in given:
        section["frame"] = of_run.data["frame"]
    return section, tuple(notes)


def _with_recipe(section: Mapping[str, Any], recipe: int) -> tuple[dict[str, Any], tuple[str, ...]]:
    """RPI's data by the recipe of a run, and a statement if that of the section is another one."""
    theirs = data_recipe(section)
    notes = (f"data.recipe={recipe} instead of {theirs}, as the run",) if recipe != theirs else ()
    return {**section, "recipe": recipe}, notes


def check_fits(forecaster: Forecaster, data: Any, name: str) -> None:
    """Refuse data that a forecaster cannot read.

    Raises:
        ConfigError: another time step or horizon, goals that are not given or not candidates, or no sizes.
    """
    task, other = forecaster.task, data.task
    for key, what, unit in (("dt", "time step", " s"), ("horizon", "horizon", " steps")):
        mine, theirs = getattr(task, key), getattr(other, key)
        if abs(mine - theirs) > 1e-9:
            raise ConfigError(
                f"the run forecasts with {key} {mine:g}{unit}, and data={name} has {theirs:g}{unit}, and cannot be read "
                f"with another {what}: choose data of recordings, such as data=ucy or data=us101"
            )
    model = forecaster.configuration
    reads_goals = bool(model.get("goal") == "all" or _uses_goals(forecaster))
    if not reads_goals or task.candidates == other.candidates:
        return
    if task.candidates == 1:
        raise ConfigError(
            f"the run reads each agent's given goal, which data={name} does not have: train a row without goals, such as "
            "experiment=rpi/v_lstm or rpi/v_lstm_sc, or one that chooses goals, such as experiment=us101/v_lstm_epo"
        )
    if other.candidates == 1 or (other.candidates == 0 and not task.map):
        raise ConfigError(
            f"the run chooses each agent's goal among candidates, and data={name} has "
            f"{other.candidates or 'no'} goal: choose recordings with a map"
        )


def _uses_goals(forecaster: Forecaster) -> bool:
    """Whether the forecaster's energy has terms for goals."""
    needs = getattr(getattr(forecaster, "energy", None), "needs", ())
    return bool({*needs} & {"goals", "goal_headings", "reference"})


def _usual_split(run: RunFolder, section: Mapping[str, Any]) -> str:
    """The test split for the run's own data, and for data that is not of recordings; all recordings for other data."""
    data = assembly.build_data(section)
    if not isinstance(data, RecordedData):
        return "test"
    try:
        return "test" if _is_own(data, run) else ALL
    except ConfigError:  # too few recordings for three splits, or none: this is said when they are read
        return ALL


def _is_own(data: RecordedData, run: RunFolder) -> bool:
    """Whether these are the recordings and splits of the run, extracted by this or an older version."""
    digest = str(run.record.get("data_digest"))
    return data.digest == digest or data.is_older(digest)


def _opened(data: Any, split: str) -> SceneDataset:
    if not isinstance(data, SceneDataModule):
        raise ConfigError(
            f"data {type(data).__name__} is no SceneDataModule, which other runs could read: score it in the run's own way"
        )
    whole = data.open(split)
    return whole if data.share == 1 else Share(whole, data.share)


def _of_training(run: RunFolder, of_run: Settings) -> set[str] | None:
    """Files of the recordings of a run's training and validation splits; None if they are unknown on this machine."""
    data = assembly.build_data(of_run.data)
    if not isinstance(data, RecordedData):
        return set()
    try:
        if not _is_own(data, run):
            return None
        splits = data.config["splits"]
        files = _files(data)
    except ConfigError:
        return None
    return {files[name] for split in ("train", "val") for name in splits.get(split, ()) if name in files}


def _files(data: RecordedData) -> dict[str, str]:
    """The files of every recording by its name, as text that is equal for files with equal content, whatever their names."""
    recordings = data.config["recordings"]
    if isinstance(recordings, Mapping):  # a simulation: its settings and the recording's name identify the files
        names = [name for held in data.config["splits"].values() for name in held]
        return {name: json.dumps([recordings, name], sort_keys=True) for name in names}
    return {name: json.dumps([[size, checksum] for _, size, checksum in files]) for name, _, files in recordings}


def _seen(data: RecordedData, split: str, known: set[str] | None, asked: bool) -> tuple[str, ...]:
    """Statement about the scored recordings that the run was trained on; none if there are none.

    Raises:
        ConfigError: there are some, and the split was not asked for.
    """
    if known is None:
        return ("whether the run was trained on some of these recordings is unknown: its own data is not here",)
    files, names = _files(data), data.config["splits"].get(split, ())
    seen = [name for name in names if files.get(name) in known]
    if not seen:
        return ()
    if not asked:
        raise ConfigError(
            f"the run was trained, or its checkpoint chosen, on {len(seen)} of these {len(names)} recordings ({seen[0]}, "
            "..): choose split=test, or split=all to score them nevertheless"
        )
    return (f"trained or validated on {len(seen)} of these {len(names)} recordings",)
