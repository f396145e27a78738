"""Identity of a run: its resolved configuration, as far as it decides on the result, and its data.

Names, places and machines are left out: how a row is called, where its files lie, what logs it, how many threads, devices or
processes compute it. The data's digest takes the place of paths to it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

SECTIONS = (
    *("data", "backbone", "forecaster", "dynamics", "energy", "solver", "backward", "objective", "optimizer"),
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


SHARES = ("trainer.limit_train_batches", "trainer.limit_val_batches")
"""Keys of which a whole number says something else than the same number with a point: one batch, or all of them."""


def essence(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a resolved configuration that decides on the result, as plain JSON values, each number in one way."""
    return {section: _plain(config.get(section), section) for section in SECTIONS}


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, Mapping):
        entries = {str(key): (f"{where}.{key}", entry) for key, entry in value.items()}
        return {key: _plain(entry, place) for key, (place, entry) in entries.items() if place not in ELSEWHERE}
    if isinstance(value, list | tuple):
        return [_plain(entry, where) for entry in value]
    if isinstance(value, float) and where in SHARES:
        return f"{value!r} of all"
    return int(value) if isinstance(value, float) and value.is_integer() else value


def identity(config: Mapping[str, Any], data_digest: str) -> str:
    """The run's identity: sixteen hexadecimal digits of the hash of its essence and its data."""
    return _hash({**essence(config), "data_digest": data_digest})


def row_identity(config: Mapping[str, Any], data_digest: str) -> str:
    """The identity of a table's row: that of its runs without their seed."""
    return _hash({**essence(config), "seed": None, "data_digest": data_digest})


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Key, value and other value of everything in which the essences of two configurations differ."""
    left, right = dict(_leaves(essence(one))), dict(_leaves(essence(other)))
    pairs = [(key, left.get(key), right.get(key)) for key in sorted({*left, *right})]
    return [(key, a, b) for key, a, b in pairs if canonical(a) != canonical(b)]


def canonical(content: Any) -> str:
    """Equal for equal values of equal types; Python takes 1 and true for the same."""
    return json.dumps(content, sort_keys=True)


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _hash(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(canonical(content).encode()).hexdigest()[:16]
