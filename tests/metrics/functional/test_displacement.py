"""Displacement metrics: hand-computed values, plain loops, and masking of unobserved steps."""

from __future__ import annotations

import jaxtyping
import pytest
import torch
from hypothesis import given, settings

from epo_lightning.metrics.functional import min_ade, min_fde, min_sade, min_sfde

from .. import reference
from ..cases import Case, cases, make_case

METRICS = {"minADE": min_ade, "minFDE": min_fde, "minSADE": min_sade, "minSFDE": min_sfde}


def two_agents(mask: torch.Tensor | None = None) -> dict[str, float]:
    """One scene, two modes, two agents, two steps; the future is zero, so that states are errors."""
    errors = torch.tensor([[[1.0, 3.0], [10.0, 10.0]], [[4.0, 4.0], [2.0, 6.0]]])  # mode, agent, step
    states = torch.stack([errors, torch.zeros_like(errors)], dim=-1)[None]
    future = torch.zeros(1, 2, 2, 2)
    mask = torch.ones(1, 2, 2, dtype=torch.bool) if mask is None else mask
    return {name: metric(states, future, mask).item() for name, metric in METRICS.items()}


def test_displacement_metrics_equal_hand_computed_values() -> None:
    # Mode 0: agents average 2 and 10, end at 3 and 10. Mode 1: average 4 and 4, end at 4 and 6.
    assert two_agents() == {"minADE": 3.0, "minSADE": 4.0, "minFDE": 4.5, "minSFDE": 5.0}


def test_unobserved_steps_do_not_count() -> None:
    mask = torch.tensor([[[True, False], [True, True]]])
    # Agent 0 counts with its first step only, and is not there in the end.
    assert two_agents(mask) == {"minADE": 2.5, "minSADE": 4.0, "minFDE": 6.0, "minSFDE": 6.0}


def test_each_metric_chooses_its_own_best_mode() -> None:
    states = torch.zeros(1, 2, 1, 2, 2)
    states[0, 0, 0, :, 0] = torch.tensor([0.0, 3.0])
    states[0, 1, 0, :, 0] = torch.tensor([9.0, 1.0])
    arguments = states, torch.zeros(1, 1, 2, 2), torch.ones(1, 1, 2, dtype=torch.bool)
    assert min_sade(*arguments).item() == 1.5
    assert min_sfde(*arguments).item() == 1.0


def test_distance_is_euclidean_and_ignores_heading_and_speed() -> None:
    states = torch.tensor([3.0, 4.0, 100.0, 100.0]).view(1, 1, 1, 1, 4)
    arguments = states, torch.zeros(1, 1, 1, 4), torch.ones(1, 1, 1, dtype=torch.bool)
    assert [metric(*arguments).item() for metric in METRICS.values()] == [5.0] * 4


@pytest.mark.parametrize("metric", METRICS.values())
@pytest.mark.parametrize("wrong", ["one step", "one agent", "one scene", "mask of one step", "no modes"])
def test_shapes_that_would_be_broadcast_are_refused(metric, wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it
    states, future, mask = torch.zeros(3, 2, 4, 5, 2), torch.zeros(3, 4, 5, 2), torch.ones(3, 4, 5, dtype=torch.bool)
    arguments = {
        "one step": (states, future[:, :, :1], mask[:, :, :1]),
        "one agent": (states, future[:, :1], mask[:, :1]),
        "one scene": (states, future[:1], mask[:1]),
        "mask of one step": (states, future, mask[:, :, :1]),
        "no modes": (states[:, 0], future, mask),
    }
    with pytest.raises(ValueError, match="shape"):
        metric(*arguments[wrong])


@settings(max_examples=60)
@given(case=cases)
def test_equals_loops(case: Case) -> None:
    expected = reference.displacements(case.states, case.future, case.mask)
    for name, metric in METRICS.items():
        actual = metric(case.states, case.future, case.mask)
        torch.testing.assert_close(actual, torch.tensor(expected[name]).double(), equal_nan=True, msg=name)


@pytest.mark.parametrize("name", METRICS)
def test_scores_are_nan_without_observations_and_inf_for_broken_forecasts(name: str) -> None:
    future, mask = torch.zeros(2, 1, 2, 2), torch.tensor([[[False, False]], [[True, True]]])
    values = METRICS[name](torch.full((2, 3, 1, 2, 2), torch.nan), future, mask)
    assert values[0].isnan()
    assert values[1].isposinf()


@pytest.mark.parametrize("name", METRICS)
def test_scene_is_the_same_alone_in_a_batch_and_padded(name: str) -> None:
    case, metric = make_case(3, scenes=6), METRICS[name]
    whole = metric(case.states, case.future, case.mask)
    for b in range(6):
        alone = metric(case.states[b : b + 1], case.future[b : b + 1], case.mask[b : b + 1])
        assert torch.equal(alone.nan_to_num(-1), whole[b : b + 1].nan_to_num(-1))
    states = torch.cat([case.states, torch.full_like(case.states, torch.nan)], dim=2)
    future = torch.cat([case.future, torch.full_like(case.future, torch.inf)], dim=1)
    mask = torch.cat([case.mask, torch.zeros_like(case.mask)], dim=1)
    torch.testing.assert_close(metric(states, future, mask), whole, rtol=0, atol=1e-12, equal_nan=True)
