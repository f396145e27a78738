"""Choices files: the best setting of every experiment of a search, for ``epo sweep <name> choices=<file>``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from epo_lightning.registry import ConfigError, one_line
from epo_lightning.report.selection import SEARCHED, BestSetting

HEADER = """\
# The best settings of a search, chosen on the validation split, with the scores of all runs that were compared. Written by
#   {command}
# A sweep that trains its rows with them:  epo sweep <name> choices=<this file>
"""
OVERRIDE = re.compile(rf"\+{{0,2}}(goal|{'|'.join(SEARCHED)}|[a-z_]+(\.\w+)+)=.+", re.DOTALL)
"""An override of one setting, or an option of a part that is searched: ``optimizer.lr=0.0005``, ``backbone=vibes``."""


@dataclass(frozen=True)
class Choices:
    """A choices file.

    Attributes:
        file: path of the file, as given.
        content: its contents.
        overrides: the chosen overrides, by experiment.
    """

    file: str
    content: dict[str, Any]
    overrides: dict[str, tuple[str, ...]]


def choices_to_yaml(best: Sequence[BestSetting], command: str) -> str:
    """Text of a choices file; empty without an experiment that has one best setting.

    An experiment that was searched several times, on several data sets or under several titles, is left out.
    """
    counts = Counter(entry.experiment for entry in best)
    content = {
        entry.experiment: {
            "overrides": list(entry.overrides),
            "metric": entry.metric,
            "split": "val",
            "data": entry.row.runs[0].data,
            "data_digest": entry.row.data_digest,
            "budget": entry.row.budget,
            "runs": [str(run.path) for run in entry.row.runs],
            "compared": {str(run.path): run.metrics[entry.metric] for row in entry.compared for run in row.runs},
        }
        for entry in best
        if entry.experiment and counts[entry.experiment] == 1
    }
    return HEADER.format(command=command) + yaml.safe_dump(content, sort_keys=False, width=120) if content else ""


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, which refuses a key that stands twice in a mapping instead of taking its last value."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        counts = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for key, count in counts.items():
            if count > 1:
                raise _TwiceError(key)
        return super().construct_mapping(node, deep)


class _TwiceError(Exception):
    """A key that stands twice in a mapping."""


def read_choices(file: str) -> Choices:
    """The choices in a file.

    Raises:
        ConfigError: the file cannot be read, an entry is not an experiment with its overrides, or an experiment, or a key of
            its overrides, stands in the file twice.
    """
    what = "experiment names with their overrides, as `epo report <search>` writes it"
    try:
        content = yaml.load(Path(file).expanduser().read_text(encoding="utf-8"), _Loader)  # a SafeLoader
    except OSError as error:
        raise ConfigError(f"cannot read choices={file}: {error.strerror}; it must be a file of {what}") from error
    except _TwiceError as twice:
        raise ConfigError(
            f"choices={file} has the entry {twice} twice, and only one of them can count: leave one of them out"
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"choices={file} is not YAML ({one_line(error)}); it must have {what}") from error
    if not isinstance(content, dict) or not content:
        raise ConfigError(f"choices={file} has no choices: it must have {what}")
    found = {}
    for experiment, entry in content.items():
        words = entry.get("overrides") if isinstance(entry, dict) else None
        if not isinstance(words, list) or not words:
            raise ConfigError(f"choices={file}: {experiment} has no list `overrides`; it must have {what}")
        values: dict[str, str] = {}
        for word in words:
            if not isinstance(word, str) or not OVERRIDE.fullmatch(word):
                raise ConfigError(
                    f"choices={file}: {experiment} has the override {word!r}, expected a setting of a section, such as "
                    "optimizer.lr=0.0005"
                )
            key = word.partition("=")[0].lstrip("+")
            if key in values:
                raise ConfigError(
                    f"choices={file}: {experiment} sets {key} twice, by {values[key]} and by {word}: leave one of them out"
                )
            values[key] = word
        found[str(experiment)] = tuple(words)
    return Choices(file, content, found)
