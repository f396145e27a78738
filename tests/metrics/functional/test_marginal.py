"""Ordering of marginal modes."""

from __future__ import annotations

import torch
from hypothesis import given, settings

from epo_lightning.metrics.functional import marginal_to_joint, min_ade, min_sade

from .. import reference
from ..cases import Case, cases


def test_marginal_metrics_equal_hand_computed_values() -> None:
    states = torch.arange(6.0).view(1, 3, 2, 1, 1)  # modes of agent 0: 0, 2, 4; of agent 1: 1, 3, 5
    probabilities = torch.tensor([[[0.2, 0.5], [0.3, 0.1], [0.5, 0.4]]])
    joint, ordered = marginal_to_joint(states, probabilities)
    assert joint.flatten().tolist() == [4.0, 1.0, 2.0, 5.0, 0.0, 3.0]
    assert torch.equal(ordered, torch.tensor([[[0.5, 0.5], [0.3, 0.4], [0.2, 0.1]]]))


def test_equally_likely_modes_keep_their_order() -> None:
    states = torch.arange(40.0).view(1, 40, 1, 1, 1)
    assert torch.equal(marginal_to_joint(states, torch.ones(1, 40, 1))[0], states)


@settings(max_examples=60)
@given(case=cases)
def test_equals_loops_and_leaves_marginal_metrics_alone(case: Case) -> None:
    states, probabilities = marginal_to_joint(case.states, case.agent_probabilities)
    expected_states, expected_probabilities = reference.ordered(case.states, case.agent_probabilities)
    torch.testing.assert_close(states, expected_states, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(probabilities, expected_probabilities)
    before, after = (min_ade(s, case.future, case.mask) for s in (case.states, states))
    torch.testing.assert_close(after, before, equal_nan=True)


def test_joint_metrics_depend_on_the_order_of_modes() -> None:
    # Each agent has one mode that is right; put together they are right only if both are equally ranked.
    states = torch.zeros(1, 2, 2, 1, 2)
    states[0, 0, 1], states[0, 1, 0] = 1.0, 1.0
    future, mask = torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1, dtype=torch.bool)
    joint, _ = marginal_to_joint(states, torch.tensor([[[0.9, 0.1], [0.1, 0.9]]]))
    assert min_sade(states, future, mask).item() > 0.5
    assert min_sade(joint, future, mask).item() == 0.0
