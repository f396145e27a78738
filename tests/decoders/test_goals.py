"""The goal decoder against the plain concatenation, and the choice of goals against sorting by hand."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from games import highway_scene, pad, random_scene
from hypothesis import given
from hypothesis import strategies as st

from epo_lightning.decoders.goals import NO_CANDIDATE, GivenGoals, GoalDecoder, choose, most_likely
from epo_lightning.decoders.mlp import MLP
from epo_lightning.scene import Scene


def concatenated(mlp: MLP, z: torch.Tensor, scene: Scene, scale: float) -> torch.Tensor:
    """Logits of existing candidates, in order: features written down once for every candidate, layers one by one."""
    rows = []
    for b, i, g in scene.goal_mask.nonzero().tolist():
        if scene.agent_mask[b, i]:
            rows.append(torch.cat((z[b, i], (scene.goal_candidates[b, i, g] - scene.current[b, i, :2]) / scale)))
    hidden = torch.stack(rows)
    for linear, norm in zip(mlp.hidden, mlp.norms, strict=True):
        hidden = linear(hidden)
        if mlp.training:
            hidden = (hidden - hidden.mean(0)) / (hidden.var(0, correction=0) + norm.eps).sqrt()
        else:
            hidden = (hidden - norm.running_mean) / (norm.running_var + norm.eps).sqrt()
        hidden = (hidden * norm.weight + norm.bias).relu()
    return mlp.output(hidden)[:, 0]


@pytest.mark.parametrize("training", [True, False])
def test_logits_are_those_of_the_concatenation(training):
    decoder, scene = GoalDecoder(8, scale=50.0), highway_scene(4, 3)
    scene.agent_mask[1, 2] = False
    z = torch.randn(4, 3, 8)
    decoder.logits(z, scene)  # the running statistics have seen something
    decoder.train(training)
    exists = scene.goal_mask & scene.agent_mask[..., None]
    logits = decoder.logits(z, scene)
    torch.testing.assert_close(logits[exists], concatenated(decoder.mlp, z, scene, 50.0), rtol=1e-4, atol=1e-4)
    assert (logits[~exists] == NO_CANDIDATE).all()


@pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
def test_padding_changes_neither_logits_nor_gradients(filling):
    decoder, scene, z = GoalDecoder(8, scale=50.0), highway_scene(4, 3), torch.randn(4, 5, 8)
    logits = decoder.logits(z[:, :3], scene)
    logits.softmax(-1)[..., 0].sum().backward()
    learned = [parameter for parameter in decoder.parameters() if parameter.requires_grad]
    gradients = [parameter.grad.clone() for parameter in learned]
    decoder.zero_grad()
    padded = decoder.logits(z, pad(scene, agents=2, filling=filling, candidates=3))
    torch.testing.assert_close(padded[:, :3, :6], logits, rtol=0, atol=1e-5)
    assert (padded[:, 3:] == NO_CANDIDATE).all()
    assert (padded[..., 6:] == NO_CANDIDATE).all()
    padded.softmax(-1)[:, :3, 0].sum().backward()
    torch.testing.assert_close([parameter.grad for parameter in learned], gradients, rtol=1e-3, atol=1e-5)


def test_a_scene_where_no_agent_has_a_candidate_is_decoded():
    decoder, scene = GoalDecoder(8).eval(), highway_scene(2, 3)
    scene.goal_mask[:] = False
    logits = decoder.logits(torch.randn(2, 3, 8), scene)
    assert (logits == NO_CANDIDATE).all()
    goals, reference = choose(scene, most_likely(logits, 4))
    assert goals.shape == (2, 4, 3, 2)
    assert (goals == 0).all()
    assert (reference == 0).all()


@given(st.lists(st.one_of(st.none(), st.integers(-3, 3)), min_size=1, max_size=7), st.integers(1, 9))
def test_goals_are_sorted_by_probability_and_repeated(logits, modes):
    """Ties go to the earlier candidate; None is no candidate."""
    given_logits = torch.tensor([[[NO_CANDIDATE if logit is None else float(logit) for logit in logits]]])
    existing = [index for index, logit in enumerate(logits) if logit is not None]
    ranked = sorted(existing, key=lambda index: -logits[index]) or [0]
    expected = [ranked[mode % len(ranked)] for mode in range(modes)]
    assert most_likely(given_logits, modes)[0, :, 0].tolist() == expected


def test_goals_and_their_lines_are_those_of_the_chosen_candidates():
    scene = pad(highway_scene(3, 2), agents=1, candidates=2)
    chosen = torch.randint(8, (3, 4, 3))
    goals, reference = choose(scene, chosen)
    for b in range(3):
        for m in range(4):
            for i in range(3):
                g = chosen[b, m, i]
                if scene.goal_mask[b, i, g] and scene.agent_mask[b, i]:
                    assert torch.equal(goals[b, m, i], scene.goal_candidates[b, i, g])
                    assert reference[b, m, i] == scene.goal_reference[b, i, g]
                else:
                    assert (goals[b, m, i] == 0).all()
                    assert reference[b, m, i] == 0


def test_a_scene_without_candidates_is_refused():
    scene = highway_scene(2, 3)
    bare = Scene(scene.history, scene.dt)
    with pytest.raises(ValueError, match=r"goal_candidates .* is None"):
        GoalDecoder(8)(torch.randn(2, 3, 8), bare)


def test_goal_headings_are_chosen_with_the_goals():
    scene, modes = highway_scene(3, 2), 4
    headings = torch.where(scene.goal_mask, torch.randn(3, 2, 6), torch.nan)
    scene = dataclasses.replace(scene, goal_headings=headings)
    scene.agent_mask[2, 1] = False
    goals = GoalDecoder(8, variants=modes)(torch.randn(3, 2, 8), scene)
    for b, m, i in torch.cartesian_prod(torch.arange(3), torch.arange(modes), torch.arange(2)).tolist():
        expected = headings[b, i, goals.chosen[b, m, i]] if scene.agent_mask[b, i] else torch.tensor(0.0)
        assert goals.headings[b, m, i] == expected
    assert GoalDecoder(8)(torch.randn(3, 2, 8), dataclasses.replace(scene, goal_headings=None)).headings is None


def test_given_goal_headings_are_the_same_in_every_mode():
    one = dataclasses.replace(
        random_scene(3, 2), goal_headings=torch.tensor([[[1.0], [2.0]], [[3.0], [torch.nan]], [[5.0], [6.0]]])
    )
    one.goal_mask[1, 1] = False
    headings = GivenGoals(2)(torch.zeros(3, 2, 4), one).headings
    assert headings.tolist() == [[[1.0, 2.0]] * 2, [[3.0, 0.0]] * 2, [[5.0, 6.0]] * 2]
    assert GivenGoals(2)(torch.zeros(3, 2, 4), random_scene(3, 2)).headings is None


def test_a_mode_is_as_likely_as_its_choices_of_all_agents_that_have_a_goal():
    """Products of the chosen candidates' shares among those that exist, which only the goal loss may change."""
    scene = pad(highway_scene(3, 2), agents=1, candidates=2)
    scene.goal_mask[1, 1] = False
    decoder = GoalDecoder(8, scale=50.0, variants=4)
    goals = decoder(torch.randn(3, 3, 8), scene)
    for b in range(3):
        for m in range(4):
            expected = 1.0
            for i in range(3):
                exists = scene.goal_mask[b, i] & scene.agent_mask[b, i]
                weights = torch.where(exists, goals.logits[b, i].exp(), 0.0)
                shares = weights / weights.sum() if exists.any() else weights
                torch.testing.assert_close(goals.probabilities[b, i], shares)
                if exists.any():
                    expected = expected * shares[goals.chosen[b, m, i]]
            torch.testing.assert_close(goals.log_probability[b, m].exp(), expected.detach())
    assert goals.logits.requires_grad
    assert not goals.log_probability.requires_grad
