"""Losses against hand-computed values."""

from __future__ import annotations

import math
from types import SimpleNamespace

import jaxtyping
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from epo_lightning import losses
from epo_lightning.forecast import JointForecast
from epo_lightning.schedules import HARDEST, Annealing, ImitationSchedule, Relaxation, schedules_in

MASK = torch.ones(1, 2, 1, dtype=torch.bool)
DISTANCE = torch.tensor([[[1.0, 5.0], [3.0, 1.0]]])  # [B=1, M=2, N=2]


def test_distances_are_means_over_observed_steps():
    positions = torch.zeros(1, 1, 2, 2, 2)
    future = torch.zeros(1, 2, 2, 4)
    future[0, 0, :, 0] = torch.tensor([3.0, 5.0])
    future[0, 1, 1, :2] = torch.nan
    mask = torch.tensor([[[True, True], [True, False]]])
    assert losses.distances(positions, future, mask).tolist() == [[[4.0, 0.0]]]


@given(st.integers(0, 2**31), st.floats(0.0, 1.0), st.floats(1.05, 3.0))
def test_only_powers_above_one_put_a_mode_half_way_between_two_futures(seed, share, power):
    """A mode that serves two futures may stay at one of them under Euclidean distances, but not under higher powers."""
    drawn = torch.Generator().manual_seed(seed)
    one, other = torch.randn(2, 3, 5, 2, generator=drawn, dtype=torch.double)

    def both(at: float, power: float) -> float:
        """Sum of the distances from both futures of a mode at a share of the way between them."""
        mode = torch.lerp(one, other, at)[None, None]
        futures = [torch.cat((future, torch.zeros_like(future)), -1)[None] for future in (one, other)]
        mask = torch.ones(1, 3, 5, dtype=torch.bool)
        return sum(losses.distances(mode, future, mask, power).mean().item() for future in futures)

    assert both(share, 1.0) == pytest.approx(both(0.0, 1.0))
    # Each coordinate's error is multiplied by s^p + (1 - s)^p.
    assert both(share, power) == pytest.approx((share**power + (1 - share) ** power) * both(0.0, power))
    assert both(0.5, power) <= both(share, power) * (1 + 1e-12)


def test_joint_and_marginal_imitation_choose_their_own_modes():
    joint, mode = losses.scene_imitation(DISTANCE, MASK)
    assert (joint.item(), mode.item()) == (2.0, 1)
    marginal, modes = losses.marginal_imitation(DISTANCE, MASK)
    assert (marginal.item(), modes.tolist()) == (1.0, [[0, 1]])


def test_agents_without_a_future_do_not_count():
    mask = torch.tensor([[[True], [False]]])
    joint, mode = losses.scene_imitation(DISTANCE, mask)
    assert (joint.item(), mode.item()) == (1.0, 0)


def test_relaxation_adds_the_mean_over_modes_and_decays():
    relaxation = Relaxation(share=0.5, steps=10)
    assert [relaxation.at(step) for step in (0, 5, 10, 99)] == [0.5, 0.25, 0.0, 0.0]
    joint, mode = losses.scene_imitation(DISTANCE, MASK, 0.5)  # modes are at 3 and 2
    assert (joint.item(), mode.item()) == (2.25, 1)
    marginal, _ = losses.marginal_imitation(DISTANCE, MASK, 0.5)  # closest 1 and 1, means 2 and 3
    assert marginal.item() == 1.75
    with pytest.raises(ValueError, match="relaxation"):
        Relaxation(share=2.0)


def test_a_held_number_takes_the_place_of_the_number_until_it_is_zero():
    schedule = ImitationSchedule(1.0, Relaxation(0.5, 10), Annealing(2.0, 5))
    for one in schedules_in(SimpleNamespace(schedule=schedule, other=3)):
        one.held = torch.tensor(0.25)
    assert schedule.relaxation.at(0) is schedule.relaxation.held
    assert schedule.relaxation.at(10) == 0.0
    _, relaxation, temperature = schedule.at(4)
    assert isinstance(temperature, torch.Tensor)
    assert schedule.at(5).temperature == 0.0
    for loss in (losses.scene_imitation, losses.marginal_imitation):
        assert loss(DISTANCE, MASK, relaxation, temperature)[0] == loss(DISTANCE, MASK, 0.25, 0.25)[0]


def test_the_temperature_falls_geometrically_to_a_centimetre_and_then_is_zero():
    annealing = Annealing(temperature=1.0, steps=100)
    assert [annealing.at(step) for step in (0, 50, 100, 10**6)] == pytest.approx([1.0, 0.1, 0.0, 0.0])
    assert annealing.at(99) == pytest.approx(HARDEST, rel=0.05)
    ratios = [annealing.at(step + 1) / annealing.at(step) for step in range(99)]
    assert ratios == pytest.approx([ratios[0]] * 99)
    assert Annealing().at(0) == 0.0
    for wrong in ({"temperature": -1.0}, {"temperature": 0.01}, {"temperature": math.inf}, {"steps": 0}):
        with pytest.raises(ValueError, match="annealing"):
            Annealing(**wrong)


drawn_distances = st.lists(
    st.lists(st.lists(st.floats(0.0, 20.0), min_size=3, max_size=3), min_size=2, max_size=2), min_size=1, max_size=4
)
"""Distances by scene, agent and mode."""


@given(drawn_distances, st.floats(0.05, 50.0), st.floats(0.0, 1.0), st.booleans())
def test_soft_minima_and_their_gradients_equal_loops(values, temperature, relaxation, absent):
    distance = torch.tensor(values, dtype=torch.float64).mT.clone().requires_grad_()  # B M N
    mask = torch.ones(len(values), 2, 1, dtype=torch.bool)
    mask[0, 1] = not absent
    for imitation, per_agent in ((losses.scene_imitation, False), (losses.marginal_imitation, True)):
        expected, shares = 0.0, torch.zeros_like(distance)
        for b, agents in enumerate(values):
            counted = [i for i in range(2) if mask[b, i, 0]]
            rows = [[agents[i]] for i in counted] if per_agent else [[agents[i] for i in counted]]
            for number, row in enumerate(rows):
                means = [sum(one[m] for one in row) / len(row) for m in range(3)]
                rounded = [math.hypot(d, temperature) - temperature for d in means]
                powers = [math.exp(-(h - min(rounded)) / temperature) for h in rounded]
                soft = min(rounded) - temperature * math.log(sum(powers) / 3)
                assert soft <= sum(means) / 3 + 1e-9
                expected += ((1 - relaxation) * soft + relaxation * sum(means) / 3) / len(rows) / len(values)
                for m in range(3):
                    pull = means[m] / math.hypot(means[m], temperature)
                    share = (1 - relaxation) * pull * powers[m] / sum(powers) + relaxation / 3
                    for i in [counted[number]] if per_agent else counted:
                        shares[b, m, i] = share / len(counted) / len(values)
        loss, mode = imitation(distance, mask, relaxation, temperature)
        assert loss.item() == pytest.approx(expected, rel=1e-6, abs=1e-9)
        assert torch.equal(mode, imitation(distance, mask)[1]), "the closest mode is the same"
        (gradient,) = torch.autograd.grad(loss, distance)
        torch.testing.assert_close(gradient, shares, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("imitation", [losses.scene_imitation, losses.marginal_imitation])
def test_annealing_reaches_all_modes_when_hot_and_is_the_hard_loss_when_cold(imitation):
    distance = torch.tensor([[[1.0, 5.0], [3.0, 1.0], [2.0, 2.5]]], dtype=torch.float64, requires_grad=True)
    hard, _ = imitation(distance, MASK)
    (of_hard,) = torch.autograd.grad(hard, distance)
    hot, _ = imitation(distance, MASK, temperature=1e3)
    (of_hot,) = torch.autograd.grad(hot, distance)
    joint = distance.detach().mean(2, keepdim=True).expand_as(distance)
    far = joint if imitation is losses.scene_imitation else distance.detach()
    torch.testing.assert_close(of_hot, far / 1e3 / 6, rtol=1e-2, atol=0)  # of the mean of d^2 / (2 T)
    cold, _ = imitation(distance, MASK, temperature=HARDEST)
    (of_cold,) = torch.autograd.grad(cold, distance)
    torch.testing.assert_close(of_cold, of_hard, rtol=0, atol=1e-4)
    assert cold.item() == pytest.approx(hard.item(), abs=2 * HARDEST)
    off, _ = imitation(distance, MASK, temperature=0.0)
    assert torch.equal(torch.autograd.grad(off, distance)[0], of_hard)
    assert torch.equal(off, hard)


@pytest.mark.parametrize("far", [1e15, 1e20, 1e38])
def test_a_very_distant_mode_changes_no_soft_minimum(far):
    distance = torch.tensor([[far, 1.0]], requires_grad=True)
    soft = losses.soft_minimum(distance, 0.5)
    torch.testing.assert_close(soft, losses.soft_minimum(torch.tensor([[1e3, 1.0]]), 0.5))
    soft.sum().backward()
    assert distance.grad.isfinite().all()
    assert losses.soft_minimum(torch.tensor([[far, far]]), 0.5).item() == pytest.approx(far)


def test_a_power_other_than_one_and_a_temperature_in_metres_exclude_each_other():
    never = Relaxation()
    assert ImitationSchedule(1.0, never, Annealing(0.3)).at(0) == (1.0, 0.0, 0.3)
    assert ImitationSchedule(2.0, never, Annealing()).at(0) == (2.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"annealing=0.3 and power=1.05 exclude each other"):
        ImitationSchedule(1.05, never, Annealing(0.3))


def test_modes_at_an_infinite_distance_do_not_count():
    distance = torch.tensor([[1.0, 3.0, math.inf]], requires_grad=True)
    soft = losses.soft_minimum(distance, 2.0)
    torch.testing.assert_close(soft, losses.soft_minimum(distance[:, :2], 2.0))
    soft.sum().backward()
    assert distance.grad.isfinite().all()
    assert distance.grad[0, 2] == 0


@pytest.mark.parametrize("temperature", [0.0, 2.0])
def test_losses_without_relaxation_ignore_modes_at_an_infinite_distance(temperature):
    distance = torch.tensor([[[1.0, 2.0], [3.0, 1.0], [math.inf, math.inf]]], requires_grad=True)
    for imitation in (losses.scene_imitation, losses.marginal_imitation):
        found, _ = imitation(distance, MASK[:1], temperature=temperature)
        assert found.isfinite()
        (slope,) = torch.autograd.grad(found, distance)
        assert slope.isfinite().all()
        assert (slope[0, 2] == 0).all()


def test_a_scene_without_observations_has_no_loss_when_annealed():
    for imitation in (losses.scene_imitation, losses.marginal_imitation):
        assert imitation(torch.zeros(1, 2, 2), torch.zeros_like(MASK), temperature=1.0)[0] == 0.0


def after_training(annealing: Annealing) -> list[float]:
    """Where two modes end that start at 0.9 m and 6 m, if half of the futures are at -1 m and the others at 1 m."""
    modes = torch.tensor([0.9, 6.0], dtype=torch.float64, requires_grad=True)
    future = torch.zeros(2, 1, 1, 4, dtype=torch.float64)
    future[0, ..., 0], future[1, ..., 0] = -1.0, 1.0
    mask = torch.ones(2, 1, 1, dtype=torch.bool)
    optimizer = torch.optim.SGD([modes], 0.2)
    for step in range(320):
        positions = torch.stack((modes, torch.zeros_like(modes)), -1).view(1, 2, 1, 1, 2).expand(2, -1, -1, -1, -1)
        distance = losses.distances(positions, future, mask)
        loss, _ = losses.scene_imitation(distance, mask, temperature=annealing.at(step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return sorted(modes.tolist())


def test_the_hard_loss_collapses_where_the_annealed_one_teaches_both_modes():
    near, far = after_training(Annealing())
    assert far == 6.0, "the mode that is never the closest has not moved"
    assert -1.1 < near < 1.1
    assert after_training(Annealing(10.0, 300)) == pytest.approx([-1.0, 1.0], abs=0.11)


def test_probabilities_are_scored_at_the_closest_mode():
    logs = torch.tensor([[0.25, 0.75]]).log()
    assert losses.scene_probability(logs, torch.tensor([1]), MASK).item() == pytest.approx(0.2877, abs=1e-4)
    agents = torch.tensor([[[0.25, 0.5], [0.75, 0.5]]]).log()
    value = losses.marginal_probability(agents, torch.tensor([[1, 0]]), MASK)
    assert value.item() == pytest.approx((0.2877 + 0.6931) / 2, abs=1e-4)
    assert losses.scene_probability(logs, torch.tensor([1]), ~MASK) == 0, "nothing was observed"


def unlikely(logits: torch.Tensor) -> JointForecast:
    """A forecast of 2 modes and 2 agents, whose modes and goals have the same logits [1, 2]."""
    per_agent = logits[..., None].expand(-1, -1, 2)
    return JointForecast(
        torch.zeros(1, 2, 2, 1, 4),
        logits.softmax(1),
        agent_probabilities=per_agent.softmax(1),
        goal_probabilities=per_agent.mT.softmax(2),
        logits=logits,
        agent_logits=per_agent,
        goal_logits=per_agent.mT,
    )


@pytest.mark.parametrize("kind", ["scene", "marginal", "goal"])
def test_the_gradient_survives_a_probability_that_underflows(kind):
    """softmax(0, -200) is (1, 0) in float32; the gradient by the logits is softmax - one-hot all the same."""
    logits = torch.tensor([[0.0, -200.0]], requires_grad=True)
    forecast = unlikely(logits)
    if kind == "scene":
        loss = losses.scene_probability(forecast.log_probabilities, torch.tensor([1]), MASK)
    elif kind == "marginal":
        loss = losses.marginal_probability(forecast.agent_log_probabilities, torch.tensor([[1, 1]]), MASK)
    else:
        candidates = torch.tensor([9.0, 0.0]).view(1, 1, 2, 1).expand(1, 2, 2, 2)  # the second one is closest
        exists, observed = torch.ones(1, 2, 2, dtype=torch.bool), torch.ones(1, 2, dtype=torch.bool)
        loss = losses.goal(forecast.goal_log_probabilities, candidates, exists, torch.zeros(1, 2, 2), observed)
    assert loss.item() == pytest.approx(200.0)
    loss.backward()
    assert logits.grad.tolist() == [[1.0, -1.0]]


def test_modes_without_any_probability_cost_a_finite_amount_and_have_no_gradient():
    """A mode that repeats an earlier one has a logit of -inf; it may be the closest one all the same."""
    score = torch.tensor([[0.5, 0.3]], requires_grad=True)
    logits = torch.where(torch.tensor([[False, True]]), -torch.inf, score)
    forecast = unlikely(logits)
    loss = losses.scene_probability(forecast.log_probabilities, torch.tensor([1]), MASK)
    assert loss.item() == pytest.approx(-math.log(torch.finfo(torch.float32).tiny))
    loss.backward()
    assert score.grad.tolist() == [[0.0, 0.0]]


def test_forecasts_without_logits_are_scored_by_their_probabilities():
    probabilities = torch.tensor([[0.25, 0.75, 0.0]], requires_grad=True)
    forecast = JointForecast(torch.zeros(1, 3, 2, 1, 4), probabilities)
    assert forecast.log_probabilities[0, :2].exp().tolist() == [0.25, 0.75]
    assert forecast.log_probabilities.isfinite().all()
    assert forecast.agent_log_probabilities is forecast.goal_log_probabilities is None
    forecast.log_probabilities.sum().backward()
    assert probabilities.grad.isfinite().all()


def test_a_future_of_another_length_is_refused(monkeypatch):
    """One step would be broadcast over all of them."""
    positions, future, mask = torch.zeros(1, 2, 2, 5, 2), torch.zeros(1, 2, 1, 4), torch.ones(1, 2, 1, dtype=torch.bool)
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # as users run it
    for wrong in ((future, mask), (future.expand(-1, -1, 5, -1), mask)):
        with pytest.raises(ValueError, match="the horizon K of data and model must agree"):
            losses.distances(positions, *wrong)


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
    probabilities = torch.rand(batch, 2, 3).softmax(-1)
    logs = probabilities.log().requires_grad_()
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
    loss = losses.goal(logs, candidates, exists, final, observed)
    assert loss.item() == pytest.approx(sum(of_scenes) / batch, abs=1e-5)
    loss.backward()
    assert logs.grad.isfinite().all()
