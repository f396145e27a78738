"""Losses against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from epo_lightning import losses

MASK = torch.ones(1, 2, 1, dtype=torch.bool)
DISTANCE = torch.tensor([[[1.0, 5.0], [3.0, 1.0]]])  # [B=1, M=2, N=2]


def test_distances_are_means_over_observed_steps():
    positions = torch.zeros(1, 1, 2, 2, 2)
    future = torch.zeros(1, 2, 2, 4)
    future[0, 0, :, 0] = torch.tensor([3.0, 5.0])
    future[0, 1, 1, :2] = torch.nan
    mask = torch.tensor([[[True, True], [True, False]]])
    assert losses.distances(positions, future, mask).tolist() == [[[4.0, 0.0]]]


def test_joint_and_marginal_imitation_choose_their_own_modes():
    joint, mode = losses.scene_imitation(DISTANCE, MASK)
    assert (joint.item(), mode.item()) == (2.0, 1)
    marginal, modes = losses.marginal_imitation(DISTANCE, MASK)
    assert (marginal.item(), modes.tolist()) == (1.0, [[0, 1]])


def test_agents_without_a_future_do_not_count():
    mask = torch.tensor([[[True], [False]]])
    joint, mode = losses.scene_imitation(DISTANCE, mask)
    assert (joint.item(), mode.item()) == (1.0, 0)


def test_relaxation_adds_the_mean_over_modes_and_fades():
    relaxation = losses.Relaxation(share=0.5, steps=10)
    assert [relaxation.at(step) for step in (0, 5, 10, 99)] == [0.5, 0.25, 0.0, 0.0]
    joint, mode = losses.scene_imitation(DISTANCE, MASK, 0.5)  # modes are at 3 and 2
    assert (joint.item(), mode.item()) == (2.25, 1)
    marginal, _ = losses.marginal_imitation(DISTANCE, MASK, 0.5)  # closest 1 and 1, means 2 and 3
    assert marginal.item() == 1.75
    with pytest.raises(ValueError, match="relaxation"):
        losses.Relaxation(share=2.0)


def test_probabilities_are_scored_at_the_closest_mode():
    probabilities = torch.tensor([[0.25, 0.75]])
    assert losses.scene_probability(probabilities, torch.tensor([1]), MASK).item() == pytest.approx(0.2877, abs=1e-4)
    agents = torch.tensor([[[0.25, 0.5], [0.75, 0.5]]])
    value = losses.marginal_probability(agents, torch.tensor([[1, 0]]), MASK)
    assert value.item() == pytest.approx((0.2877 + 0.6931) / 2, abs=1e-4)
    certain = torch.tensor([[1.0, 0.0]], requires_grad=True)
    assert losses.scene_probability(certain, torch.tensor([1]), MASK).isfinite()
    assert losses.scene_probability(probabilities, torch.tensor([1]), ~MASK) == 0, "nothing was observed"


@settings(deadline=None)
@given(
    st.lists(
        st.lists(
            st.tuples(
                st.booleans(),  # whether the last step was observed
                st.tuples(st.integers(-9, 9), st.integers(-9, 9)),
                st.lists(st.tuples(st.booleans(), st.integers(-9, 9), st.integers(-9, 9)), min_size=3, max_size=3),
            ),
            min_size=2,
            max_size=2,
        ),
        min_size=1,
        max_size=3,
    )
)
def test_goals_are_scored_at_the_candidate_closest_to_the_last_position(scenes):
    batch = len(scenes)
    candidates, exists = torch.full((batch, 2, 3, 2), torch.nan), torch.zeros(batch, 2, 3, dtype=torch.bool)
    final, observed = torch.full((batch, 2, 2), torch.nan), torch.zeros(batch, 2, dtype=torch.bool)
    probabilities = torch.rand(batch, 2, 3).softmax(-1).requires_grad_()
    of_scenes = []
    for b, agents in enumerate(scenes):
        costs = []
        for i, (seen, end, offered) in enumerate(agents):
            way = {}
            for g, (real, x, y) in enumerate(offered):
                if real:
                    candidates[b, i, g], exists[b, i, g] = torch.tensor([x, y]), True
                    way[g] = (x - end[0]) ** 2 + (y - end[1]) ** 2
            if seen:
                final[b, i], observed[b, i] = torch.tensor(end), True
            if seen and way:
                costs.append(-math.log(probabilities[b, i, min(way, key=way.get)].item()))
        of_scenes.append(sum(costs) / len(costs) if costs else 0.0)
    loss = losses.goal(probabilities, candidates, exists, final, observed)
    assert loss.item() == pytest.approx(sum(of_scenes) / batch, abs=1e-5)
    loss.backward()
    assert probabilities.grad.isfinite().all()
