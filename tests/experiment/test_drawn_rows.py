"""Which rows and scenes a report draws."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import torch

from epo_lightning.experiment.pictures import pairs
from epo_lightning.experiment.report_scenes import _best_of_titles


def row(name: str, score: float | None, title: str = "EPO", digest: str = "a") -> Any:
    cells = {} if score is None else {"minSADE": SimpleNamespace(mean=score)}
    return SimpleNamespace(name=name, title=title, runs=[SimpleNamespace(trained_digest=digest)], cells=cells)


def drawn(*rows: Any) -> list[str]:
    return [found.name for found in _best_of_titles(rows)]


def test_of_rows_with_one_title_the_best_is_drawn() -> None:
    assert drawn(row("worse", 0.3), row("best", 0.1), row("between", 0.2), row("other", 0.9, "SC")) == ["best", "other"]
    assert drawn(row("nan", math.nan), row("best", 0.5), row("none", None)) == ["best"]
    assert drawn(row("nan", math.nan)) == ["nan"], "it is drawn, to see why"


def test_rows_that_were_trained_on_other_data_than_the_first_one_are_not_drawn() -> None:
    assert drawn(row("first", 0.3), row("better", 0.1, digest="b"), row("other", 0.2, "SC", "b")) == ["first"]


def test_the_executed_future_is_drawn_as_the_truth_in_whatever_order_records_are_stored() -> None:
    scenes: Any = SimpleNamespace(
        history=torch.zeros(6, 1), id=torch.tensor([3, 3, 0, 7, 0, 8]), subset=torch.tensor([1, 0, 0, 0, 1, 0])
    )
    shown, others = pairs(scenes, 4)
    assert others is not None
    assert (shown.tolist(), others.tolist()) == ([1, 2], [0, 4])
