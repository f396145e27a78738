"""Scores of mode probabilities and of missed alternatives, against loops and hand-computed values."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.metrics.functional import (
    brier_min_sade,
    closest_mode,
    expected_calibration_error,
    min_sade,
    missed,
    reliability,
)

from .. import reference
from ..cases import Case, cases, make_case

ONE = torch.zeros(1, 1, 1, 2), torch.ones(1, 1, 1, dtype=torch.bool)
"""Future and mask of one agent that stands at the origin for one step."""


def modes_at(*errors: float) -> torch.Tensor:
    return torch.tensor([[[[[error, 0.0]]] for error in errors]])


@settings(max_examples=60)
@given(case=cases)
def test_scores_equal_loops(case: Case) -> None:
    value = brier_min_sade(case.states, case.probabilities, case.future, case.mask)
    torch.testing.assert_close(value, torch.tensor(reference.brier(case)).double(), equal_nan=True)
    expected = torch.tensor(reference.displacements(case.states, case.future, case.mask)["minSADE"]).double()
    share = missed(case.states, case.future, case.mask, radius=1.5)
    assert share.tolist() == pytest.approx([math.nan if d.isnan() else float(d > 1.5) for d in expected], nan_ok=True)
    known = ~expected.isnan()
    sums = reliability(case.probabilities, closest_mode(case.states, case.future, case.mask))[known].sum(0)
    error = reference.calibration_error(case, list(range(len(expected))))
    assert expected_calibration_error(sums).item() == pytest.approx(error, nan_ok=True)


def test_the_brier_score_adds_the_squared_error_of_the_closest_modes_probability() -> None:
    value = brier_min_sade(modes_at(2.0, 1.0), torch.tensor([[0.7, 0.3]]), *ONE)
    assert value.item() == pytest.approx(1.0 + 0.7**2)
    tie = brier_min_sade(modes_at(1.0, -1.0, 1.0), torch.tensor([[0.2, 0.5, 0.3]]), *ONE)
    assert tie.item() == pytest.approx(1.0 + 0.8**2), "the first of the closest modes"
    unknown = brier_min_sade(modes_at(2.0, 1.0), torch.tensor([[0.5, math.nan]]), *ONE)
    assert unknown.item() == math.inf, "a probability that is not a number is not left out of the mean"


def test_missed_scenes_have_no_mode_within_the_radius() -> None:
    assert missed(modes_at(0.3, 0.2), *ONE).item() == 0.0
    assert missed(modes_at(0.3, -0.26), *ONE).item() == 1.0
    assert missed(modes_at(0.25), *ONE).item() == 0.0
    assert missed(modes_at(math.nan), *ONE).item() == 1.0, "a broken forecast misses everything"
    assert missed(modes_at(0.3), ONE[0], ~ONE[1]).isnan()


def test_perfect_probabilities_have_no_error_and_certain_wrong_ones_have_the_largest() -> None:
    always, never = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]])
    first = torch.zeros(1, dtype=torch.long)
    assert expected_calibration_error(reliability(always, first).sum(0)) == 0.0
    assert expected_calibration_error(reliability(never, first).sum(0)) == 1.0
    halves = reliability(torch.full((2, 2), 0.5), torch.tensor([0, 1])).sum(0)
    assert expected_calibration_error(halves) == 0.0
    assert halves[5].tolist() == [4.0, 2.0, 2.0]


def test_every_statement_is_in_one_bin() -> None:
    edges = torch.tensor([[0.0, 0.0999], [0.1, 0.9], [0.95, 1.0]], dtype=torch.float64)
    counts = reliability(edges, torch.zeros(3, dtype=torch.long))[..., 0]
    assert counts.argmax(1).tolist() == [0, 1, 9]
    assert counts.sum(1).tolist() == [2.0, 2.0, 2.0]
    assert counts.sum(0)[[0, 1, 9]].tolist() == [2.0, 1.0, 3.0]


@given(st.integers(0, 2**31), st.integers(0, 5))
def test_sums_of_parts_are_the_sums_of_the_whole(seed: int, cut: int) -> None:
    """The division of scenes into batches changes nothing."""
    case = make_case(seed, scenes=5, modes=3)
    closest = closest_mode(case.states, case.future, case.mask)
    whole = reliability(case.probabilities, closest).sum(0)
    parts = [reliability(case.probabilities[part], closest[part]).sum(0) for part in (slice(cut, None), slice(0, cut))]
    torch.testing.assert_close(sum(parts), whole)
    assert 0 <= expected_calibration_error(whole) <= 1


def test_padding_does_not_change_scores() -> None:
    case = make_case(3, scenes=6)
    states = torch.cat([case.states, torch.full_like(case.states, torch.nan)], dim=2)
    future = torch.cat([case.future, torch.full_like(case.future, torch.inf)], dim=1)
    mask = torch.cat([case.mask, torch.zeros_like(case.mask)], dim=1)
    assert torch.equal(closest_mode(states, future, mask), closest_mode(case.states, case.future, case.mask))
    torch.testing.assert_close(
        brier_min_sade(states, case.probabilities, future, mask),
        brier_min_sade(case.states, case.probabilities, case.future, case.mask),
        equal_nan=True,
    )


def test_the_closest_mode_has_the_smallest_displacement() -> None:
    case = make_case(5, scenes=20, modes=4)
    best = closest_mode(case.states, case.future, case.mask)
    chosen = case.states[torch.arange(20), best][:, None]
    torch.testing.assert_close(
        min_sade(chosen, case.future, case.mask), min_sade(case.states, case.future, case.mask), equal_nan=True
    )
