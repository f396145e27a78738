"""Masking of secrets in addresses, for all files and messages: ``postgresql://me:***@host/db?sslkey=***``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TypeVar

MASK = "***"

_RULES = (
    (re.compile(r"(://[^\s:/?#@]*:)\S*@"), rf"\1{MASK}@"),  # user:password@
    (re.compile(r"(https?://)[^\s/?#@:*]+@"), rf"\1{MASK}@"),  # token@
    (
        re.compile(
            r"([?&;][\w.-]*(?:token|key|pass|pwd|secret|credential|signature|sig|auth)[\w.-]*=)[^\s&;#'\"]+", re.I
        ),
        rf"\1{MASK}",
    ),
)

Value = TypeVar("Value")


def mask(value: Value) -> Value:
    """A copy of a value in which the secrets of all addresses are masked: passwords, and tokens in user names or queries.

    Args:
        value: text, or mappings and lists with text in them; other values are left as they are.
    """
    if isinstance(value, str):
        text: str = value
        for pattern, replacement in _RULES if "://" in text else ():
            text = pattern.sub(replacement, text)
        return text  # type: ignore[return-value]
    if isinstance(value, Mapping):
        return {key: mask(entry) for key, entry in value.items()}  # type: ignore[return-value]
    if isinstance(value, list | tuple):
        return type(value)(map(mask, value))
    return value


def is_masked(text: str) -> bool:
    """Whether a secret in the text has been masked."""
    return MASK in text and mask(text) == text
