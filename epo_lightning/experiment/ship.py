"""Making of the forecasters that ship with the package: ``python -m epo_lightning.experiment.ship [<name>]``."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from safetensors.torch import save
from torch import Tensor

from epo_lightning import pretrained
from epo_lightning.data.cache import file_digest
from epo_lightning.experiment import assembly
from epo_lightning.experiment.card import SCORES, Recipe, card, recipe_of, recipes
from epo_lightning.experiment.checkpoints import WholeCheckpoints
from epo_lightning.experiment.config import compose
from epo_lightning.experiment.config.settings import EvaluateSettings
from epo_lightning.experiment.evaluate import score
from epo_lightning.experiment.opening import open_data, refuse_unfinished, settings_of, split_of
from epo_lightning.experiment.pictures import choose
from epo_lightning.experiment.train import train
from epo_lightning.experiment.verbs import generate_and_print
from epo_lightning.files import read_json, write_file, write_json
from epo_lightning.forecasters import load
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.run_folder import RunFolder

SCENES = 16
"""Example scenes that ship with a run."""
LARGEST = 900_000
"""Bytes of weights above which they are stored in half precision, so that every file is smaller than 1 MB."""
PLACES = {"runs": "runs", "run_dir": None, "sweep": None, "resume": None}
"""Entries of a configuration that name folders of the machine on which the run was made."""


def make(names: Sequence[str]) -> list[Path]:
    """Train shipped forecasters as their recipes say, and replace them in the package.

    All are trained before the first one is replaced: a run records whether the working tree has changed since the commit.

    Returns:
        the folders that were written.
    """
    runs = [train_by(recipe_of(name), Path("runs/pretrained") / name) for name in names]
    return [ship(run, name, recipe_of(name), pretrained.HOME / name) for run, name in zip(runs, names, strict=True)]


def train_by(recipe: Recipe, folder: Path) -> RunFolder:
    """Generate the data of a recipe and train its run; an interrupted run is continued, and a finished one kept."""
    generate_and_print(compose.compose("generate", recipe.data_words), recipe.data_words)
    words = [*recipe.words, f"run_dir={folder}", "existing=continue"]
    return train(compose.compose("train", words), words)


def ship(run: RunFolder, name: str, recipe: Recipe, folder: Path) -> Path:
    """Pack a run for shipping: weights without the optimizer's state, scores, example scenes and a card.

    The scores are those of the packed weights, which may have a lower precision than the run's.

    Args:
        run: a finished run.
        name: name of the forecaster.
        recipe: how the run was made, and what its card says in words.
        folder: the packed run; it is replaced if it exists.

    Raises:
        ConfigError: the run is not finished, or its data is missing or has changed.
    """
    assembly.quiet()
    refuse_unfinished(run)
    with TemporaryDirectory() as place:
        packed = _pack(run, RunFolder(Path(place) / "packed"))
        write_file(packed.path / "card.md", card(name, recipe, packed))
        new, old = (folder.with_name(f".{folder.name}-{which}") for which in ("new", "old"))
        for aside in (new, old):
            shutil.rmtree(aside, ignore_errors=True)
        shutil.copytree(packed.path, new, ignore=shutil.ignore_patterns(".*"))
        if folder.exists():
            folder.rename(old)
        new.rename(folder)  # a kill before this leaves a whole folder beside it
        shutil.rmtree(old, ignore_errors=True)
    return folder


def _pack(run: RunFolder, packed: RunFolder) -> RunFolder:
    """Write everything but the card of a packed run."""
    content = torch.load(run.checkpoint("best"), map_location="cpu", weights_only=True)
    data = open_data(run, settings_of(run))
    scenes, _ = choose(data, "test", SCENES)
    fields = {field.name: getattr(scenes, field.name) for field in dataclasses.fields(scenes)}
    tensors = {name: value.contiguous() for name, value in fields.items() if isinstance(value, Tensor)}

    packed.begin({**run.config(), **PLACES}, run.record)
    packed.checkpoints.mkdir(exist_ok=True)
    weights = {"configuration": content["configuration"], "state_dict": shrunk(content["state_dict"])}
    WholeCheckpoints().save_checkpoint(weights, packed.checkpoint("best"))
    write_json(packed.record_file, {**run.record, "sha256": file_digest(packed.checkpoint("best"))})
    write_file(packed.path / "scenes.safetensors", save(tensors, {"dt": str(scenes.dt)}))

    file, _ = score(packed, EvaluateSettings(run=str(packed.path)))
    total = sum(len(batch.history) for batch in split_of(data, "test"))
    about = {"scenes": total, "examples": score_examples(packed.path)}
    write_json(file, {**read_json(file), **about})
    return packed


def shrunk(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights in half precision if they have more than :data:`LARGEST` bytes; loading makes them single precision again."""
    size = sum(value.numel() * value.element_size() for value in weights.values())
    half = size > LARGEST
    return {name: value.half() if half and value.is_floating_point() else value for name, value in weights.items()}


def score_examples(run: str | Path) -> dict[str, float]:
    """Number of the scenes that ship with a run, given by name or folder, and the scores of its forecasts of them."""
    scenes = pretrained.examples(run)
    forecaster = load(pretrained.checkpoint_of(run) or RunFolder(Path(run)).checkpoint("best"))
    metrics = ForecastMetrics(forecaster.task.subsets, forecaster.task.shape)
    metrics.update(forecaster.predict(scenes), scenes)
    scores = metrics.compute()
    return {"scenes": len(scenes.history), **{name: float(scores[name]) for name in SCORES}}


if __name__ == "__main__":
    for written in make(sys.argv[1:] or list(recipes())):
        print(f"wrote {written}")
