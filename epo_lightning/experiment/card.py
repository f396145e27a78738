"""Model cards of the forecasters that ship with the package, and the recipes that these are made by."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from epo_lightning import pretrained
from epo_lightning.files import read_json
from epo_lightning.registry import ConfigError, nearest
from epo_lightning.run_folder import RunFolder
from epo_lightning.schema import read

SCORES = {
    "minSADE": "SADE [m]",
    "minSFDE": "SFDE [m]",
    "minADE": "ADE [m]",
    "minFDE": "FDE [m]",
    "overlap_jfp": "overlap rate",
}
"""Scores of a card: name of the metric, title of the column."""


@dataclass(frozen=True)
class Recipe:
    """How a shipped forecaster is made, and what its card says in words.

    Attributes:
        train: words of ``epo train``; those that begin with ``data`` are the words of ``epo generate`` as well.
        about: the method.
        data: the data.
        limits: what the forecaster is not fit for.
    """

    train: str
    about: str
    data: str
    limits: Sequence[str]

    @property
    def words(self) -> list[str]:
        """The words of ``epo train``."""
        return shlex.split(self.train)

    @property
    def data_words(self) -> list[str]:
        """The words of ``epo generate``."""
        return [word for word in self.words if word.startswith("data")]


def recipes() -> dict[str, Recipe]:
    """The recipes in ``pretrained/recipes.yaml`` by name."""
    import yaml

    content = yaml.safe_load((pretrained.HOME / "recipes.yaml").read_text(encoding="utf-8"))
    return {name: read(Recipe, values, name) for name, values in content.items()}


def recipe_of(name: str) -> Recipe:
    """The recipe of a shipped forecaster.

    Raises:
        ConfigError: there is none of that name; the message lists all.
    """
    known = recipes()
    if name not in known:
        raise ConfigError(f"no recipe {name!r} in pretrained/recipes.yaml: {nearest(name, known)}")
    return known[name]


def card(name: str, recipe: Recipe, run: RunFolder) -> str:
    """The card of a packed run as Markdown: method, how it was made, scores, limits, use."""
    record, config, scored = run.record, run.config(), read_json(run.metrics_file())
    content = torch.load(run.checkpoint("best"), map_location="cpu", weights_only=True)
    dtypes = {str(value.dtype) for value in content["state_dict"].values() if value.is_floating_point()}
    stored = ", ".join(sorted(dtypes)).replace("torch.", "")
    versions = ", ".join(f"{package} {version}" for package, version in record["versions"].items() if version)
    data, examples = config["data"], scored["examples"]
    budget = (
        f"{record['budget']}: {record['steps']} steps of {data['batch_size']} scenes, {record['epochs']} epochs, "
        f"learning rate {config['optimizer']['lr']:g}; {record['seconds'] / 60:.0f} minutes, "
        f"threads: {config['trainer']['threads']}"
    )
    facts = {
        "data": f"`epo generate {shlex.join(recipe.data_words)}`, digest {record['data_digest']}",
        "budget": budget,
        "command": f"`{record['command']}`",
        "commit": record["git_commit"],
        "seed": record["seed"],
        "versions": versions,
        "weights": f"{record['parameters']} parameters, stored as {stored}, SHA-256 {record['sha256'][:16]}",
    }
    return "\n".join(
        [
            f"# {name}",
            "",
            recipe.about,
            "",
            f"Data: {recipe.data}",
            "",
            *_table(("made with", ""), facts.items()),
            "",
            "## Scores",
            "",
            *_table(
                ("scenes", *SCORES.values()),
                (
                    (f"test split, {scored['scenes']} scenes", *_scores(scored["metrics"])),
                    (f"the {examples['scenes']} test scenes that ship with it", *_scores(examples)),
                ),
            ),
            "",
            "## Limits",
            "",
            *(f"- {limit}" for limit in recipe.limits),
            "",
            "## Use",
            "",
            "```python",
            f'forecaster = epo_lightning.load("{name}")',
            f'forecast = forecaster.predict(pretrained.examples("{name}"))',
            "```",
            "",
        ]
    )


def _scores(metrics: Mapping[str, float]) -> list[str]:
    return [f"{metrics[name]:.4f}" for name in SCORES]


def _table(titles: Sequence[str], rows: Any) -> list[str]:
    lines = [titles, [":--"] * len(titles), *rows]
    return ["| " + " | ".join(str(entry) for entry in line) + " |" for line in lines]
