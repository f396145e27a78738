"""Registered metrics: their means over scenes and subsets, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from epo_lightning import registry
from epo_lightning.forecast import JointForecast
from epo_lightning.metrics import ForecastMetrics
from epo_lightning.metrics.forecast import scores
from epo_lightning.registry import ConfigError, register
from epo_lightning.scene import Scene

from .cases import make_case


@pytest.fixture
def add(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, Any], None]:
    """Registers a metric until the end of the test."""
    monkeypatch.setattr(registry, "_PARTS", {**registry._PARTS, "metric": dict(registry.parts("metric"))})
    return lambda name, metric: register("metric", name)(metric) and None


def largest_speed(forecast: JointForecast, scene: Scene) -> Tensor:
    """The largest forecast speed of a scene; none for every third scene."""
    speed = forecast.states[..., 3].flatten(1).amax(1)
    return torch.where(torch.arange(len(speed)) % 3 == 2, torch.nan, speed)


def test_values_are_means_over_scenes_and_subsets_without_nan(add: Callable[[str, Any], None]) -> None:
    case, subset = make_case(5, scenes=11), torch.arange(11) % 2
    forecast, scene = case.forecast(), case.scene(subset)
    plain = ForecastMetrics(("executed", "alternative"))
    plain.update(forecast, scene)
    add("speed", largest_speed)
    metrics = ForecastMetrics(("executed", "alternative"))
    for part in (slice(0, 6), slice(6, 11)):
        metrics.update(forecast[part], scene[part])
    found = {name: float(value) for name, value in metrics.compute().items()}
    values = torch.cat([largest_speed(forecast[part], scene[part]) for part in (slice(0, 6), slice(6, 11))])
    for prefix, chosen in (("", subset >= 0), ("executed/", subset == 0), ("alternative/", subset == 1)):
        some = values[chosen & ~values.isnan()].tolist()
        assert found.pop(f"{prefix}own/speed") == pytest.approx(sum(some) / len(some))
    assert found == pytest.approx({name: float(value) for name, value in plain.compute().items()}, nan_ok=True)
    assert scores()[-2:] == ("own/speed", "ECE")


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        (
            lambda forecast, scene: forecast.states.mean(),
            r"metrics.py:\d+: the metric 'mine' returned \[\]; a tensor",
        ),
        (
            lambda forecast, scene: 1.0,
            r"the metric 'mine' returned float; a tensor \[4\] was expected, a real number for every",
        ),
        (
            lambda forecast, scene: torch.ones(4) * 1j,
            r"the metric 'mine' returned \[4\]; .*, a real number for every",
        ),
        (
            lambda forecast, scene: forecast.speeds,
            r"the metric 'mine' fails at .*test_own_metrics.py:\d+, AttributeError: ",
        ),
    ],
)
def test_a_metric_that_fails_or_returns_something_else_is_named(
    add: Callable[[str, Any], None], metric: Any, message: str
) -> None:
    add("mine", metric)
    case = make_case(1, scenes=4)
    with pytest.raises(ConfigError, match=message):
        ForecastMetrics().update(case.forecast(), case.scene(None))
