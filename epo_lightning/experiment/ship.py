"""Packing of a finished run for shipping: ``python -m epo_lightning.experiment.ship <run folder> <name>``."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
import sys
from pathlib import Path

import torch
from safetensors.torch import save

from epo_lightning import pretrained
from epo_lightning.experiment.checkpoints import WholeCheckpoints
from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_data
from epo_lightning.experiment.pictures import choose
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, write_file, write_json
from epo_lightning.schema import read

SCENES = 16
"""Example scenes that ship with a run."""
PLACES = {"runs": "runs", "run_dir": None, "sweep": None, "resume": None}
"""Entries of a configuration that name folders of the machine on which the run was made."""


def ship(run: RunFolder, folder: Path) -> Path:
    """Pack a run for shipping into ``folder``: its weights without the optimizer's state, its scores, and example scenes.

    Raises:
        ConfigError: the run is not finished or not scored on the test split, or its data is missing or has changed.
    """
    if not run.finished or not run.metrics_file().is_file():
        raise ConfigError(f"{run.path} is not finished and scored: train it with score=test")
    content = torch.load(run.checkpoint("best"), map_location="cpu", weights_only=True)
    scenes, _ = choose(open_data(run, read(Settings, run.config())), "test", SCENES)
    fields = {field.name: getattr(scenes, field.name) for field in dataclasses.fields(scenes)}
    tensors = {name: value.contiguous() for name, value in fields.items() if isinstance(value, torch.Tensor)}

    packed = RunFolder(folder)
    packed.begin({**run.config(), **PLACES}, run.record)
    weights = {key: content[key] for key in ("configuration", "state_dict")}
    packed.checkpoints.mkdir(exist_ok=True)
    WholeCheckpoints().save_checkpoint(weights, packed.checkpoint("best"))
    write_file(folder / "scenes.safetensors", save(tensors, {"dt": str(scenes.dt)}))
    shutil.copyfile(run.metrics_file(), packed.metrics_file())
    digest = hashlib.sha256(packed.checkpoint("best").read_bytes()).hexdigest()
    write_json(packed.record_file, {**run.record, "sha256": digest})
    return folder


if __name__ == "__main__":
    print(f"wrote {ship(RunFolder.open(sys.argv[1]), pretrained.HOME / sys.argv[2])}")
