"""A run opened again: its forecaster and its data."""

from __future__ import annotations

import contextlib
import shlex
from pathlib import Path
from typing import Any

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.identity import check_unchanged
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import read

ARCHITECTURE = ("forecaster", "backbone", "energy", "dynamics", "solver", "backward")
"""Sections that a checkpoint has to share with its run."""


def open_checkpoint(settings: Settings, path: Path) -> Any:
    """The forecaster in a checkpoint, which must be of the architecture that ``settings`` describe.

    Raises:
        ConfigError: the file is missing, no checkpoint, or of another architecture; the message names the difference.
    """
    forecaster = epo_lightning.load(path)
    expected = assembly.describe_model(settings, assembly.build_data(settings.data))
    found = forecaster.configuration
    for section in (*ARCHITECTURE, "goal", "horizon", "dt"):
        if found.get(section) != expected[section]:
            raise ConfigError(
                f"{path} holds another architecture than this run: {section} is {found.get(section)} in the checkpoint "
                f"and {expected[section]} in the run's config.yaml"
            )
    return forecaster


def refuse_unfinished(run: RunFolder) -> None:
    """Refuse to score or ship a run whose training has not ended.

    Raises:
        ConfigError: the run is not finished; the message says how to continue it.
    """
    if not run.finished:
        raise ConfigError(f"{run.path} is not finished: continue it with `epo train resume={run.path}`")


def open_data(run: RunFolder, settings: Settings, batch_size: int | None = None, share: float | None = None) -> Any:
    """The run's data, which must be what it was trained on.

    Args:
        run: the run.
        settings: the run's settings.
        batch_size: scenes per batch, instead of the run's number.
        share: share of the scenes of every split, instead of the run's share.

    Raises:
        ConfigError: the data is missing or has changed.
    """
    section = dict(settings.data)
    if batch_size is not None and "batch_size" in section:
        section["batch_size"] = batch_size
    if share is not None:
        section["share"] = share
    data = assembly.build_data(section)
    with contextlib.suppress(ValueError):  # a command with a quotation mark too few, edited by hand
        data.words = shlex.split(str(run.record.get("command", "")))
    try:
        data.setup("test")
    except ConfigError as error:
        elsewhere = not run.path.resolve().is_relative_to(Path.cwd()) and not pretrained.ships(run.path)
        if not elsewhere:
            raise
        raise ConfigError(
            f"{error}. The run is in another folder, {run.path}, and its data are searched from this one: give the command "
            "in the folder in which the run was trained, or set $EPO_CACHE to its folder of data sets"
        ) from error
    refuse_changed(run, data)
    return data


def settings_of(run: RunFolder) -> Settings:
    """The settings that a run began with.

    Raises:
        ConfigError: config.yaml is missing or damaged, or describes another run than run.json.
    """
    config = run.config()
    check_unchanged(config, run.record, run.config_file)
    return read(Settings, config)


def refuse_changed(run: RunFolder, data: Any) -> None:
    """Refuse to continue or score a run with other data than it began with.

    Raises:
        ConfigError: the data has another digest now.
    """
    began_with = run.record.get("data_digest")
    if began_with == data.digest:
        return
    if isinstance(data, RecordedData) and data.is_older(str(began_with)):
        raise ConfigError(
            f"the scenes of {run.path} were extracted from the same recordings by an older version of epo_lightning (digest "
            f"{began_with}, now {data.digest}): train the run again, or use the version of its commit, "
            f"{run.record.get('git_commit', 'unknown')}; `epo evaluate run={run.path} data={data.dataset_name} "
            f"data.folder={data.folder_of_recordings} split=test` scores it on the scenes of this version"
        )
    raise ConfigError(
        f"the data of {run.path} has changed since the run began (digest {began_with}, now {data.digest}): "
        f"{_restore(data)}, or train a new run"
    )


def _restore(data: Any) -> str:
    """Advice on what to restore, so that the data is again that of a run."""
    if isinstance(data, RecordedData) and data.reader:
        return f"restore the recordings, or the file in which format {data.format!r} is registered"
    return "restore the data of that digest"


def split_of(data: Any, split: str) -> Any:
    """The loader of the split ``test`` or ``val``, in a fixed order."""
    if split == "test":
        return data.test_dataloader()
    data.setup("validate")
    return data.val_dataloader()
