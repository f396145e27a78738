"""Finished runs, opened again to be measured."""

from __future__ import annotations

from typing import NamedTuple

from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_checkpoint, refuse_unfinished, settings_of
from epo_lightning.forecasters import Forecaster
from epo_lightning.report.runs import data_name
from epo_lightning.run_folder import RunFolder


class Opened(NamedTuple):
    """A finished run with its settings and its best forecaster, which is in evaluation mode."""

    run: RunFolder
    settings: Settings
    forecaster: Forecaster


def opened(folder: str) -> Opened:
    """The finished run in a folder, or the run of that name that ships with the package.

    Raises:
        ConfigError: no finished run, or its checkpoint is missing or of another architecture.
    """
    run = RunFolder.open(folder)
    refuse_unfinished(run)
    settings = settings_of(run)
    return Opened(run, settings, open_checkpoint(settings, run.checkpoint("best")))


def name_of(settings: Settings, split: str) -> str:
    """Title and seed of a run, and the groups of its test split, or its data set if they were drawn."""
    groups = ", ".join(map(str, settings.data.get("test") or ()))
    return f"{settings.title}, seed {settings.seed}, {split} of {groups or data_name(settings.data)}"
