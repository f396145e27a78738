"""Tasks that no scene can have, and names of subsets."""

from __future__ import annotations

from typing import Any

import pytest

from epo_lightning.registry import ConfigError
from epo_lightning.task import Task


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"horizon": 0}, "1 future step or more and 0 goal candidates or more, not horizon=0, candidates=1"),
        ({"candidates": -1}, "0 goal candidates or more, not horizon=20, candidates=-1"),
        ({"history": 0}, "a task's history must be 1 step or more, not 0"),
        ({"dt": 0.0}, "a task's dt must be positive and finite, not 0.0"),
        ({"scale": float("inf")}, "a task's scale must be positive and finite, not inf"),
        ({"shape": "square"}, "a task's shape must be disc or box, not 'square'"),
        ({"subsets": ("executed", "own")}, "a task has a subset 'own', but scores such as"),
        ({"subsets": ("initial",)}, "a task has a subset 'initial', but scores such as"),
    ],
)
def test_impossible_tasks_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Task(**{"horizon": 20, "dt": 0.2, **wrong})
