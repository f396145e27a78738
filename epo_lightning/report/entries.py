"""Checks of the entries of files that a report reads: an error names the file, the key and what was expected."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from epo_lightning.registry import ConfigError

Check = tuple[str, Callable[[Any], bool]]
"""Words for what an entry has to be, and the test of it."""


def _all(values: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(values, list) and all(map(fits, values))


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _number(value: Any) -> bool:
    return isinstance(value, int | float)


def _object(value: Any) -> bool:
    return isinstance(value, Mapping)


def _finite_number(value: Any) -> bool:
    return _number(value) and not isinstance(value, bool) and math.isfinite(value)


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _part(value: Any) -> bool:
    return _object(value) and _text(value.get("name", ""))


def _or_null(check: Check) -> Check:
    words, fits = check
    return f"{words}, or null", lambda value: value is None or fits(value)


TEXT: Check = "a text", _text
TEXTS: Check = "a list of texts", lambda value: _all(value, _text)
ROWS: Check = "a list of lists of texts", lambda value: _all(value, TEXTS[1])
LOG: Check = (
    "a list of lists of a step and perhaps a score, as texts",
    lambda value: ROWS[1](value) and all(row and row[0].isdecimal() and len(row) < 3 for row in value),
)
PAIRS: Check = "a list of pairs of texts", lambda value: ROWS[1](value) and all(len(row) == 2 for row in value)
OBJECT: Check = "an object", _object
OBJECTS: Check = "a list of objects", lambda value: _all(value, _object)
OBJECTS_BY_NAME: Check = "objects by name", lambda value: _object(value) and all(map(_object, value.values()))
NUMBERS_BY_NAME: Check = "numbers by name", lambda value: _object(value) and all(map(_number, value.values()))

NUMBER: Check = "a finite number", _finite_number
WHOLE: Check = "a whole number", _whole
VERSIONS: Check = (
    "texts by name",
    lambda value: _object(value) and all(entry is None or _text(entry) for entry in value.values()),
)
PART: Check = "an object with a text `name`", _part

_CONFIGURATION: dict[str, Check] = {
    **{
        key: _or_null(PART)
        for key in ("backbone", "dynamics", "energy", "solver", "backward", "objective", "optimizer", "budget")
    },
    **dict.fromkeys(("data", "forecaster"), PART),
    **dict.fromkeys(("trainer", "callbacks"), _or_null(OBJECT)),
    **{"experiment": _or_null(TEXT), "title": TEXT, "goal": TEXT, "seed": WHOLE},
}
"""Entries of a configuration on which reports depend."""
_SETTINGS: dict[str, dict[str, Check]] = {
    **{section: dict.fromkeys(("power", "relaxation", "annealing"), NUMBER) for section in ("forecaster", "objective")},
    "solver": {"steps": _or_null(WHOLE)},
}
"""Entries of sections of a configuration with which reports compute."""
_RECORD: dict[str, Check] = {
    **dict.fromkeys(("command", "data_digest", "identity", "row", "began", "status"), TEXT),
    **{"git_commit": _or_null(TEXT), "versions": _or_null(VERSIONS), "parameters": _or_null(WHOLE)},
    **{"steps": _or_null(WHOLE), "seconds": _or_null(NUMBER)},
}
"""Entries of the record of a run."""


def check_entries(content: Mapping[str, Any], expected: Mapping[str, Check], where: str, remedy: str) -> None:
    """Refuse an object that lacks an entry, or has another kind of value than expected.

    Args:
        content: the object.
        expected: what the value of every key has to be.
        where: the file, and the place in it if it has several such objects.
        remedy: what to do about it.

    Raises:
        ConfigError: the message names the file, the key and what was expected.
    """
    for key, (words, fits) in expected.items():
        if key not in content:
            raise ConfigError(f"{where} is damaged: it lacks the entry {key}, {words}; {remedy}")
        if not fits(content[key]):
            shown = repr(content[key])
            shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
            raise ConfigError(f"{where} is damaged: its entry {key} must be {words}, not {shown}; {remedy}")


def check_known(content: Mapping[str, Any], expected: Mapping[str, Check], where: str, remedy: str) -> None:
    """Refuse an object in which an entry has another kind of value than expected; entries may be missing.

    Raises:
        ConfigError: as :func:`check_entries`.
    """
    check_entries(content, {key: check for key, check in expected.items() if key in content}, where, remedy)


def check_configuration(config: Mapping[str, Any], where: str, remedy: str) -> None:
    """Refuse a configuration in which a section or a setting that reports read has another kind of value than expected.

    Raises:
        ConfigError: as :func:`check_entries`.
    """
    check_known(config, _CONFIGURATION, where, remedy)
    for section, expected in _SETTINGS.items():
        values = {f"{section}.{key}": value for key, value in (config.get(section) or {}).items()}
        check_known(values, {f"{section}.{key}": check for key, check in expected.items()}, where, remedy)


def check_record(record: Mapping[str, Any], where: str, remedy: str) -> None:
    """Refuse a record of a run in which an entry has another kind of value than expected.

    Raises:
        ConfigError: as :func:`check_entries`.
    """
    check_known(record, _RECORD, where, remedy)
