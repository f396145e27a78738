"""Checks of the entries of files that a report reads: an error names the file, the key and what was expected."""

from __future__ import annotations

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


TEXT: Check = "a text", _text
TEXTS: Check = "a list of texts", lambda value: _all(value, _text)
ROWS: Check = "a list of lists of texts", lambda value: _all(value, TEXTS[1])
PAIRS: Check = "a list of pairs of texts", lambda value: ROWS[1](value) and all(len(row) == 2 for row in value)
OBJECT: Check = "an object", _object
OBJECTS: Check = "a list of objects", lambda value: _all(value, _object)
OBJECTS_BY_NAME: Check = "objects by name", lambda value: _object(value) and all(map(_object, value.values()))
NUMBERS_BY_NAME: Check = "numbers by name", lambda value: _object(value) and all(map(_number, value.values()))


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
