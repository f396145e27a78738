"""Overlap rates: hand-computed values, shapely's polygons, and masking of absent agents."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning.metrics.functional import overlap_rate, overlapping_pairs
from epo_lightning.metrics.functional.overlap import overlaps, overlaps_with
from epo_lightning.registry import ConfigError

from .. import reference
from ..cases import Case, cases, make_case


def rate(positions: list[list[float]], shape: str = "disc", definition: str = "jfp", size: float = 0.5) -> float:
    """Agents that stand at (x, y, heading) in the only mode."""
    states = torch.tensor(positions, dtype=torch.float64)[None, None, :, None]
    states = torch.nn.functional.pad(states, (0, 1))
    agents = len(positions)
    mask = torch.ones(1, agents, dtype=torch.bool)
    sizes = torch.full((1, agents, 2), size).double()
    return overlap_rate(states, torch.ones(1, 1).double(), sizes, mask, definition, shape).item()


@pytest.mark.parametrize(
    ("distance", "expected"), [(0.4999, 1.0), (0.5, 0.0), (0.5001, 0.0), (0.0, 1.0)], ids=["in", "touch", "out", "same"]
)
@pytest.mark.parametrize("shape", ["disc", "box"])
def test_radius_is_half_of_the_size_and_touching_is_no_overlap(shape: str, distance: float, expected: float) -> None:
    assert rate([[0, 0, 0], [distance, 0, 0]], shape) == expected


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_touching_is_no_overlap_in_any_direction_in_spite_of_rounding(shape: str) -> None:
    for heading in torch.linspace(-3.0, 3.0, 61).tolist():
        beside = [0.5 * math.cos(heading), 0.5 * math.sin(heading), heading]
        assert rate([[0, 0, heading], beside], shape) == 0.0
        assert rate([[0, 0, heading], [0.99999 * beside[0], 0.99999 * beside[1], heading]], shape) == 1.0


@pytest.mark.parametrize(("shape", "expected"), [("disc", 0.0), ("box", 1.0)])
def test_corners_overlap_for_boxes_but_not_for_discs(shape: str, expected: float) -> None:
    assert rate([[0, 0, 0], [0.45, 0.45, 0]], shape) == expected


def test_boxes_turn_with_the_heading() -> None:
    # The corner of a square that is turned by 45 degrees reaches 0.25 + 0.25 sqrt(2) = 0.6036 m along the axis.
    assert rate([[0, 0, 0], [0.603, 0, math.pi / 4]], "box") == 1.0
    assert rate([[0, 0, 0], [0.604, 0, math.pi / 4]], "box") == 0.0


def test_long_box_that_only_its_own_side_separates() -> None:
    # Seen along x and y the shadows of a diagonal 4 m x 0.2 m bar and of a 1 m square meet; across the bar they do not.
    states = torch.tensor([[[0.0, 0.0, math.pi / 4, 0.0]], [[1.0, -1.0, 0.0, 0.0]]]).double()[None]
    sizes = torch.tensor([[[4.0, 0.2], [1.0, 1.0]]]).double()
    everyone = torch.ones(1, 2, dtype=torch.bool)
    assert not overlapping_pairs(states, sizes, everyone, "box").any()
    states[0, 1, 0, :2] = torch.tensor([0.5, -0.5])
    assert overlapping_pairs(states, sizes, everyone, "box").all()


def test_both_overlap_rates_equal_hand_computed_values() -> None:
    # Three agents in a row: two of the three pairs overlap.
    row = [[0.0, 0, 0], [0.4, 0, 0], [0.8, 0, 0]]
    assert rate(row, definition="jfp") == 1.0
    assert rate(row, definition="authors") == pytest.approx(2 / 3)
    assert rate(row[:2], definition="authors") == 0.5
    assert rate(row[:1], definition="authors") == rate(row[:1], definition="jfp") == 0.0


def test_only_the_most_likely_mode_counts_at_any_step() -> None:
    states = torch.zeros(1, 2, 2, 3, 4)
    states[0, :, 1, :, 0] = 5.0
    states[0, 1, 1, 1, 0] = 0.1  # mode 1 overlaps at the middle step only
    sizes, everyone = torch.full((1, 2, 2), 0.5), torch.ones(1, 2, dtype=torch.bool)
    assert overlap_rate(states, torch.tensor([[0.6, 0.4]]), sizes, everyone).item() == 0.0
    assert overlap_rate(states, torch.tensor([[0.4, 0.6]]), sizes, everyone).item() == 1.0


@settings(max_examples=60)
@given(case=cases, shape=st.sampled_from(["disc", "box"]), definition=st.sampled_from(["jfp", "authors"]))
def test_equals_polygons(case: Case, shape: str, definition: str) -> None:
    expected = reference.overlaps(case.states, case.probabilities, case.size, case.agent_mask, shape)[definition]
    actual = overlap_rate(case.states, case.probabilities, case.size, case.agent_mask, definition, shape)
    torch.testing.assert_close(actual, torch.tensor(expected).double(), equal_nan=True)


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_random_cases_contain_overlapping_and_separate_agents(shape: str) -> None:
    case = make_case(0, scenes=200, steps=2)
    mean = overlap_rate(case.states, case.probabilities, case.size, case.agent_mask, shape=shape).nanmean()
    assert 0.2 < mean < 0.8


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_scene_is_the_same_alone_in_a_batch_and_padded(shape: str) -> None:
    case = make_case(5, scenes=8)
    whole = overlap_rate(case.states, case.probabilities, case.size, case.agent_mask, "authors", shape)
    for b in range(8):
        one = slice(b, b + 1)
        alone = overlap_rate(
            case.states[one], case.probabilities[one], case.size[one], case.agent_mask[one], "authors", shape
        )
        assert torch.equal(alone.nan_to_num(-1), whole[one].nan_to_num(-1))
    padded = overlap_rate(
        torch.cat([case.states, case.states], dim=2),  # the padding stands exactly where agents are
        case.probabilities,
        torch.cat([case.size, case.size], dim=1),
        torch.cat([case.agent_mask, torch.zeros_like(case.agent_mask)], dim=1),
        "authors",
        shape,
    )
    assert torch.equal(padded.nan_to_num(-1), whole.nan_to_num(-1))


@pytest.mark.parametrize("shape", ["disc", "box"])
@pytest.mark.parametrize("agent", [0, 1, 2])
def test_overlaps_with_one_agent_are_those_of_its_pairs(shape: str, agent: int) -> None:
    """Also where the agent itself is absent: then it overlaps nobody."""
    case = make_case(3, scenes=60, steps=2)
    states, sizes = case.states[:, 0], case.size
    for one in (True, False):
        there = case.agent_mask.clone()
        there[:, agent] = one
        every = overlaps(states, sizes, there, shape)
        members = torch.triu_indices(states.shape[1], states.shape[1], 1)
        mine = every[:, (members == agent).any(0)]  # pairs with an agent, in the order of the others
        found = overlaps_with(agent, states, sizes, there, shape)
        assert torch.equal(found, mine)
        assert found.any() == one


@pytest.mark.parametrize("shape", ["disc", "box"])
def test_a_nan_forecast_has_an_infinite_overlap_rate(shape: str) -> None:
    states = torch.zeros(2, 1, 2, 1, 4)
    states[:, :, 1, :, 0] = 5.0
    states[1, 0, 1, 0, 0] = torch.nan
    values = overlap_rate(
        states, torch.ones(2, 1), torch.ones(2, 2, 2), torch.ones(2, 2, dtype=torch.bool), shape=shape
    )
    assert values.tolist() == [0.0, math.inf]


def test_rates_have_the_precision_of_the_forecast() -> None:
    """One of the three pairs of three agents overlaps: a third, in float64."""
    states = torch.zeros(1, 1, 3, 1, 4, dtype=torch.float64)
    states[0, 0, :, 0, 0] = torch.tensor([0.0, 1.0, 9.0])
    there = torch.ones(1, 3, dtype=torch.bool)
    rate = overlap_rate(states, states.new_ones(1, 1), states.new_full((1, 3, 2), 2.0), there, definition="authors")
    assert rate.item() == 1 / 3


def test_unknown_options_are_named() -> None:
    with pytest.raises(ConfigError, match=r"unknown shape 'disk'.*did you mean 'disc'"):
        rate([[0, 0, 0]], shape="disk")
    with pytest.raises(ConfigError, match=r"unknown definition 'author'.*did you mean 'authors'"):
        rate([[0, 0, 0]], definition="author")
