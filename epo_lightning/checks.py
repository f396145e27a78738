"""Checks of configured values, with errors that name the key, the expected value and the given one."""

from __future__ import annotations

import math
from collections.abc import Collection
from numbers import Real
from typing import Any

from epo_lightning.registry import ConfigError, nearest


def is_number(value: Any) -> bool:
    """Whether a configured value is a number; True and False do not count as numbers."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_choice(key: str, value: Any, known: Collection[str], of: str = "") -> None:
    """Check that a configured value is one of the known names.

    Args:
        key: name of the configuration key.
        value: value of the key.
        known: the names that there are.
        of: what has this key, for messages, where the key alone does not say it.

    Raises:
        ConfigError: another value; the message names the key and the nearest known name.
    """
    if value not in known:
        owner = f" of {of}" if of else ""
        raise ConfigError(f"unknown {key} {value!r}{owner}: {nearest(str(value), known)}")


def check_whole(key: str, value: Any, least: int = 1) -> None:
    """Check that a configured value is a whole number, ``least`` or more.

    Raises:
        ConfigError: another value; the message names the key.
    """
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ConfigError(f"{key} must be a whole number, {least} or more, not {value!r}")


def check_share(key: str, value: Any, meaning: str) -> None:
    """Check that a configured value is a number above 0 and not above 1.

    Raises:
        ConfigError: another value; the message names the key and what it is the share of.
    """
    if not is_number(value) or not 0 < value <= 1:
        raise ConfigError(f"{key} is {value!r}, expected a number in (0, 1]: {meaning}")


def check_number(key: str, value: Any, zero: bool = False, finite: bool = True, null: bool = False) -> None:
    """Check that a configured value is a positive number.

    Args:
        key: name of the configuration key.
        value: value of the key.
        zero: whether 0 is allowed.
        finite: whether infinity is refused.
        null: whether None is allowed.

    Raises:
        ConfigError: another value; the message names the key.
    """
    if null and value is None:
        return
    allowed = is_number(value) and (value > 0 or (zero and value == 0)) and not (finite and value == math.inf)
    if not allowed:
        wanted = (
            ("0 or more" if zero else "positive") + (", and finite" if finite else "") + (", or null" if null else "")
        )
        raise ConfigError(f"{key} must be a number, {wanted}, not {value!r}")
