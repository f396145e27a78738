"""Scores of the equilibrium report."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from epo_lightning.forecast import Equilibrium
from epo_lightning.metrics import METRICS, ForecastMetrics
from epo_lightning.metrics.forecast import EQUILIBRIUM_METRICS

from .cases import make_case


def found(scenes: int = 4, agents: int = 3) -> Equilibrium:
    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, dtype=torch.float64)

    return Equilibrium(
        initial_energy=3.0 + uniform(scenes),
        energy=2.0 + uniform(scenes),
        optimum=1.0 + uniform(scenes),
        gradient_norm=uniform(scenes),
        nash_gap=uniform(scenes, agents),
        objective=1.0 + uniform(scenes, agents),
    )


def scores(equilibrium: Equilibrium | None, parts=(slice(0, 4),), subsets=("even", "odd")) -> dict[str, float]:
    case = make_case(0, scenes=4)
    metrics = ForecastMetrics(subsets=subsets)
    for part in parts:
        forecast = dataclasses.replace(case.forecast(), equilibrium=equilibrium)
        metrics.update(forecast[part], case.scene(torch.arange(4) % 2)[part])
    return {name: value.item() for name, value in metrics.compute().items()}


def test_equilibrium_scores_are_means_over_all_scenes_without_subsets() -> None:
    report = found()
    result = scores(report)
    assert [name for name in result if name in EQUILIBRIUM_METRICS] == list(EQUILIBRIUM_METRICS)
    assert not [name for name in result if "/" in name and name.split("/")[1] in EQUILIBRIUM_METRICS]
    assert {f"odd/{name}" for name in METRICS} < set(result)
    for name, values in (
        ("energy_initial", report.initial_energy),
        ("energy_solved", report.energy),
        ("energy_optimum", report.optimum),
        ("gradient_norm", report.gradient_norm),
    ):
        assert result[name] == pytest.approx(values.mean().item())
    gaps = [max(gap) for gap in report.nash_gap.tolist()]
    shares = [
        max(g / j for g, j in zip(*rows, strict=True))
        for rows in zip(report.nash_gap.tolist(), report.objective.tolist(), strict=True)
    ]
    assert result["nash_gap"] == pytest.approx(sum(gaps) / 4)
    assert result["nash_gap_relative"] == pytest.approx(sum(shares) / 4)


def test_scores_do_not_depend_on_the_batch_size() -> None:
    report = found()
    assert scores(report, (slice(0, 1), slice(1, 4))) == pytest.approx(scores(report))


def test_forecasts_without_a_report_have_no_such_scores() -> None:
    assert not set(EQUILIBRIUM_METRICS) & set(scores(None))


def test_values_that_are_not_finite_are_left_out_of_the_mean() -> None:
    report = found()
    optimum, gap = report.optimum.clone(), report.nash_gap.clone()
    optimum[1], gap[2, 0], gap[3, 1] = torch.inf, torch.nan, torch.inf
    result = scores(dataclasses.replace(report, optimum=optimum, nash_gap=gap))
    assert result["energy_optimum"] == pytest.approx(report.optimum[[0, 2, 3]].mean().item())
    assert result["nash_gap"] == pytest.approx(report.nash_gap[:2].amax(1).mean().item())
    assert result["energy_solved"] == pytest.approx(report.energy.mean().item())


def test_relative_gaps_need_a_positive_objective() -> None:
    report = found()
    objective = report.objective.clone()
    objective[0, 0], objective[1], objective[2:] = -3.0, 0.0, -1.0
    result = scores(dataclasses.replace(report, objective=objective))
    expected = (report.nash_gap[0, 1:] / report.objective[0, 1:]).max().item()
    assert result["nash_gap_relative"] == pytest.approx(expected), "of the one scene that has any"
    nobody = scores(dataclasses.replace(report, objective=-report.objective))
    assert "nash_gap_relative" not in nobody
    assert all(math.isfinite(nobody[name]) for name in EQUILIBRIUM_METRICS[:-1])
