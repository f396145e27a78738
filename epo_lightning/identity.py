"""Identity of a run: a hash of the settings that decide on its result, and of its data.

Settings that only say how a run is named, where its files lie, where it is logged and on what it is computed (threads,
devices, processes) are left out. The digest of the data replaces its path.

Four hashes are recorded with a run:

- ``data_digest``: hash of the settings of the data set and, for recordings, of their files (``data.digest``).
- ``identity``: the settings that decide on its result, and ``data_digest``.
- ``row``: the same without the seed, and without the path ``forecaster.frozen``; runs of one row of a table share it.
- ``variant``: these settings without the data; empty if nothing differs from the files of experiment and budget. It ends the
  name of the run folder (:mod:`.experiment.config.compose`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from epo_lightning.registry import ConfigError

SECTIONS = (
    *("data", "backbone", "forecaster", "dynamics", "energy", "solver", "backward", "objective", "optimizer"),
    *("trainer", "callbacks", "goal", "seed"),
)
"""Sections of a configuration that decide on the result. The others only name, place or log a run."""
ELSEWHERE = (
    *("data.root", "data.folder"),
    *(
        "trainer.accelerator",
        "trainer.devices",
        "trainer.share",
        "trainer.threads",
        "trainer.profiler",
        "trainer.graph",
    ),
    *("callbacks.progress", "callbacks.refresh"),
)
"""Keys of those sections that do not decide on the result: folders of data, the machine, logging and progress."""

LATER = {
    "data.recipe": 1,
    "optimizer.shared_factor": 1,
    "forecaster.calibration.starts": [0.0],
    "forecaster.calibration.training": False,
}
"""Settings that some recorded runs do not have, with the value that means the same as their absence.

The last one no longer exists.
"""
SHARES = ("trainer.limit_train_batches", "trainer.limit_val_batches")
"""Keys for which 1 and 1.0 differ: 1 is a number of batches, and 1.0 is a share of all batches."""


def data_recipe(section: Mapping[str, Any]) -> int:
    """Version of the method that made data of RPI; the first one where the ``data`` section is older than the setting."""
    return section.get("recipe", LATER["data.recipe"])


def essence(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides on the result, as plain JSON values; 2.0 and 2 are the same."""
    return {section: _plain(config.get(section), section) for section in SECTIONS}


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, Mapping):
        entries = {str(key): (f"{where}.{key}", entry) for key, entry in value.items()}
        return {key: _plain(entry, place) for key, (place, entry) in entries.items() if _decides(place, entry)}
    if isinstance(value, list | tuple):
        return [_plain(entry, where) for entry in value]
    if isinstance(value, float) and where in SHARES:
        return f"{value!r} of all"
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _decides(place: str, entry: Any) -> bool:
    return place not in ELSEWHERE and (place not in LATER or entry != LATER[place])


def identity(config: Mapping[str, Any], data_digest: str) -> str:
    """The run's identity: sixteen hexadecimal digits of the hash of its essence and its data."""
    content = canonical({**essence(config), "data_digest": data_digest})
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def check_unchanged(config: Mapping[str, Any], record: Mapping[str, Any], config_file: Path) -> None:
    """Refuse a config.yaml that describes another run than run.json; records without an identity are not checked.

    Raises:
        ConfigError: the settings or the names of the run were changed since it began, or run.json is damaged.
    """
    if "identity" not in record:
        return
    for key in ("identity", "data_digest"):
        if not isinstance(record.get(key), str):
            raise ConfigError(
                f"{config_file.with_name('run.json')}: {key} is {record.get(key)!r}, expected text of hexadecimal digits; "
                "was the file edited? Restore it, or train the run again in another folder"
            )
    described = {"identity": identity(config, record["data_digest"]), **_names(config)}
    for key, found in described.items():
        if key in record and found != record[key]:
            raise ConfigError(
                f"{config_file} or run.json beside it was changed since the run began: {key} is {found!r} by config.yaml "
                f"and {record[key]!r} by run.json. Restore the edited file, or train a new run with the changed settings"
            )


def _names(config: Mapping[str, Any]) -> dict[str, Any]:
    """Names of a run's row, which are no part of its identity, by their keys in run.json."""
    budget = config.get("budget")
    names = {"title": config.get("title"), "experiment": config.get("experiment")}
    return {**names, "budget": budget.get("name") if isinstance(budget, Mapping) else budget}


def row_identity(config: Mapping[str, Any], data_digest: str) -> str:
    """Identity of a row of a table: that of its runs, but only of :func:`of_row`, and therefore the same for all of them."""
    return identity(of_row(config), data_digest)


def of_row(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration without what differs between runs of a row: the seed, and the run that a refinement refines."""
    forecaster = config.get("forecaster")
    if isinstance(forecaster, Mapping):
        forecaster = {key: value for key, value in forecaster.items() if key != "frozen"}
    return {**config, "seed": None, "forecaster": forecaster}


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Key, value and other value of everything in which the essences of two configurations differ."""
    left, right = dict(leaves(essence(one))), dict(leaves(essence(other)))
    pairs = [(key, left.get(key), right.get(key)) for key in sorted({*left, *right})]
    return [(key, a, b) for key, a, b in pairs if canonical(a) != canonical(b)]


def canonical(content: Any) -> str:
    """JSON text that is the same for equal values of equal types. (Python's ``==`` takes 1 and True for equal.)

    Values that JSON does not have, such as a date in an edited file, are text.
    """
    return json.dumps(content, sort_keys=True, default=str)


DIGEST = "digest"
"""Key of a file's content with the digest of everything else."""


def digest_of(content: Mapping[str, Any]) -> str:
    """Hash of a file's content without its :data:`DIGEST`."""
    rest = {key: value for key, value in content.items() if key != DIGEST}
    return hashlib.sha256(canonical(rest).encode()).hexdigest()[:16]


def leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys of nested sections, with their values; an empty section is a value."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
