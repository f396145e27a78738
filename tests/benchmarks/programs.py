"""Programs of the folder `benchmarks`: how one refuses, and a training that is short enough for them."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

TINY = (
    "data=drawn",
    "data.scenes=32",
    "data.batch_size=4",
    "data.like=highway",
    "budget=smoke",
    "callbacks.progress=none",
)
"""Overrides of a training of seconds on scenes that are drawn at random."""


def refused(main, *words: object) -> str:
    """The one line with which a benchmark ends."""
    with pytest.raises(SystemExit) as found:
        main([str(word) for word in words])
    message = str(found.value)
    assert found.value.code not in (0, None)
    assert "\n" not in message
    return message
