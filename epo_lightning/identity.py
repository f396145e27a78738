"""What makes two runs the same run: their resolved configuration, as far as it decides on the result, and their data.

Names, places and machines are left out: how a row is called, where its files lie, what logs it, how many threads, devices or
processes compute it. The data's digest takes the place of paths to it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

SECTIONS = (
    *("data", "backbone", "forecaster", "dynamics", "energy", "solver", "optimizer"),
    *("trainer", "callbacks", "goal", "seed"),
)
"""Everything else in a configuration says what a run is called, where it is written, or who watches it."""
ELSEWHERE = (
    *("data.root", "data.folder"),
    *(
        "trainer.accelerator",
        "trainer.devices",
        "trainer.share",
        "trainer.threads",
        "trainer.log_every",
        "trainer.profiler",
    ),
    *("callbacks.progress", "callbacks.refresh"),
)
"""Keys of those sections that say where the data lies, or on what and how visibly it is computed."""


def essence(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides on the result, as plain JSON values."""
    kept: dict[str, Any] = {}
    for section in SECTIONS:
        value = config.get(section)
        if isinstance(value, Mapping):
            value = {key: entry for key, entry in value.items() if f"{section}.{key}" not in ELSEWHERE}
        kept[section] = value
    return json.loads(json.dumps(kept, sort_keys=True))


def identity(config: Mapping[str, Any], data_digest: str) -> str:
    """The run's identity: sixteen hexadecimal digits of the hash of its essence and its data."""
    return _hash({**essence(config), "data_digest": data_digest})


def row_identity(config: Mapping[str, Any], data_digest: str) -> str:
    """The identity of a table's row: that of its runs without their seed."""
    return _hash({**essence(config), "seed": None, "data_digest": data_digest})


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Key, value and other value of everything in which the essences of two configurations differ."""
    left, right = dict(_leaves(essence(one))), dict(_leaves(essence(other)))
    return [(key, left.get(key), right.get(key)) for key in sorted({*left, *right}) if left.get(key) != right.get(key)]


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _hash(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
